# SPDX-License-Identifier: GPL-3.0-or-later
"""Build harbor.blend: a paper-craft harbor on a round tray, on a clear morning.

Run with Blender's Python, `python sample_scenes/harbor.py`. Plays over frames 1-48; all but tug and gulls loop.
"""

from __future__ import annotations

import itertools
import math

import bpy
import numpy as np
from holoreel.sample_scenes import kit

FRAMES = 48
SEED = 7
TARGET = (0.0, 0.0, 0.78)
CAMERA = {"distance": 7.0, "down_deg": 10.5, "lens": 42.0}
TRAY_RADIUS = 2.15
SEA_LEVEL = 0.2
SLICES = 12
TABLE_RINGS = ((0.535, 0.02), (0.645, 0.01))  # radius and width, as shares of the half table
WAVE_LENGTH = 0.78
SAIL_PATH = {"center": (0.08, -0.62), "radii": (0.68, 0.36), "phase": math.radians(-58)}
TUG_PATH = {"radius": 1.62, "first_deg": 212.0, "sweep_deg": 46.0}

SEA = ("#23797f", "#2f8f90", "#45a59f", "#63b8ac", "#86c9b8")
COLORS = {
    "foam": "#dceee3",
    "coral": "#dd5f48",
    "mustard": "#eeb13f",
    "cream": "#fbeed3",
    "navy": "#2c4a68",
    "whale": "#3f7fae",
    "sand": "#efd9ae",
    "sage": "#a3bf8b",
    "meadow": "#7fa873",
    "pine": "#3d7a61",
    "wood": "#b98252",
    "plum": "#8d6a86",
    "rose": "#e39a8b",
    "smoke": "#efe3da",
}
GLOSS = {"coral": 0.32, "mustard": 0.35, "whale": 0.3, "navy": 0.35}
# fmt: off
HILLS = (  # name, radius, height, color, phase
    ("far", 4.75, 0.95, "#c9a3ad", 0.0), ("middle", 4.45, 0.66, "#9d8fae", 2.0), ("near", 4.1, 0.42, "#6f8ba5", 4.1),
)
CLOUDS = (  # x, y, z, size, phase
    (-1.75, 1.9, 1.75, 0.95, 0.0), (-0.55, 2.9, 2.15, 1.0, 1.7), (1.85, 2.3, 1.95, 1.05, 3.0),
    (2.55, 3.1, 1.35, 0.8, 4.2), (-2.75, 2.8, 1.3, 0.85, 5.1),
)
HOUSES = (  # x, y, color, turn
    (0.62, 0.28, "cream", 0.2), (0.92, 0.06, "rose", -0.05), (1.24, 0.02, "mustard", -0.2),
    (-0.76, 0.4, "rose", 0.35), (-1.12, 0.2, "cream", 0.0),
)
TREES = (  # x, y, z, height
    (0.72, 0.62, 0.62, 0.42), (0.82, 0.86, 0.62, 0.5), (1.58, 0.42, 0.5, 0.4), (1.62, 0.7, 0.5, 0.5),
    (-1.55, 0.62, 0.5, 0.45), (-1.66, 0.86, 0.36, 0.36), (-0.86, 0.74, 0.5, 0.5), (-0.72, 0.86, 0.36, 0.38),
)
PUFFS_BORN = (-12, -4, 5, 13, 21, 29, 37, 45)  # frames; a puff lives for 13
SPOUT = (  # x, z, radius of a drop
    (0.0, 0.08, 0.05), (0.0, 0.17, 0.052), (0.0, 0.26, 0.055), (-0.1, 0.31, 0.05), (0.1, 0.31, 0.05),
    (-0.19, 0.27, 0.045), (0.19, 0.27, 0.045), (-0.24, 0.18, 0.04), (0.24, 0.18, 0.04),
)
GULLS = ((3.4, 0.5, 0.0), (4.7, 0.62, 0.1), (1.2, 0.55, 0.14))  # angle, radius, z about the flock
# fmt: on


# ------------------------------------------------------------------------------------------------------------- backdrop


def paint_sky(height_m: float, radius: float, sun_at: tuple[float, float]) -> np.ndarray:
    """The painted sky: a morning gradient with broad rays about the sun, (384, 1024, 3) sRGB."""
    z = np.linspace(height_m, 0, 384)[:, None]
    arc = np.linspace(-np.radians(108), np.radians(108), 1024)[None] * radius
    noise = kit.soft_noise(np.random.default_rng(SEED), arc * 0.7, z * 1.2)
    stops = [(0.0, "#f4b393"), (0.9, "#f8d3a6"), (1.7, "#f3e3bf"), (2.6, "#b5d6cd"), (4.0, "#7fb9c2")]
    sky = kit.blend(stops, z + 0.06 * noise)
    angle = np.arctan2(z - sun_at[1], arc - sun_at[0])
    ray = np.clip(2.5 * np.sin(14 * angle), -1, 1)
    return sky * (1 + 0.035 * ray + 0.012 * noise)[..., None]


def paint_table(size: int = 768) -> np.ndarray:
    """The table top: a compass rose in warm sand tones, (size, size, 3) sRGB."""
    x, y = np.meshgrid(np.linspace(-1, 1, size), np.linspace(1, -1, size))
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    noise = kit.soft_noise(np.random.default_rng(SEED + 1), x * 5, y * 5)
    table = kit.blend([(0.0, "#d3ab8c"), (1.0, "#e2c3a0")], radius + 0.1 * noise)
    rays = np.clip(6 * np.sin(16 * angle), -1, 1) * (radius > 0.5)
    shade = 1 + np.where(radius < 0.645, 0.045, -0.03) * rays + 0.02 * noise
    ring = sum(np.clip((width / 2 - np.abs(radius - at)) * size / 2 + 0.5, 0, 1) for at, width in TABLE_RINGS)
    return table * shade[..., None] + ring[..., None] * (kit.blend([(0.0, "#f6e8cd")], radius) - table)


def build_backdrop(paints: kit.Paints) -> None:
    """Table, painted sky, three ranges of paper hills and a turning sun."""
    kit.curtain("Sky", 5.0, 0.0, 4.4, [kit.mural("Painted sky", paint_sky(4.4, 5.0, (0.9, 1.15)))])
    kit.ground("Table", 5.0, [kit.mural("Compass table", paint_table())])
    theta = kit.CURTAIN_ANGLES
    for name, radius, height, color, phase in HILLS:
        waves = 0.22 * np.sin(5 * theta + phase) + 0.13 * np.sin(11 * theta + 2 * phase) + 0.05 * np.sin(23 * theta)
        crest = height * (1 + waves)
        kit.curtain(f"Hills {name}", radius, 0.0, crest, [kit.paint(f"Hills {name}", color, grain=0.07, scale=2.5)])
    face = kit.empty("Sunrise", (0.86, 3.55, 1.2))
    rays = kit.plate("Sun rays", kit.star(0.86, 0.62, 16), 0.05, paints["mustard"], parent=face)
    kit.move(rays, spin=("", kit.turn(96)))
    kit.plate("Sun ring", kit.blob(0.56), 0.1, paints["cream"], parent=face, bevel=0.015)
    kit.plate("Sun face", kit.blob(0.46), 0.18, paints["coral"], parent=face, bevel=0.02)


def build_clouds(paints: kit.Paints) -> None:
    """Cut-out clouds that drift to and fro at different depths."""
    outline = kit.cloud_outline()
    for number, (x, y, z, size, phase) in enumerate(CLOUDS, 1):
        cut = [(a * size, b * size) for a, b in outline]
        cloud = kit.plate(f"Cloud {number}", cut, 0.1, paints["cream"], bevel=0.02, at=(x, y, z))
        kit.move(cloud, place=(f"{x}+0.16*sin{kit.turn(FRAMES, phase)}",))


# ------------------------------------------------------------------------------------------------------------------ sea


def build_sea(paints: kit.Paints) -> None:
    """A wooden tray and slices of sea whose crests travel, left and right by turns."""
    rim = [(0.0, 0.13), (2.17, 0.13), (2.17, 0.22), (2.4, 0.22), (2.43, 0.0)]
    colors = [kit.paint("Sea floor", SEA[0], grain=0.0), *paints.pick("wood", "cream")]
    tray_slot = (0, 0, 1, 2)
    kit.lathe("Tray", rim, colors, segments=96, slot=lambda ring, _: tray_slot[ring], smooth=False, bevel=0.03)
    edges = np.linspace(TRAY_RADIUS, -TRAY_RADIUS, SLICES + 1)
    for number, (back, front) in enumerate(itertools.pairwise(edges)):
        depth = 1 - number / (SLICES - 1)
        water = kit.paint(f"Sea {number}", SEA[round(depth * (len(SEA) - 1))], roughness=0.5, grain=0.09)
        build_slice(number, (front, back), SEA_LEVEL + 0.1 * depth, [water, paints["foam"]])


def build_slice(number: int, edges: tuple[float, float], level: float, materials: list[bpy.types.Material]) -> None:
    """One slice of sea between two chords of the tray, with a pale lip along its crest."""
    front, back = edges
    span = np.linspace(-1, 1, 97)
    lip = [(front, 0.0), (front, level - 0.045), (front - 0.012, level - 0.045), (front - 0.012, level)]
    top = [(y, level) for y in np.linspace(front, back, 5)]
    rows = []
    for y, z in lip + top:
        half = math.sqrt(max(TRAY_RADIUS**2 - max(abs(y), abs(front) * (z < level)) ** 2, 0.04))
        rows.append(np.c_[span * half, np.full_like(span, y), np.full_like(span, z)])
    slots = (0, 1, 1, 0, 0, 0, 0, 0)
    piece = kit.strip(f"Sea slice {number + 1:02d}", np.array(rows), materials, slots=slots)
    piece.data.polygons.foreach_set("use_smooth", np.repeat(np.arange(len(slots)) > 3, len(span) - 1))
    height = np.repeat(np.arange(len(rows)) > 0, len(span)) * 0.045
    way = 1 if number % 2 else -1
    x = np.concatenate(rows)[:, 0]
    kit.traveling_wave(piece, 2, height, way * (x * 2 * math.pi / WAVE_LENGTH + number * 2.2), FRAMES)


# ----------------------------------------------------------------------------------------------------------------- land


def build_hill(
    paints: kit.Paints, name: str, center: tuple[float, float], plates: dict[float, str], phase: float
) -> float:
    """A hill of stacked plates, given as radius: color; returns the height of its top."""
    z = 0.1
    for number, (radius, color) in enumerate(plates.items()):
        outline = kit.blob(radius, [(2, 0.12, phase), (3, 0.06, 2 * phase + number * 0.5), (5, 0.03, phase)])
        thickness = 0.26 if number == 0 else 0.13
        kit.slab(f"{name} {number + 1}", outline, thickness, paints[color], bevel=0.018, at=(*center, z))
        z += thickness
    return z


def build_lighthouse(paints: kit.Paints, at: kit.Point) -> None:
    """A striped tower with a turning lamp."""
    base = kit.empty("Lighthouse", at)
    profile = [(0.21 - 0.075 * t, 0.95 * t) for t in np.linspace(0, 1, 6)]
    kit.lathe("Tower", profile, paints.pick("coral", "cream"), slot=lambda ring, _: ring % 2, parent=base)
    gallery = [(0.1, 0.93), (0.2, 0.95), (0.2, 1.0), (0.1, 1.0)]
    kit.lathe("Gallery", gallery, [paints["navy"]], smooth=False, parent=base)
    glass = [kit.glow("Lamp", "#ffd77a", 0.9), paints["navy"]]
    panes = {"segments": 12, "slot": lambda _, i: i % 6 // 4, "smooth": False}
    lamp = kit.lathe("Lamp", [(0.115, 1.0), (0.115, 1.17)], glass, parent=base, **panes)
    kit.move(lamp, spin=("", "", kit.turn(FRAMES)))
    roof = [(0.17, 1.16), (0.165, 1.19), (0.06, 1.32), (0.03, 1.36), (0.0, 1.4)]
    kit.lathe("Lighthouse roof", roof, [paints["coral"]], parent=base)


def build_windmill(paints: kit.Paints, at: kit.Point) -> None:
    """A mill whose four sails turn 135 degrees in 12 frames."""
    base = kit.empty("Windmill", at)
    walls = {"segments": 8, "smooth": False, "bevel": 0.015}
    kit.lathe("Mill tower", [(0.25, 0.0), (0.17, 0.62)], [paints["cream"]], parent=base, **walls)
    cap = [(0.2, 0.6), (0.2, 0.65), (0.15, 0.76), (0.06, 0.84), (0.0, 0.86)]
    kit.lathe("Mill cap", cap, [paints["rose"]], parent=base)
    kit.box("Mill door", (0.11, 0.04, 0.2), paints["wood"], at=(0.0, -0.235, 0.0), parent=base)
    hub = kit.empty("Mill hub", (0.0, -0.27, 0.66), base)
    kit.move(hub, spin=("", kit.turn(32)))
    kit.plate("Mill axle", kit.blob(0.06, count=16), 0.16, paints["navy"], parent=hub, bevel=0.01)
    spar = [(-0.02, 0.03), (0.02, 0.03), (0.02, 0.58), (-0.02, 0.58)]
    sail = [(0.02, 0.15), (0.17, 0.15), (0.15, 0.57), (0.02, 0.57)]
    for quarter in range(4):
        arm = kit.empty(f"Mill arm {quarter + 1}", parent=hub)
        arm.rotation_euler[1] = quarter * math.pi / 2
        kit.plate(f"Mill spar {quarter + 1}", spar, 0.03, paints["wood"], parent=arm)
        color = paints["coral" if quarter % 2 else "mustard"]
        blade = kit.plate(f"Mill sail {quarter + 1}", sail, 0.025, color, parent=arm)
        blade.rotation_euler[2] = 0.25


def build_town(paints: kit.Paints) -> None:
    """Two islands with a lighthouse, a windmill, houses and trees."""
    west = build_hill(paints, "West hill", (-1.2, 0.72), {0.78: "sand", 0.64: "sage", 0.47: "meadow"}, 0.6)
    build_lighthouse(paints, (-1.22, 0.8, west))
    plates = {0.86: "sand", 0.72: "sage", 0.58: "meadow", 0.42: "sage"}
    east = build_hill(paints, "East hill", (1.12, 0.62), plates, 2.1)
    build_windmill(paints, (1.2, 0.72, east))
    gable = [(-0.15, 0.18), (0.15, 0.18), (0.0, 0.34)]
    for number, (x, y, color, turn) in enumerate(HOUSES, 1):
        base = kit.empty(f"House {number}", (x, y, 0.36))
        base.rotation_euler[2] = turn
        roof = paints["navy" if number % 2 else "plum"]
        kit.box(f"House walls {number}", (0.24, 0.2, 0.2), paints[color], parent=base, bevel=0.008)
        kit.plate(f"House roof {number}", gable, 0.25, roof, parent=base, bevel=0.008)
        kit.box(f"House door {number}", (0.07, 0.03, 0.11), paints["wood"], at=(0.0, -0.1, 0.0), parent=base)
    for number, (x, y, z, height) in enumerate(TREES, 1):
        profile = [(0.0, -0.02), (0.1, 0.04), (0.125, 0.12), (0.1, 0.26), (0.05, 0.36), (0.0, 0.42)]
        scaled = [(r * (0.6 + height), h * height / 0.42) for r, h in profile]
        kit.lathe(f"Tree {number}", scaled, [paints["pine"]], segments=16, at=(x, y, z))


# ---------------------------------------------------------------------------------------------------------------- boats


def hull(
    name: str, length: float, beam: float, height: float, materials: list[bpy.types.Material], parent: bpy.types.Object
) -> None:
    """A toy hull, bow to +X: bottom, side and rail colors, closed by a deck in the rail color."""
    along = np.linspace(-1, 1, 25)
    fullest = -0.2
    taper = np.where(along > fullest, (along - fullest) / 1.2, (along - fullest) / 1.25)
    width = beam / 2 * np.sqrt(np.clip(1 - taper**2, 0, 1))
    sheer = height * (1 + 0.3 * along**2 + 0.15 * along)
    sections = []
    for across, up in ((1.0, 1.0), (1.04, 0.78), (0.98, 0.72), (0.8, 0.3), (0.45, 0.0)):
        sections.append(np.c_[along * length / 2 * (0.86 + 0.14 * up), width * across, sheer * up])
    sections += [s * (1, -1, 1) for s in sections[::-1]]
    deck = sections[0] - (0, 0, 0.025)
    rows = np.array([*sections, deck * (1, -1, 1), deck])
    kit.strip(name, rows, materials, slots=(2, 2, 1, 0, 0, 0, 1, 2, 2, 2, 2), parent=parent, smooth=False)


def build_sailboat(paints: kit.Paints) -> None:
    """A boat on an oval course, once around in 48 frames, with breathing sails and a fluttering pennant."""
    (cx, cy), (rx, ry) = SAIL_PATH["center"], SAIL_PATH["radii"]
    angle = f"({SAIL_PATH['phase']:.6f}-frame*{2 * math.pi / FRAMES:.9f})"
    boat = kit.empty("Sailboat", (0, 0, SEA_LEVEL + 0.03))
    height = f"{SEA_LEVEL + 0.03}+0.02*sin{kit.turn(24)}"
    heading = f"atan2(-{ry}*cos{angle},{rx}*sin{angle})"
    kit.move(
        boat,
        place=(f"{cx}+{rx}*cos{angle}", f"{cy}+{ry}*sin{angle}", height),
        spin=(f"0.07*sin{kit.turn(24, 0.8)}", "", heading),
    )
    hull("Sailboat hull", 0.78, 0.3, 0.17, paints.pick("navy", "coral", "cream"), boat)
    kit.lathe("Mast", [(0.018, 0.1), (0.015, 1.02)], [paints["wood"]], segments=10, parent=boat)
    build_sail(paints, "Main sail", boat, foot=-0.36, top=0.98, bands=("cream", "mustard", "cream", "cream"))
    build_sail(paints, "Jib", boat, foot=0.32, top=0.84, bands=("cream", "cream", "coral", "cream"))
    along = np.linspace(0, 1, 13)
    rows = [np.c_[-0.26 * along, 0 * along, 1.0 + side * (0.05 - 0.0425 * along)] for side in (-1, 1)]
    pennant = kit.strip("Pennant", np.array(rows), [paints["coral"]], parent=boat, smooth=True)
    sway = np.tile(along, 2)
    kit.traveling_wave(pennant, 1, 0.05 * sway, 7 * sway, 12)


def build_sail(
    paints: kit.Paints, name: str, boat: bpy.types.Object, *, foot: float, top: float, bands: tuple[str, ...]
) -> None:
    """A triangular sail from the mast out to `foot`, striped upwards, filling and easing with the wind."""
    u, v = np.meshgrid(np.linspace(0, 1, 13), np.linspace(0, 0.97, 4 * len(bands) + 1))
    belly = np.sin(np.pi * np.minimum(u * 0.9 + 0.05, 1)) * (1 - v) ** 0.6
    rows = np.stack([(0.02 * np.sign(foot) + foot * u) * (1 - v), 0.1 * belly, 0.3 + (top - 0.3) * v], -1)
    keys = list(dict.fromkeys(bands))
    slots = np.repeat([keys.index(band) for band in bands], 4)
    sail = kit.strip(name, rows, paints.pick(*keys), slots=slots, parent=boat, smooth=True)
    fill = np.zeros((2, u.size, 3))
    fill[0, :, 1] = 0.07 * belly.ravel()
    fill[1, :, 0] = 0.02 * (u * v).ravel()
    kit.wave_keys(sail, fill[0], fill[1], 24)


def build_tug(paints: kit.Paints) -> None:
    """A tug that follows the rim and puffs: every puff grows, rises and is gone."""
    first, sweep = math.radians(TUG_PATH["first_deg"]), math.radians(TUG_PATH["sweep_deg"])
    angle = f"({first:.6f}+frame*{sweep / FRAMES:.9f})"
    tug = kit.empty("Tug", (0, 0, SEA_LEVEL + 0.02))
    kit.move(
        tug,
        place=(f"{TUG_PATH['radius']}*cos{angle}", f"{TUG_PATH['radius']}*sin{angle}"),
        spin=("", f"0.06*sin{kit.turn(24, 2.0)}", f"{math.pi / 2:.6f}+{angle}"),
    )
    hull("Tug hull", 0.56, 0.27, 0.15, paints.pick("coral", "navy", "cream"), tug)
    kit.box("Tug cabin", (0.2, 0.17, 0.16), paints["cream"], at=(0.05, 0, 0.13), parent=tug, bevel=0.012)
    kit.box("Tug roof", (0.25, 0.21, 0.035), paints["coral"], at=(0.05, 0, 0.29), parent=tug, bevel=0.01)
    funnel = kit.lathe(
        "Tug funnel", [(0.055, 0.13), (0.055, 0.3), (0.06, 0.36)], paints.pick("mustard", "navy"), slot=lambda i, _: i
    )
    funnel.parent, funnel.location = tug, (-0.14, 0, 0)
    for number, born in enumerate(PUFFS_BORN, 1):
        at_birth = first + born * sweep / FRAMES
        reach = TUG_PATH["radius"]
        x, y = reach * math.cos(at_birth), reach * math.sin(at_birth)
        puff = kit.ball(f"Puff {number}", 0.11, paints["smoke"], at=(x + 0.08, y + 0.12, 0.62))
        life = ((0, 0.0), (1, 0.35), (3, 0.9), (11, 1.15), (12, 0.5), (13, 0.0))
        kit.pop(puff, [(born + age, size) for age, size in life])
        kit.move(puff, place=(f"{x + 0.08:.4f}-0.012*(frame-{born})", "", f"0.62+0.03*(frame-{born})"))


# ------------------------------------------------------------------------------------------------ whale, balloon, gulls


def build_whale(paints: kit.Paints) -> None:
    """A glossy whale that beats its tail; its spout bursts open at frame 5."""
    whale = kit.empty("Whale", (1.2, -0.85, SEA_LEVEL + 0.06))
    swim = kit.turn(FRAMES, 0.5)
    kit.move(
        whale,
        place=(f"1.16+0.16*cos{swim}", "", f"{SEA_LEVEL + 0.05}+0.05*sin{swim}"),
        spin=("", f"0.14*cos{swim}"),
    )
    whale.rotation_euler[2] = 0.35
    stations = np.array([-0.42, -0.415, -0.39, -0.33, -0.2, -0.05, 0.12, 0.26, 0.36, 0.42, 0.47, 0.53, 0.56])
    wide = np.array([0.0, 0.07, 0.12, 0.17, 0.21, 0.205, 0.15, 0.085, 0.05, 0.07, 0.15, 0.19, 0.17])
    tall = np.array([0.0, 0.07, 0.12, 0.165, 0.2, 0.19, 0.13, 0.075, 0.04, 0.028, 0.022, 0.018, 0.01])
    rise = np.array([0.0, 0.0, 0.0, 0.01, 0.02, 0.03, 0.06, 0.12, 0.19, 0.24, 0.28, 0.31, 0.32])
    around = np.linspace(-np.pi / 2, 1.5 * np.pi, 25)
    rows = np.array([np.c_[stations, wide * np.cos(a), rise + tall * np.sin(a)] for a in around])
    slots = [1 if math.sin(a + np.pi / 24) < -0.25 else 0 for a in around[:-1]]
    body = kit.strip("Whale body", rows, paints.pick("whale", "cream"), slots=slots, smooth=True, parent=whale)
    bend = np.zeros((2, rows.shape[0] * rows.shape[1], 3))
    reach = np.tile(np.clip((stations + 0.05) / 0.6, 0, None) ** 2, len(around))
    bend[0, :, 2], bend[1, :, 1] = 0.12 * reach, 0.04 * reach
    kit.wave_keys(body, bend[0], bend[1], 24)
    for side in (-1, 1):
        kit.ball(f"Whale eye {side}", 0.028, paints["cream"], at=(-0.3, side * 0.165, 0.07), parent=whale)
        fin = kit.ball(f"Whale fin {side}", 0.13, paints["whale"], at=(-0.08, side * 0.23, -0.02), parent=whale)
        fin.scale, fin.rotation_euler = (0.6, 1.0, 0.22), (-side * 0.5, 0.2, 0.0)
    spout = kit.empty("Spout", (-0.18, 0.0, 0.2), whale)
    for number, (x, z, radius) in enumerate(SPOUT, 1):
        drop = kit.ball(f"Spout drop {number}", radius, paints["foam"], at=(x, 0.0, z), parent=spout)
        kit.pop(drop, [(4, 0.0), (5, 0.6), (7, 1.0), (22, 1.05), (25, 0.5), (26, 0.0)])
    kit.pop(spout, [(4, 0.3), (5, 0.6), (7, 1.0), (22, 1.1), (26, 0.7)])


def build_balloon(paints: kit.Paints) -> None:
    """A glossy striped balloon that floats on an arc and turns as it goes."""
    balloon = kit.empty("Balloon", (-0.3, 0.5, 1.68))
    drift = kit.turn(FRAMES, -0.7)
    kit.move(
        balloon,
        place=(f"-0.32+0.42*sin{drift}", f"0.35+0.2*cos{drift}", f"1.66+0.1*sin{kit.turn(FRAMES, 0.9)}"),
        spin=("", "", kit.turn(FRAMES)),
    )
    t = np.linspace(0, 1, 22)
    radius = 0.37 * np.sin(np.pi * t**0.78) ** 0.8 * (1 - 0.04 * t) + 0.075 * (1 - t) ** 3
    profile = [(max(r, 0.001), -0.46 + 0.86 * h) for r, h in zip(radius, t, strict=True)]
    gores = (0, 1, 2, 1)
    kit.lathe(
        "Envelope",
        profile,
        paints.pick("coral", "cream", "mustard", "navy"),
        segments=48,
        slot=lambda ring, i: 3 if ring in (0, 1, 20) else gores[i // 4 % 4],
        parent=balloon,
    )
    kit.lathe("Skirt", [(0.07, -0.46), (0.055, -0.56)], [paints["cream"]], segments=16, parent=balloon)
    basket = kit.lathe("Basket", [(0.065, -0.68), (0.085, -0.56)], [paints["wood"]], segments=16, bevel=0.01)
    basket.parent = balloon


def build_gulls(paints: kit.Paints) -> None:
    """Three paper gulls that circle the lighthouse with beating wings."""
    flock = kit.empty("Gulls", (-1.4, 0.7, 1.98))
    kit.move(flock, spin=("", "", kit.turn(96)))
    for number, (angle, radius, z) in enumerate(GULLS, 1):
        gull = kit.empty(f"Gull {number}", (radius * math.cos(angle), radius * math.sin(angle), z), flock)
        gull.rotation_euler[2] = angle + math.pi / 2
        span = np.linspace(-1, 1, 13)
        chord = 0.095 * (1 - 0.75 * np.abs(span))
        rows = np.array([np.c_[side * chord - 0.06 * span**2, 0.24 * span, 0.05 * np.abs(span)] for side in (-1, 1)])
        wings = kit.strip(f"Wings {number}", rows, [paints["foam"]], parent=gull)
        beat = np.zeros((2, rows[..., 0].size, 3))
        beat[0, :, 2] = 0.14 * np.tile(span**2, 2)
        kit.wave_keys(wings, beat[0], beat[1], 12, phase=number * 1.9)
        body = kit.ball(f"Gull body {number}", 0.04, paints["foam"], stretch=3.0, parent=gull)
        body.rotation_euler[1] = math.pi / 2


def build() -> bpy.types.Scene:
    """Build the whole scene in the running Blender and return it."""
    scene = kit.start(FRAMES)
    paints = kit.Paints(COLORS, GLOSS)
    build_backdrop(paints)
    build_clouds(paints)
    build_sea(paints)
    build_town(paints)
    build_sailboat(paints)
    build_tug(paints)
    build_whale(paints)
    build_balloon(paints)
    build_gulls(paints)
    kit.sky(scene, "#ffe9d2", "#cfe4f2", 0.75)
    kit.sun("#fff0d8", 3.0, 46, -38, 9)
    kit.camera(scene, TARGET, **CAMERA)
    scene.frame_set(1)
    return scene


if __name__ == "__main__":
    kit.write(__file__, build)
