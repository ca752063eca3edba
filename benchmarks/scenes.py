# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the scenes of the ablation that need one part of the method more than the sample scenes do.

    PYTHON_WITH_BPY benchmarks/scenes.py box|vista|glaze OUT.blend

| scene | what it shows | what needs it |
|---|---|---|
| box | a crate with thin stripes tumbles, 135 degrees in 12 frames | polynomial rotation: long thin Gaussians turn |
| vista | a terrace before far mountains, 150 m away | guided sampling, once `thin_seeds.py` took the far seeds away |
| glaze | glazed vases on polished stone while day turns to night | feature splatting: color depends on view and time |

Like the sample scenes: closed-form motion, no randomness but seeded noise, the same script gives the same scene.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from holoreel.sample_scenes import kit
from mathutils import Vector

FRAMES = 12  # that the captures of the ablation take; motion goes on beyond
SEED = 5
TARGET = (0.0, 0.0, 0.95)
CAMERA = {"distance": 6.4, "down_deg": 11.0, "lens": 42.0}


def tiles(size: int, colors: tuple[str, str], count: int, seed: int) -> np.ndarray:
    """A checkered floor, each tile a little different, with joints; (size, size, 3) sRGB."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(*[np.linspace(0, count, size, endpoint=False)] * 2)
    column, row = u.astype(int), v.astype(int)
    shade = rng.uniform(0.88, 1.06, (count, count))[row, column]
    picture = np.where(((column + row) % 2)[..., None], *(kit.blend([(0, c), (1, c)], 0 * u) for c in colors))
    joint = np.minimum(np.minimum(u % 1, 1 - u % 1), np.minimum(v % 1, 1 - v % 1)) < 0.035
    return picture * (shade * np.where(joint, 0.62, 1.0))[..., None]


def dusk(size: tuple[int, int], stops: list[tuple[float, str]], seed: int) -> np.ndarray:
    """A painted sky with drifting bands, top row first; (height, width, 3) sRGB."""
    height, width = size
    z, x = np.linspace(1, 0, height)[:, None], np.linspace(0, 9, width)[None]
    noise = kit.soft_noise(np.random.default_rng(seed), x * 0.8, z * 5)
    band = np.clip(2.5 * np.sin(16 * z + 0.8 * np.sin(1.7 * x) + 0.5 * noise), -1, 1)
    return kit.blend(stops, z + 0.03 * noise) * (1 + 0.045 * band)[..., None]


# ------------------------------------------------------------------------------------------------------------------ box


def crate_face(number: int, size: int = 512) -> np.ndarray:
    """One side of the crate: a frame, thin slanted stripes and a star, (size, size, 3) sRGB."""
    grounds = ("#f4e7c8", "#e9c46a", "#d9e5d6", "#f2b5a0", "#c7d8ea", "#e6d3ee")
    inks = ("#22405e", "#7b2d3f", "#1f5b4f", "#4a2f6b", "#8a3b12", "#263238")
    x, y = np.meshgrid(np.linspace(-1, 1, size), np.linspace(1, -1, size))
    slant = math.radians((25, -40, 70, -15, 50, -65)[number])
    across = x * math.cos(slant) + y * math.sin(slant)
    stripe = np.abs((across * 7.0) % 1.0 - 0.5) < 0.13
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    star = radius < 0.34 * (1 + 0.28 * np.cos(5 * angle))
    ring = np.abs(radius - 0.62) < 0.035
    edge = np.maximum(np.abs(x), np.abs(y))
    frame = (edge > 0.93) | (np.abs(edge - 0.84) < 0.02)
    ink = (stripe & (radius > 0.5) & (edge < 0.8)) | star | ring | frame
    one = np.zeros((size, size))
    return np.where(ink[..., None], *(kit.blend([(0, c), (1, c)], one) for c in (inks[number], grounds[number])))


def build_crate(half: float, parent: bpy.types.Object) -> None:
    """Six painted sides around the parent's origin."""
    axes = np.eye(3)
    for number in range(6):
        normal = axes[number // 2] * (1, -1)[number % 2]
        right = axes[(number // 2 + 1) % 3]
        up = np.cross(normal, right)
        corners = [[half * (normal + a * right + b * up) for a in (-1, 1)] for b in (-1, 1)]
        material = kit.mural(f"Crate {number + 1}", crate_face(number), roughness=0.8)
        kit.strip(f"Crate side {number + 1}", np.array(corners), [material], parent=parent)


def build_box() -> bpy.types.Scene:
    """A striped crate tumbles over a small stage, and two smaller ones spin beside it."""
    scene = kit.start(48)
    stops = [(0.0, "#f3d9b8"), (0.3, "#e8b7a0"), (0.65, "#a98fb5"), (1.0, "#6d77a8")]
    kit.curtain("Sky", 5.0, 0.0, 4.4, [kit.mural("Painted sky", dusk((256, 1024), stops, SEED))])
    kit.ground("Floor", 5.0, [kit.mural("Tiles", tiles(1024, ("#b9a58c", "#86735f"), 20, SEED))])
    stage = kit.paint("Stage", "#4f6d7a", grain=0.1)
    kit.lathe("Stage", [(1.7, 0.0), (1.7, 0.12), (1.6, 0.16)], [stage], segments=64, smooth=False, bevel=0.015)
    for place, half, tilt, period in (
        ((0.0, 0.0, 1.12), 0.52, (1.05, 0.3, 0.0), 32),
        ((-1.45, 0.5, 0.72), 0.27, (1.3, -0.4, 0.0), -24),
        ((1.45, 0.45, 0.78), 0.29, (1.2, 0.5, 0.0), 28),
    ):
        axle = kit.empty("Axle", place)
        axle.rotation_euler = tilt
        spinner = kit.empty("Spinner", parent=axle)
        kit.drive(spinner, "rotation_euler", kit.turn(period), 2)
        build_crate(half, spinner)
    kit.sky(scene, "#f5e3d0", "#b7c9ee", 0.8)
    kit.sun("#fff0dc", 2.6, 48, 35, 12)
    kit.camera(scene, TARGET, **CAMERA)
    return scene


# ---------------------------------------------------------------------------------------------------------------- vista


def mountains(height: int = 512, width: int = 3072) -> np.ndarray:
    """A far panorama: snowy ridges with crags, forests with single trees, fields in strips; (H, W, 3) sRGB."""
    rng = np.random.default_rng(SEED + 1)
    u, v = np.linspace(0, 24, width)[None], np.linspace(1, 0, height)[:, None]  # v is 0 at the foot
    crags = kit.soft_noise(rng, u * 4, v * 34)
    picture = kit.blend(
        [(0.4, "#dfeaf2"), (0.7, "#a9c8e6"), (1.0, "#6f9fd4")], v + 0.02 * kit.soft_noise(rng, u, v * 9)
    )
    ridges = (
        (0.62, 0.13, 1.1, [(-1.2, "#6c7690"), (0.2, "#8f97ac"), (0.5, "#f4f6fa")]),
        (0.45, 0.09, 1.9, [(-1.2, "#43566b"), (0.6, "#7d8b94"), (1.0, "#9ba7ab")]),
        (0.29, 0.05, 2.7, [(-1.2, "#27472f"), (0.0, "#3f6b3d"), (1.0, "#74935a")]),
    )
    for level, swing, pace, stops in ridges:
        crest = level + swing * kit.soft_noise(rng, u * pace, 0 * u) * 0.55 + 0.012 * kit.soft_noise(rng, u * 9, 0 * u)
        light = crags * 0.55 + 8 * (v - crest + 0.08)
        picture = np.where((v < crest)[..., None], kit.blend(stops, light), picture)
    rows = np.floor(u * 5 + 1.4 * np.sin(2 * u) + 6 * v)
    strips = (np.sin(rows * 12.9898) * 43758.5453) % 1
    fields = kit.blend([(0.0, "#8fae4f"), (0.35, "#d6c25e"), (0.7, "#6f9a4a"), (1.0, "#c99a58")], strips)
    furrow = 1 + 0.1 * np.sign(np.sin(u * 70 + 40 * v))
    return np.where(
        (v < 0.16 + 0.012 * kit.soft_noise(rng, u * 2, 0 * u))[..., None], fields * furrow[..., None], picture
    )


def build_vista() -> bpy.types.Scene:
    """A tiled terrace with pots and a turning weather vane; behind its rail, nothing until the mountains."""
    scene = kit.start(48)
    material = kit.mural("Mountains", mountains())
    radius = 150.0
    rise = np.linspace(-34.0, 62.0, 4)
    angles = kit.CURTAIN_ANGLES * 0.55
    heights = np.broadcast_to(rise[:, None], (4, len(angles)))
    across, away = radius * np.sin(angles), radius * np.cos(angles)
    rows = np.stack([np.broadcast_to(across, heights.shape), np.broadcast_to(away, heights.shape), heights], -1)
    far = kit.strip("Far mountains", rows, [material], smooth=True)
    shader = material.node_tree.nodes["Principled BSDF"]
    image = next(node for node in material.node_tree.nodes if node.type == "TEX_IMAGE")
    material.node_tree.links.new(image.outputs["Color"], shader.inputs["Emission Color"])
    shader.inputs["Emission Strength"].default_value = 0.75
    shader.inputs["Base Color"].default_value = (0, 0, 0, 1)
    for link in list(shader.inputs["Base Color"].links):
        material.node_tree.links.remove(link)
    material.cycles.emission_sampling = "NONE"
    far.visible_shadow = far.visible_diffuse = False

    floor = kit.mural("Terrace", tiles(768, ("#cbb08f", "#b3805f"), 12, SEED))
    kit.strip("Terrace", np.array([[[-4, -4.5, 0], [4, -4.5, 0]], [[-4, 1.6, 0], [4, 1.6, 0]]], float), [floor])
    stone = kit.paint("Stone", "#d8cdb8", grain=0.12)
    kit.box("Rail", (8.0, 0.18, 0.1), stone, at=(0, 1.5, 0.62), bevel=0.02)
    for number, x in enumerate(np.linspace(-3.8, 3.8, 16)):
        profile = [(0.09, 0.0), (0.045, 0.1), (0.08, 0.3), (0.04, 0.5), (0.08, 0.62)]
        kit.lathe(f"Baluster {number + 1}", profile, [stone], segments=14, at=(float(x), 1.5, 0))
    pots = (("#b5543a", -1.7, 0.4, 0.42), ("#3f7d7a", 1.6, 0.2, 0.5), ("#d9a441", -0.75, 0.9, 0.32))
    for number, (color, x, y, size) in enumerate(pots, 1):
        clay = kit.paint(f"Pot {number}", color, grain=0.15)
        leaf = kit.paint(f"Leaf {number}", "#4d7d43", grain=0.3, scale=9)
        profile = [(0.55, 0.0), (0.75, 0.5), (0.95, 1.0), (1.02, 1.0), (1.02, 1.15)]
        kit.lathe(f"Pot {number}", [(size * r, size * z) for r, z in profile], [clay], segments=32, at=(x, y, 0))
        kit.ball(f"Bush {number}", 1.05 * size, leaf, at=(x, y, 1.85 * size))
    pole = kit.paint("Pole", "#6b4a3a", grain=0.1)
    kit.lathe("Pole", [(0.035, 0.0), (0.03, 1.55)], [pole], segments=12, at=(0.55, 0.4, 0))
    vane = kit.empty("Vane", (0.55, 0.34, 1.55))
    kit.drive(vane, "rotation_euler", kit.turn(40), 1)
    for blade in range(6):
        color = kit.paint(f"Blade {blade + 1}", ("#e05a47", "#f7edd8")[blade % 2], grain=0.05)
        outline = [(0.0, 0.0), (0.17, 0.12), (0.12, 0.36), (0.0, 0.44)]
        leaf = kit.plate(f"Blade {blade + 1}", outline, 0.02, color, parent=vane)
        leaf.rotation_euler = (0.0, blade * math.pi / 3, 0.0)
    kit.sky(scene, "#eaf2fa", "#9dbfea", 0.9)
    kit.sun("#fff3dd", 2.8, 42, 30, 6)
    kit.camera(scene, (0.0, 0.0, 1.05), 6.0, 4.0, 38.0)
    return scene


# ---------------------------------------------------------------------------------------------------------------- glaze


def glazed(name: str, color: str, roughness: float, coat: float = 0.6) -> bpy.types.Material:
    """A deep color under a broad shine."""
    material = kit.paint(name, color, roughness=roughness, grain=0.1, scale=5.0)
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Specular IOR Level"].default_value = 0.9
    shader.inputs["Coat Weight"].default_value = coat
    shader.inputs["Coat Roughness"].default_value = roughness
    return material


def build_glaze() -> bpy.types.Scene:
    """Vases and a great bowl on polished stone; the sun fades in 12 frames while a blue and a red lamp come up."""
    scene = kit.start(48)
    stops = [(0.0, "#f7c98b"), (0.25, "#e98d6b"), (0.55, "#8c5f8c"), (1.0, "#3b4478")]
    kit.curtain("Sky", 5.0, 0.0, 4.4, [kit.mural("Painted dusk", dusk((256, 1024), stops, SEED + 2))])
    floor = kit.mural("Polished stone", 0.8 * tiles(1024, ("#9f9587", "#5b5a65"), 14, SEED), roughness=0.28)
    floor.node_tree.nodes["Principled BSDF"].inputs["Specular IOR Level"].default_value = 1.0
    kit.ground("Floor", 5.0, [floor])
    vase = [(0.3, 0.0), (0.52, 0.35), (0.62, 0.75), (0.5, 1.2), (0.24, 1.5), (0.3, 1.75), (0.34, 1.8)]
    things = (
        ("Vase 1", "#a83244", 0.3, vase, (-1.15, 0.1, 0.0), 0.95),
        ("Vase 2", "#1d7f8c", 0.25, vase, (1.2, 0.25, 0.0), 0.85),
        ("Bowl", "#46519c", 0.3, [(0.35, 0.0), (0.7, 0.25), (0.85, 0.6), (0.8, 0.95), (0.6, 1.2)], (0, -0.1, 0), 0.95),
        ("Small vase", "#b98e2f", 0.22, vase, (-0.45, -1.2, 0.0), 0.38),
        ("Small bowl", "#2f8a58", 0.25, [(0.3, 0.0), (0.62, 0.2), (0.72, 0.5), (0.5, 0.8)], (0.75, -1.15, 0), 0.45),
    )
    for name, color, roughness, profile, place, size in things:
        height = np.array(profile)
        fine = np.linspace(0, 1, 24)
        along = np.linspace(0, 1, len(profile))
        smooth = [(size * float(np.interp(s, along, height[:, 0])), size * float(np.interp(s, along, height[:, 1])))
                  for s in fine]  # fmt: skip
        kit.lathe(name, smooth, [glazed(name, color, roughness)], segments=48, at=place)
    pearl = kit.ball("Pearl", 0.3, glazed("Pearl", "#c9c2b4", 0.3), at=(0, -0.1, 1.35))
    kit.drive(pearl, "location", f"1.42+0.06*sin{kit.turn(24)}", 2)
    kit.sky(scene, "#cfa98f", "#5f6ea8", 0.55)
    dark = f"min(1,max(0,(frame-1)/{FRAMES - 1}))"
    sun = kit.sun("#ffd9a8", 3.4, 32, 55, 8)
    kit.drive(sun.data, "energy", f"4.2-3.8*{dark}")
    for name, color, place, strength in (
        ("Blue lamp", "#5f8dff", (-3.0, -2.4, 3.4), 600.0),
        ("Red lamp", "#ff7f5a", (3.2, -1.2, 1.8), 160.0),
    ):
        data = bpy.data.lights.new(name, "AREA")
        data.color, data.size = kit.linear_rgb(color), 1.6
        lamp = kit.link(bpy.data.objects.new(name, data), at=place)
        lamp.rotation_euler = (Vector(TARGET) - Vector(place)).to_track_quat("-Z", "Y").to_euler()
        kit.drive(data, "energy", f"{strength}*{dark}")
    kit.camera(scene, (0.0, 0.0, 0.8), 6.2, 14.0, 42.0)
    return scene


SCENES: dict[str, Callable[[], bpy.types.Scene]] = {"box": build_box, "vista": build_vista, "glaze": build_glaze}


def main() -> None:
    """Build one scene and save it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scene", choices=SCENES)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    SCENES[arguments.scene]().frame_set(1)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    kit.save(arguments.out.resolve())


if __name__ == "__main__":
    main()
