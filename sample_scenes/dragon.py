# SPDX-License-Identifier: GPL-3.0-or-later
"""Build dragon.blend: a paper dragon chases a pearl around a lacquered stage, on the night of the lanterns.

Run with Blender's Python, `python sample_scenes/dragon.py`. Plays over frames 1-48; the dragon's round takes 96.
"""

from __future__ import annotations

import math

import bpy
import numpy as np
from holoreel.sample_scenes import kit

FRAMES = 48
SEED = 11
TARGET = (0.0, 0.0, 0.95)
CAMERA = {"distance": 7.1, "down_deg": 9.0, "lens": 42.0}
STAGE_RADIUS = 1.95
ROUND_FRAMES = 96
START = 0.31  # where the dragon's neck is on its course at frame 0, as a share of the course
BODY_LENGTH = 3.3

COLORS = {
    "vermilion": "#e0553f",
    "gold": "#f0b64a",
    "cream": "#fdf0d6",
    "jade": "#4fa88e",
    "teal": "#2f7d86",
    "plum": "#5d4a80",
    "wine": "#8e3a4d",
    "ink": "#2b2b4d",
    "lilac": "#b9a5cf",
    "mist": "#8f8fc0",
    "rose": "#ec8f86",
    "pearl": "#d8f0e6",
}
GLOSS = {"vermilion": 0.4, "gold": 0.32, "jade": 0.35, "plum": 0.35, "wine": 0.3, "pearl": 0.28}
# fmt: off
HILLS = (("far", 4.75, 1.0, "#8c73a4", 1.0), ("middle", 4.45, 0.7, "#5f6399", 3.0), ("near", 4.1, 0.45, "#3f6f86", 5.2))
CLOUDS = (  # angle in degrees, radius, size
    (-152, 2.25, 0.75), (-122, 2.4, 0.6), (-62, 2.4, 0.62), (-27, 2.25, 0.8), (28, 2.3, 0.9), (152, 2.3, 0.9),
)
LANTERNS = (  # x, y, z at frame 12, first frame, first frame without it, phase
    (-2.05, 0.7, 0.9, -30, 60, 0.0), (1.95, 1.0, 1.25, -30, 60, 2.0), (1.0, 2.1, 1.9, -30, 60, 4.0),
    (-1.55, 1.8, 1.35, 5, 60, 1.0), (0.15, 2.4, 2.05, -30, 9, 3.0), (2.3, 2.0, 0.9, 21, 60, 5.0),
    (-2.5, 2.1, 1.8, -30, 33, 2.5),
)
BANNERS = (  # x, y, colors
    (-1.72, 0.75, ("teal", "gold")), (1.72, 0.75, ("wine", "gold")),
    (-1.2, 1.35, ("vermilion", "cream")), (1.2, 1.35, ("jade", "cream")),
)
PINWHEELS = (  # x, y, z, colors
    (-1.5, -0.95, 0.78, ("rose", "gold")), (-1.05, -1.4, 0.62, ("jade", "cream")),
    (1.5, -1.0, 0.74, ("gold", "vermilion")),
)
FIREWORKS = (  # x, y, z, first frame, first frame without it, color
    (1.55, 2.7, 2.0, 5, 17, "rose"), (-2.2, 2.9, 1.45, -6, 9, "gold"), (0.6, 3.0, 2.35, 20, 34, "pearl"),
    (-1.9, 2.8, 2.1, 30, 44, "rose"),
)
# fmt: on


# ---------------------------------------------------------------------------------------------------------------- stage


def paint_night(height_m: float, radius: float) -> np.ndarray:
    """The painted night: teal at the horizon, indigo above, bands of cloud and soft stars, (384, 1024, 3) sRGB."""
    rng = np.random.default_rng(SEED)
    z = np.linspace(height_m, 0, 384)[:, None]
    arc = np.linspace(-np.radians(108), np.radians(108), 1024)[None] * radius
    noise = kit.soft_noise(rng, arc * 0.6, z * 1.3)
    stops = [(0.0, "#e59a86"), (0.7, "#b97f9a"), (1.5, "#6f6aa3"), (2.6, "#46548f"), (4.2, "#343f78")]
    night = kit.blend(stops, z + 0.1 * noise)
    band = np.clip(3 * np.sin(7 * z + 0.9 * np.sin(0.8 * arc) + 0.4 * noise), -1, 1)
    night = night * (1 + 0.03 * band)[..., None]
    for x, y, size in zip(rng.uniform(-9, 9, 90), rng.uniform(1.3, 4.3, 90), rng.uniform(0.05, 0.1, 90), strict=True):
        star = np.abs(arc - x) ** 0.7 + np.abs(z - y) ** 0.7
        night += 0.45 * np.clip(3 * (1 - star / size**0.7), 0, 1)[..., None] * (1.0, 0.9, 0.65)
    return night


def paint_ground(size: int = 768) -> np.ndarray:
    """The ground: dusky tiles in rings about the stage, (size, size, 3) sRGB."""
    x, y = np.meshgrid(np.linspace(-5, 5, size), np.linspace(5, -5, size))
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    noise = kit.soft_noise(np.random.default_rng(SEED + 1), x, y)
    ring = np.floor(radius / 0.42)
    tile = (
        np.sin(ring * 12.9898 + np.floor(angle / (2 * np.pi) * np.round(3.2 * ring + 6) + ring * 0.37) * 78.233)
        * 43758.5453
    )
    shade = 1 + 0.05 * (2 * (tile - np.floor(tile)) - 1) + 0.03 * noise
    return kit.blend([(0.0, "#9a86ad"), (2.6, "#9a86ad"), (5.0, "#b392ab")], radius) * shade[..., None]


def build_surroundings(paints: kit.Paints) -> None:
    """Ground, painted night, a moon and three ranges of hills."""
    kit.curtain("Night", 5.0, 0.0, 4.4, [kit.mural("Painted night", paint_night(4.4, 5.0))])
    kit.ground("Ground", 5.0, [kit.mural("Tiled ground", paint_ground())])
    theta = kit.CURTAIN_ANGLES
    for name, radius, height, color, phase in HILLS:
        crest = height * (1 + 0.3 * np.abs(np.sin(3.5 * theta + phase)) + 0.12 * np.sin(9 * theta + 2 * phase))
        kit.curtain(f"Hills {name}", radius, 0.0, crest, [kit.paint(f"Hills {name}", color, grain=0.07, scale=2.5)])
    moon = kit.empty("Moon", (-0.95, 3.5, 1.95))
    kit.plate("Moon halo", kit.blob(0.78), 0.05, paints["gold"], parent=moon, bevel=0.01)
    kit.plate("Moon face", kit.blob(0.66), 0.12, paints["cream"], parent=moon, bevel=0.02)
    for number, (x, z, radius) in enumerate(((-0.2, 0.22, 0.16), (0.24, -0.05, 0.2), (-0.15, -0.27, 0.13)), 1):
        crater = kit.paint(f"Crater {number}", "#f0d9ae", grain=0.0)
        kit.plate(f"Crater {number}", kit.blob(radius, count=32), 0.14, crater, parent=moon, at=(x, 0, z))


def build_stage(paints: kit.Paints) -> None:
    """A round lacquered stage on two steps with gilded edges, its top inlaid with slowly turning petals."""
    for name, radius, low, high, color in (
        ("Lower step", 2.2, 0.0, 0.12, "wine"),
        ("Upper step", STAGE_RADIUS, 0.1, 0.3, "plum"),
    ):
        kit.lathe(name, [(radius, low), (radius, high)], [paints[color]], segments=80, smooth=False, bevel=0.02)
        edge = [(radius - 0.09, high - 0.02), (radius + 0.015, high - 0.02), (radius + 0.015, high + 0.02)]
        edge.append((radius - 0.09, high + 0.02))
        kit.lathe(f"{name} rim", edge, [paints["gold"]], segments=80, ring=True, smooth=False)
    carousel = kit.empty("Medallion", (0, 0, 0.3))
    kit.drive(carousel, "rotation_euler", kit.turn(2 * FRAMES), 2)
    for ring, (count, reach, size, colors) in enumerate(
        ((12, 1.42, 0.3, ("rose", "lilac")), (8, 0.8, 0.28, ("jade", "gold")))
    ):
        for number in range(count):
            angle = 2 * math.pi * number / count
            petal = [(reach + size * x, 0.55 * size * y) for x, y in kit.blob(1.0, [(2, 0.0, 0.0), (3, 0.12, 0.0)], 24)]
            plate = kit.slab(
                f"Petal {ring + 1}.{number + 1:02d}",
                petal,
                0.035,
                paints[colors[number % 2]],
                parent=carousel,
                bevel=0.008,
            )
            plate.rotation_euler[2] = angle
    kit.slab("Medallion heart", kit.blob(0.42, [(6, 0.08, 0.0)]), 0.05, paints["cream"], parent=carousel, bevel=0.01)


def build_clouds(paints: kit.Paints) -> None:
    """Paper clouds in three layers that the stage floats among; the layers slide past each other."""
    for number, (angle_deg, radius, size) in enumerate(CLOUDS, 1):
        angle = math.radians(angle_deg)
        bank = kit.empty(f"Cloud bank {number}", (radius * math.cos(angle), radius * math.sin(angle), 0.05))
        bank.rotation_euler[2] = 0.4 * (angle + math.pi / 2) if angle_deg < 0 else 0.0
        for layer, (color, grow) in enumerate((("mist", 1.15), ("lilac", 0.95), ("cream", 0.72))):
            outline = [(grow * size * x, grow * size * z) for x, z in kit.cloud_outline()]
            shift = size * 0.2 * (layer - 1) * (-1) ** number
            cloud = kit.plate(f"Cloud {number}.{layer + 1}", outline, 0.07, paints[color], bevel=0.012)
            cloud.parent, cloud.location[1] = bank, -0.1 * layer
            kit.move(cloud, place=(f"{shift:.4f}+{0.02 + 0.03 * layer}*sin{kit.turn(FRAMES, number + layer)}",))


# --------------------------------------------------------------------------------------------------------------- dragon


def build_course() -> tuple[bpy.types.Object, float]:
    """The closed course in the air that the dragon is bent along; returns the curve and its length in meters."""
    t = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    points = course(t)
    data = bpy.data.curves.new("Course", "CURVE")
    data.dimensions, data.twist_mode, data.resolution_u = "3D", "Z_UP", 24
    spline = data.splines.new("BEZIER")
    spline.bezier_points.add(len(points) - 1)
    for knot, point in zip(spline.bezier_points, points, strict=True):
        knot.co = point
        knot.handle_left_type = knot.handle_right_type = "AUTO"
    spline.use_cyclic_u = True
    thing = kit.link(bpy.data.objects.new("Course", data))
    thing.hide_render = True
    return thing, spline.calc_length()


def course(t: np.ndarray) -> np.ndarray:
    """Points of the course, a figure of eight that climbs at the back and sinks to the front, (n, 3)."""
    return np.c_[1.42 * np.sin(t), 0.62 * np.sin(2 * t), 1.22 + 0.36 * np.cos(t) + 0.08 * np.cos(2 * t + 0.6)]


def build_dragon(paints: kit.Paints) -> None:
    """The dragon: straight parts along X, all bent along the course by Curve modifiers as their parent moves on."""
    path, length = build_course()
    dragon = kit.empty("Dragon")
    kit.drive(dragon, "location", f"{START * length:.6f}+frame*{length / ROUND_FRAMES:.9f}", 0)
    parts = [*build_body(paints, dragon), *build_head(paints, dragon), build_pearl(paints, dragon)]
    for part in parts:
        bend = part.modifiers.new("Along the course", "CURVE")
        bend.object = path
        bend.deform_axis = "POS_X"


def body_radius(x: np.ndarray) -> np.ndarray:
    """Radius of the body at x in [-BODY_LENGTH, 0]: slim tail, full middle, slim neck."""
    u = 1 + x / BODY_LENGTH
    return 0.03 + 0.15 * np.sin(np.pi * np.clip(u, 0, 1) ** 0.75 * 0.82) ** 0.8


def build_body(paints: kit.Paints, dragon: bpy.types.Object) -> list[bpy.types.Object]:
    """A ringed body with a crest, legs and a tail flame; body and crest undulate as one."""
    x = np.linspace(-BODY_LENGTH, 0.06, 121)
    radius = body_radius(x) * (1 + 0.05 * np.cos(2 * np.pi * np.arange(len(x)) / 4))
    around = np.linspace(-np.pi, np.pi, 21)
    rows = np.array([np.c_[x, radius * np.sin(a), -radius * np.cos(a)] for a in around])
    belly = np.abs(around[:-1] + np.pi / 20) < 0.75
    bands = np.where(np.arange(len(x) - 1) // 4 % 3 == 2, 1, 0)
    slots = np.where(belly[:, None], 2, bands[None])
    body = kit.strip(
        "Dragon body", rows, paints.pick("vermilion", "gold", "cream"), slots=slots, smooth=True, parent=dragon
    )
    undulate(body)
    points, faces = [], []
    for center in np.arange(-BODY_LENGTH + 0.2, -0.1, 0.17):
        top = float(body_radius(np.array([center]))[0])
        first = len(points)
        outline = ((-0.09, -0.03), (0.075, -0.03), (0.0, 0.06), (-0.1, 0.05 + 0.45 * top))
        points += [(center + px, y, top + pz) for y in (-0.02, 0.02) for px, pz in outline]
        quad = (0, 1, 2, 3)
        faces += [tuple(first + i for i in quad), tuple(first + 4 + i for i in quad[::-1])]
        faces += [tuple(first + i for i in ((k + 1) % 4, k, k + 4, (k + 1) % 4 + 4)) for k in quad]
    crest = kit.add_mesh("Dragon crest", points, faces, [paints["jade"]], parent=dragon)
    undulate(crest)
    flame = [
        (0.1, -0.05),
        (0.1, 0.05),
        (-0.1, 0.15),
        (-0.2, 0.12),
        (-0.3, 0.22),
        (-0.36, 0.1),
        (-0.5, 0.06),
        (-0.4, 0.0),
        (-0.5, -0.1),
        (-0.34, -0.1),
        (-0.26, -0.18),
        (-0.1, -0.13),
    ]
    tail = kit.slab(
        "Dragon tail", flame, 0.06, paints["gold"], upright=True, at=(-BODY_LENGTH, 0, 0), parent=dragon, bevel=0.012
    )
    parts = [body, crest, tail]
    for number, (place, side) in enumerate(((-0.75, 1), (-0.85, -1), (-2.0, 1), (-2.1, -1)), 1):
        leg = kit.ball(
            f"Dragon leg {number}",
            0.085,
            paints["vermilion"],
            stretch=1.7,
            at=(place, side * 0.15, -0.12),
            parent=dragon,
        )
        kit.drive(leg, "rotation_euler", f"0.6*sin{kit.turn(16, number * 1.6)}", 1)
        foot = kit.ball(f"Dragon foot {number}", 0.08, paints["gold"], at=(0.03, 0, -0.13), parent=leg)
        parts += [leg, foot]
    return parts


def undulate(thing: bpy.types.Object) -> None:
    """A wave that runs from the neck to the tail, growing as it goes."""
    x = np.array([v.co.x for v in thing.data.vertices])
    grow = 0.09 * np.clip(-x / BODY_LENGTH, 0, 1) ** 0.7 * np.clip(x + BODY_LENGTH, 0, 1)
    kit.traveling_wave(thing, 2, grow, -5 * x, 24)


def build_head(paints: kit.Paints, dragon: bpy.types.Object) -> list[bpy.types.Object]:
    """A toy head with a ruff, horns, ears and a snapping jaw."""
    tips = kit.star(0.33, 0.24, 14)
    ruff = kit.slab("Dragon ruff", tips, 0.06, paints["gold"], parent=dragon, at=(0.0, 0, 0.02), bevel=0.01)
    inner = kit.slab(
        "Dragon ruff inner",
        [(0.78 * x, 0.78 * y) for x, y in tips],
        0.06,
        paints["jade"],
        parent=dragon,
        at=(0.045, 0, 0.02),
        bevel=0.01,
    )
    for disk in (ruff, inner):
        disk.rotation_euler[1] = math.pi / 2
    skull = kit.ball("Dragon skull", 0.2, paints["vermilion"], at=(0.16, 0, 0.06), parent=dragon)
    skull.scale = (1.1, 0.95, 0.9)
    snout = kit.ball("Dragon snout", 0.16, paints["vermilion"], at=(0.38, 0, 0.03), parent=dragon)
    snout.scale = (1.2, 0.95, 0.62)
    jaw = kit.ball("Dragon jaw", 0.14, paints["cream"], at=(0.2, 0, -0.07), parent=dragon)
    for vertex in jaw.data.vertices:
        vertex.co = (vertex.co.x * 1.35 + 0.14, vertex.co.y * 0.95, vertex.co.z * 0.42)
    kit.drive(jaw, "rotation_euler", f"0.28+0.22*sin{kit.turn(16)}", 1)
    parts = [ruff, inner, skull, snout, jaw]
    for side in (-1, 1):
        eye = kit.ball(f"Dragon eye {side}", 0.07, paints["cream"], at=(0.24, side * 0.12, 0.19), parent=dragon)
        pupil = kit.ball(f"Dragon pupil {side}", 0.042, paints["ink"], at=(0.275, side * 0.155, 0.205), parent=dragon)
        nostril = kit.ball(f"Dragon nostril {side}", 0.045, paints["gold"], at=(0.5, side * 0.07, 0.1), parent=dragon)
        horn = kit.lathe(
            f"Dragon horn {side}",
            [(0.05, 0.0), (0.045, 0.12), (0.03, 0.24), (0.008, 0.32)],
            [paints["cream"]],
            segments=12,
            at=(0.1, side * 0.1, 0.2),
            parent=dragon,
        )
        horn.rotation_euler = (-side * 0.35, -0.7, 0.0)
        ear = kit.ball(
            f"Dragon ear {side}", 0.09, paints["rose"], stretch=1.3, at=(0.08, side * 0.22, 0.13), parent=dragon
        )
        ear.scale = (0.45, 0.8, 1.0)
        kit.drive(ear, "rotation_euler", f"{-side * 1.0}+0.3*sin{kit.turn(12, side)}", 0)
        parts += [eye, pupil, nostril, horn, ear]
    return parts


def build_pearl(paints: kit.Paints, dragon: bpy.types.Object) -> bpy.types.Object:
    """The striped pearl that rolls ahead of the dragon's nose."""
    profile = kit.ball_profile(0.17, 14)
    stripes = paints.pick("pearl", "teal")
    pearl = kit.lathe(
        "Pearl", profile, stripes, segments=24, slot=lambda _, i: i // 4 % 2, at=(0.98, 0, 0.06), parent=dragon
    )
    pearl.rotation_euler[0] = 0.5
    kit.drive(pearl, "rotation_euler", kit.turn(32), 2)
    kit.drive(pearl, "location", f"0.06+0.06*sin{kit.turn(16)}", 2)
    return pearl


# ------------------------------------------------------------------------------------------------------------- festival


def build_lanterns(paints: kit.Paints) -> None:
    """Sky lanterns that rise on winding ways; one is lit at frame 5, another is gone by frame 9."""
    shade = kit.glow("Lantern paper", "#ffb45e", 0.55)
    profile = [(0.1, -0.19), (0.15, -0.13), (0.19, 0.0), (0.2, 0.1), (0.16, 0.17), (0.05, 0.2)]
    for number, (x, y, z, lit, gone, phase) in enumerate(LANTERNS, 1):
        lantern = kit.lathe(
            f"Lantern {number}",
            profile,
            [shade, paints["vermilion"]],
            segments=12,
            slot=lambda ring, _: int(ring in (0, 4)),
            smooth=False,
            bevel=0.008,
        )
        sway = kit.turn(FRAMES, phase)
        kit.move(
            lantern,
            place=(f"{x}+0.12*sin{sway}", f"{y}+0.08*cos{sway}", f"{z}+0.011*(frame-12)"),
            spin=("", "", kit.turn(96, phase)),
        )
        kit.pop(lantern, [(lit - 1, 0.0), (lit, 0.5), (lit + 2, 1.0), (gone - 2, 1.0), (gone - 1, 0.6), (gone, 0.0)])


def build_banners(paints: kit.Paints) -> None:
    """Long banners on poles at both sides, waving."""
    for number, (x, y, colors) in enumerate(BANNERS, 1):
        pole = kit.lathe(f"Pole {number}", [(0.035, 0.28), (0.03, 1.9)], [paints["gold"]], segments=12, at=(x, y, 0))
        kit.ball(f"Pole tip {number}", 0.07, paints["vermilion"], at=(0, 0, 1.93), parent=pole)
        away = 1.0 if x > 0 else -1.0
        u, v = np.meshgrid(np.linspace(0, 1, 25), np.linspace(0, 1, 17))
        fall = 1.82 - 0.5 * v - 0.12 * u + 0.1 * u * (2 * v - 1) * (u - 0.6)
        rows = np.stack([away * (0.02 + 0.62 * u), 0 * u, fall], -1)
        slots = np.where((np.arange(16) < 3) | (np.arange(16) > 12), 1, 0)
        flag = kit.strip(f"Banner {number}", rows, paints.pick(*colors), slots=slots, smooth=True, parent=pole)
        kit.traveling_wave(flag, 1, 0.11 * u.ravel(), (7 * u + 1.2 * v + number).ravel(), 16)


def build_pinwheels(paints: kit.Paints) -> None:
    """Pinwheels in front that spin 135 degrees in 12 frames, left and right by turns."""
    leaf_outline = [(0.0, 0.0), (0.13, 0.07), (0.09, 0.2), (0.0, 0.27)]
    for number, (x, y, z, colors) in enumerate(PINWHEELS, 1):
        kit.lathe(f"Stick {number}", [(0.022, 0.28), (0.018, z)], [paints["cream"]], segments=10, at=(x, y, 0))
        wheel = kit.empty(f"Pinwheel {number}", (x, y - 0.05, z))
        kit.move(wheel, spin=("", kit.turn(32 if number % 2 else -32, number)))
        for blade in range(6):
            color = paints[colors[blade % 2]]
            leaf = kit.plate(f"Pinwheel leaf {number}.{blade + 1}", leaf_outline, 0.02, color, parent=wheel)
            leaf.rotation_euler = (0.0, blade * math.pi / 3, 0.0)
        kit.ball(f"Pinwheel hub {number}", 0.05, paints["wine"], at=(0, -0.03, 0), parent=wheel)


def build_fireworks(paints: kit.Paints) -> None:
    """Paper fireworks that burst open, turn a little and are gone."""
    for number, (x, y, z, born, gone, color) in enumerate(FIREWORKS, 1):
        burst = kit.empty(f"Firework {number}", (x, y, z))
        kit.move(burst, spin=("", kit.turn(144, number)))
        kit.pop(burst, [(born - 1, 0.1), (born, 0.35), (born + 3, 0.9), (gone - 2, 1.1), (gone, 0.5)])
        for ray in range(12):
            angle, reach = ray * math.pi / 6, (0.4, 0.3)[ray % 2]
            outline = [(-0.025, 0.13), (0.025, 0.13), (0.05, reach), (0.0, reach + 0.07), (-0.05, reach)]
            paper = paints[(color, "cream")[ray % 2]]
            spark = kit.plate(f"Spark {number}.{ray + 1:02d}", outline, 0.03, paper, parent=burst)
            spark.rotation_euler[1] = angle
            kit.pop(spark, [(born - 1, 0.0), (born, 1.0), (gone - 1, 1.0), (gone, 0.0)])


def build() -> bpy.types.Scene:
    """Build the whole scene in the running Blender and return it."""
    scene = kit.start(FRAMES)
    paints = kit.Paints(COLORS, GLOSS)
    build_surroundings(paints)
    build_stage(paints)
    build_clouds(paints)
    build_dragon(paints)
    build_lanterns(paints)
    build_banners(paints)
    build_pinwheels(paints)
    build_fireworks(paints)
    kit.sky(scene, "#f0c9d4", "#9fb2ea", 0.7)
    kit.sun("#ffe9d2", 2.9, 40, 30, 10)
    kit.camera(scene, TARGET, **CAMERA)
    scene.frame_set(1)
    return scene


if __name__ == "__main__":
    kit.write(__file__, build)
