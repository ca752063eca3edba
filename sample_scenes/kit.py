# SPDX-License-Identifier: GPL-3.0-or-later
"""Small tools the sample scenes are built with: paints, shapes, motions, light and camera.

Runs inside Blender (bpy 4.5 or 5.x). Lengths are meters, angles radians unless a name says otherwise, Z is up, colors
are sRGB hex strings. Motion is closed-form drivers in `frame` (Blender evaluates these without running Python, so they
also play where auto-execution is off) and plain keyframes: nothing to bake, no caches, exact at sub-frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import bpy
import numpy as np

Point = tuple[float, float, float]
Outline = Sequence[tuple[float, float]]

TARGET_NAME = "Holoreel Target"
CURTAIN_ANGLES = np.radians(np.linspace(-108, 108, 145))  # about Z, 0 is straight behind the scene


def linear_rgb(color: str) -> tuple[float, float, float]:
    """Scene-linear RGB of an sRGB hex color such as "#e2614a" (IEC 61966-2-1)."""
    srgb = [int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in srgb)
    return red, green, blue


# --------------------------------------------------------------------------------------------------------------- paints


def use_nodes(owner: bpy.types.Material | bpy.types.World) -> None:
    """Give it a node tree: Blender 4.5 wants to be asked, 5.x has one from the start."""
    if owner.node_tree is None:
        owner.use_nodes = True


def paint(
    name: str, color: str, *, roughness: float = 0.8, grain: float = 0.1, scale: float = 6.0
) -> bpy.types.Material:
    """A Principled material whose color wanders by ±`grain` (relative) over blotches about 1/`scale` m wide."""
    material = bpy.data.materials.new(name)
    use_nodes(material)
    tree = material.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Specular IOR Level"].default_value = 0.5 if roughness < 0.5 else 0.0
    rgb = linear_rgb(color)
    material.diffuse_color = (*rgb, 1.0)
    if grain == 0.0:
        shader.inputs["Base Color"].default_value = (*rgb, 1.0)
        return material
    place = tree.nodes.new("ShaderNodeTexCoord")
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = scale
    noise.inputs["Detail"].default_value = 1.0
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    for stop, (position, gain) in zip(ramp.color_ramp.elements, ((0.3, 1.0 - grain), (0.7, 1.0 + grain)), strict=True):
        stop.position = position
        stop.color = (*(c * gain for c in rgb), 1.0)
    tree.links.new(place.outputs["Object"], noise.inputs["Vector"])
    tree.links.new(noise.outputs["Factor" if "Factor" in noise.outputs else "Fac"], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    return material


class Paints(dict[str, bpy.types.Material]):
    """A scene's materials by name, mixed on first use."""

    def __init__(self, colors: dict[str, str], gloss: dict[str, float]) -> None:
        """Take the colors by name, and the roughness of those that shine."""
        super().__init__()
        self.colors, self.gloss = colors, gloss

    def __missing__(self, name: str) -> bpy.types.Material:
        self[name] = paint(name.title(), self.colors[name], roughness=self.gloss.get(name, 0.8), grain=0.08)
        return self[name]

    def pick(self, *names: str) -> list[bpy.types.Material]:
        """Several paints at once."""
        return [self[name] for name in names]


def mural(name: str, srgb: np.ndarray, *, roughness: float = 0.9) -> bpy.types.Material:
    """A material showing a picture by UV: (H, W, 3) sRGB in [0, 1], top row first, packed into the .blend."""
    height, width, _ = srgb.shape
    image = bpy.data.images.new(name, width, height)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = np.clip(srgb[::-1], 0, 1)
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    image.pack()
    material = bpy.data.materials.new(name)
    use_nodes(material)
    tree = material.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Specular IOR Level"].default_value = 0.0
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    texture.extension = "EXTEND"
    tree.links.new(texture.outputs["Color"], shader.inputs["Base Color"])
    return material


def glow(name: str, color: str, strength: float) -> bpy.types.Material:
    """A lamp to look at; it is left out of light sampling, so it adds no noise."""
    material = paint(name, color, grain=0.0)
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Emission Color"].default_value = (*linear_rgb(color), 1.0)
    shader.inputs["Emission Strength"].default_value = strength
    material.cycles.emission_sampling = "NONE"
    return material


def soft_noise(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, waves: int = 24) -> np.ndarray:
    """Smooth wandering values of standard deviation about 1 over the plane (features about 1 unit wide)."""
    total = np.zeros(np.broadcast(x, y).shape)
    for kx, ky, phase in zip(*rng.normal(0, 3, (2, waves)), rng.uniform(0, 2 * np.pi, waves), strict=True):
        total += np.cos(kx * x + ky * y + phase)
    return total / math.sqrt(waves / 2)


def blend(stops: list[tuple[float, str]], where: np.ndarray) -> np.ndarray:
    """sRGB colors interpolated between (position, hex color) stops."""
    positions = [position for position, _ in stops]
    rgb = np.array([[int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)] for _, color in stops])
    return np.stack([np.interp(where, positions, rgb[:, c]) for c in range(3)], -1)


# --------------------------------------------------------------------------------------------------------------- shapes


def add_mesh(
    name: str,
    vertices: Iterable[Point] | np.ndarray,
    faces: Iterable[Sequence[int]],
    materials: Sequence[bpy.types.Material],
    *,
    slots: Sequence[int] | None = None,
    smooth: bool = False,
    bevel: float = 0.0,
    at: Point = (0.0, 0.0, 0.0),
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """A mesh object in the scene; `slots` gives each face its material, `bevel` rounds its sharp edges (meters)."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, v)) for v in vertices], [], [tuple(map(int, f)) for f in faces])
    for material in materials:
        mesh.materials.append(material)
    if slots is not None:
        mesh.polygons.foreach_set("material_index", np.asarray(slots, np.int32))
    mesh.polygons.foreach_set("use_smooth", np.full(len(mesh.polygons), smooth))
    thing = link(bpy.data.objects.new(name, mesh), at=at, parent=parent)
    if bevel:
        modifier = thing.modifiers.new("Soft edges", "BEVEL")
        modifier.width = bevel
        modifier.segments = 2
        modifier.limit_method = "ANGLE"
    return thing


def link(thing: bpy.types.Object, *, at: Point = (0, 0, 0), parent: bpy.types.Object | None = None) -> bpy.types.Object:
    """Put an object into the scene at a place (in its parent's space, if it has one)."""
    bpy.context.scene.collection.objects.link(thing)
    thing.location = at
    thing.parent = parent
    return thing


def empty(name: str, at: Point = (0, 0, 0), parent: bpy.types.Object | None = None) -> bpy.types.Object:
    """A handle that things hang on."""
    thing = link(bpy.data.objects.new(name, None), at=at, parent=parent)
    thing.empty_display_size = 0.15
    return thing


def slab(
    name: str, outline: Outline, thickness: float, material: bpy.types.Material, *, upright: bool = False, **options
) -> bpy.types.Object:
    """A plate cut along a counter-clockwise outline: lying on z = 0, or `upright`, facing -Y and centered on y = 0."""
    count = len(outline)
    flat = np.asarray(outline, float)
    low, high = (np.full(count, h) for h in ((-thickness / 2, thickness / 2) if upright else (0.0, thickness)))
    if upright:
        front, back = np.c_[flat[:, 0], low, flat[:, 1]], np.c_[flat[:, 0], high, flat[:, 1]]
        vertices, caps = np.r_[back, front], [list(range(count))[::-1], list(range(count, 2 * count))]
    else:
        vertices = np.r_[np.c_[flat, low], np.c_[flat, high]]
        caps = [list(range(count))[::-1], list(range(count, 2 * count))]
    sides = [(i, (i + 1) % count, count + (i + 1) % count, count + i) for i in range(count)]
    return add_mesh(name, vertices, caps + sides, [material], **options)


def plate(name: str, outline: Outline, thickness: float, material: bpy.types.Material, **options) -> bpy.types.Object:
    """A slab standing upright, facing the front camera."""
    return slab(name, outline, thickness, material, upright=True, **options)


def lathe(
    name: str,
    profile: Outline,
    materials: Sequence[bpy.types.Material],
    *,
    segments: int = 32,
    slot: Callable[[int, int], int] = lambda ring, segment: 0,
    ring: bool = False,
    smooth: bool = True,
    **options,
) -> bpy.types.Object:
    """Turn a profile of (radius, z), bottom to top, about Z; `slot(ring, segment)` picks each face's material.

    Both ends are capped, unless the profile is closed (counter-clockwise) into a `ring`.
    """
    profile = [*profile, profile[0]] if ring else profile
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    vertices = [(radius * math.cos(a), radius * math.sin(a), z) for radius, z in profile for a in angle]
    faces, slots = [], []
    for row in range(len(profile) - 1):
        low, high = row * segments, (row + 1) * segments
        for i in range(segments):
            j = (i + 1) % segments
            faces.append((low + i, low + j, high + j, high + i))
            slots.append(slot(row, i))
    if not ring:
        last = (len(profile) - 1) * segments
        faces += [tuple(range(segments))[::-1], tuple(range(last, last + segments))]
        slots += [slot(0, 0), slot(len(profile) - 2, 0)]
    return add_mesh(name, vertices, faces, materials, slots=slots, smooth=smooth, **options)


def ball_profile(radius: float, rings: int = 16, *, low: float = -1.0, high: float = 1.0) -> list[tuple[float, float]]:
    """Profile of a ball about the origin between the heights `low` and `high` (in radii)."""
    angles = np.linspace(math.asin(max(low, -0.9999)), math.asin(min(high, 0.9999)), rings)
    return [(radius * math.cos(a), radius * math.sin(a)) for a in angles]


def ball(
    name: str, radius: float, material: bpy.types.Material, *, stretch: float = 1.0, **options
) -> bpy.types.Object:
    """A ball, stretched along Z."""
    profile = [(r, z * stretch) for r, z in ball_profile(radius, options.pop("rings", 14))]
    return lathe(name, profile, [material], segments=options.pop("segments", 24), **options)


def box(name: str, size: Point, material: bpy.types.Material, **options) -> bpy.types.Object:
    """A box standing on its origin."""
    x, y, z = size[0] / 2, size[1] / 2, size[2]
    return slab(name, [(-x, -y), (x, -y), (x, y), (-x, y)], z, material, **options)


def star(outer: float, inner: float, points: int) -> list[tuple[float, float]]:
    """The outline of a star."""
    tips = [((outer, inner)[i % 2], i * math.pi / points) for i in range(2 * points)]
    return [(r * math.cos(a), r * math.sin(a)) for r, a in tips]


def blob(radius: float, wobble: Sequence[tuple[int, float, float]] = (), count: int = 64) -> list[tuple[float, float]]:
    """A round outline with a few harmonics (order, relative size, phase)."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    r = radius * (1 + sum(size * np.cos(order * angle + phase) for order, size, phase in wobble))
    return list(zip(r * np.cos(angle), r * np.sin(angle), strict=True))


def strip(
    name: str, rows: np.ndarray, materials: Sequence[bpy.types.Material], *, slots: np.ndarray | Sequence = 0, **options
) -> bpy.types.Object:
    """A sheet through rows of points, (rows, columns, 3), with UVs: u along the columns, v along the rows.

    `slots` are material slots: one for all, one per row of faces, or (rows - 1, columns - 1).
    """
    count, columns, _ = rows.shape
    index = np.arange(count * columns).reshape(count, columns)
    faces = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], -1).reshape(-1, 4)
    slots = np.asarray(slots)
    slots = np.broadcast_to(slots[:, None] if slots.ndim == 1 else slots, (count - 1, columns - 1))
    thing = add_mesh(name, rows.reshape(-1, 3), faces, materials, slots=slots.ravel(), **options)
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, count))
    layer = thing.data.uv_layers.new(name="UVMap")
    layer.uv.foreach_set("vector", np.stack([u, v], -1).reshape(-1, 2)[faces.ravel()].astype(np.float32).ravel())
    return thing


def curtain(
    name: str, radius: float, low: float, high: float | np.ndarray, materials: Sequence[bpy.types.Material]
) -> bpy.types.Object:
    """A wall bent around the scene's back, its upper edge level or given at CURTAIN_ANGLES."""
    heights = np.linspace(low + 0 * CURTAIN_ANGLES, high + 0 * CURTAIN_ANGLES, 4)
    across, away = radius * np.sin(CURTAIN_ANGLES), radius * np.cos(CURTAIN_ANGLES)
    rows = np.stack([np.broadcast_to(across, heights.shape), np.broadcast_to(away, heights.shape), heights], -1)
    return strip(name, rows, materials, smooth=True)


def ground(name: str, half: float, materials: Sequence[bpy.types.Material]) -> bpy.types.Object:
    """A square floor at z = 0."""
    corners = [[(-half, -half, 0.0), (half, -half, 0.0)], [(-half, half, 0.0), (half, half, 0.0)]]
    return strip(name, np.array(corners), materials)


def cloud_outline() -> list[tuple[float, float]]:
    """The outline of a paper cloud about 1.1 m wide with a flat foot."""
    puffs = [(-0.42, 0.05, 0.17), (-0.17, 0.14, 0.25), (0.15, 0.1, 0.22), (0.4, 0.02, 0.15)]
    x = np.linspace(-0.57, 0.55, 57)
    tops = [cz + np.sqrt(np.clip(r * r - (x - cx) ** 2, 0, None)) - 2 * ((x - cx) ** 2 > r * r) for cx, cz, r in puffs]
    top = np.maximum(np.max(tops, axis=0), -0.04)
    return [*zip(x, np.full_like(x, -0.06), strict=True), *zip(x[::-1], top[::-1], strict=True)]


# -------------------------------------------------------------------------------------------------------------- motions


def drive(owner: bpy.types.ID | bpy.types.ShapeKey, path: str, expression: str, index: int = -1) -> None:
    """Let a property follow an expression in `frame`."""
    curve = owner.driver_add(path, index)
    curve.driver.type = "SCRIPTED"
    curve.driver.expression = expression


def turn(period: float, phase: float = 0.0) -> str:
    """Driver text: an angle that makes one turn in `period` frames, `phase` radians at frame 0."""
    return f"(frame*{2 * math.pi / period:.9f}+{phase:.6f})"


def wave_keys(thing: bpy.types.Object, sine: np.ndarray, cosine: np.ndarray, period: float, phase: float = 0.0) -> None:
    """Deform a mesh by `sine`·sin + `cosine`·cos of time, offsets (vertices, 3): two shape keys, one traveling wave."""
    rest = np.array([v.co for v in thing.data.vertices])
    thing.shape_key_add(name="Rest")
    for name, offset, function in (("Sine", sine, "sin"), ("Cosine", cosine, "cos")):
        key = thing.shape_key_add(name=name)
        key.data.foreach_set("co", (rest + offset).astype(np.float32).ravel())
        key.slider_min = -1.0
        drive(key, "value", f"{function}{turn(period, phase)}")


def traveling_wave(
    thing: bpy.types.Object, axis: int, height: np.ndarray | float, argument: np.ndarray, period: float
) -> None:
    """Move vertices along an axis by `height`·sin(`argument` - time), with one value of both per vertex."""
    offsets = np.zeros((2, len(argument), 3))
    offsets[0, :, axis], offsets[1, :, axis] = -height * np.cos(argument), height * np.sin(argument)
    wave_keys(thing, offsets[0], offsets[1], period)


def move(thing: bpy.types.Object, *, place: Sequence[str] = (), spin: Sequence[str] = ()) -> None:
    """Drive location and Euler angles by expressions in `frame`, (x, y, z) each; an empty text leaves an axis alone."""
    for path, expressions in (("location", place), ("rotation_euler", spin)):
        for axis, expression in enumerate(expressions):
            if expression:
                drive(thing, path, expression, axis)


def pop(thing: bpy.types.Object, scales: Sequence[tuple[int, float]]) -> None:
    """Key a uniform scale at frames; a size of 0 also takes the thing out of the render."""
    for frame, size in scales:
        thing.scale = (max(size, 0.001),) * 3
        thing.keyframe_insert("scale", frame=frame)
        thing.hide_render = thing.hide_viewport = size == 0.0
        thing.keyframe_insert("hide_render", frame=frame)
        thing.keyframe_insert("hide_viewport", frame=frame)


# ----------------------------------------------------------------------------------------------------- light and camera


def start(frames: int = 48) -> bpy.types.Scene:
    """An empty scene with the look all sample scenes share: Cycles, few bounces, Standard view transform."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, frames
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.fps = 1280, 720, 24
    render.filepath = "//"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    cycles = scene.cycles
    cycles.samples = 96
    cycles.use_denoising = True
    cycles.denoising_prefilter = "FAST"
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 3, 2, 1
    cycles.use_fast_gi, cycles.ao_bounces_render = True, 1
    cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    return scene


def sky(scene: bpy.types.Scene, low: str, high: str, strength: float) -> None:
    """Soft light from all around: one color at the horizon, another overhead."""
    world = bpy.data.worlds.new("Soft sky")
    scene.world = world
    use_nodes(world)
    world.light_settings.distance = 2.0
    world.cycles.sampling_method = "NONE"  # so soft that aiming at its bright parts costs more than it saves
    tree = world.node_tree
    place = tree.nodes.new("ShaderNodeTexCoord")
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    for stop, color in zip(ramp.color_ramp.elements, (low, high), strict=True):
        stop.color = (*linear_rgb(color), 1.0)
    tree.links.new(place.outputs["Generated"], split.inputs["Vector"])
    tree.links.new(split.outputs["Z"], ramp.inputs["Fac"])
    background = tree.nodes["Background"]
    background.inputs["Strength"].default_value = strength
    tree.links.new(ramp.outputs["Color"], background.inputs["Color"])


def sun(color: str, strength: float, elevation_deg: float, azimuth_deg: float, size_deg: float) -> bpy.types.Object:
    """A sun `size_deg` wide; azimuth 0 is behind the front camera, positive to its right."""
    data = bpy.data.lights.new("Sun", "SUN")
    data.color, data.energy, data.angle = linear_rgb(color), strength, math.radians(size_deg)
    light = link(bpy.data.objects.new("Sun", data), at=(-2.0, -3.0, 4.0))
    light.rotation_euler = (math.radians(90 - elevation_deg), 0.0, math.radians(azimuth_deg))
    return light


def camera(scene: bpy.types.Scene, target: Point, distance: float, down_deg: float, lens: float) -> bpy.types.Object:
    """The front camera, looking at the target from -Y, and the empty that camera rigs aim at."""
    aim = empty(TARGET_NAME, target)
    data = bpy.data.cameras.new("Camera")
    data.lens = lens
    down = math.radians(down_deg)
    eye = (target[0], target[1] - distance * math.cos(down), target[2] + distance * math.sin(down))
    view = link(bpy.data.objects.new("Camera", data), at=eye)
    view.rotation_euler = (math.pi / 2 - down, 0.0, 0.0)
    data.dof.focus_object = aim
    scene.camera = view
    return view


def save(path: Path) -> None:
    """Write the open scene, compressed and without anything that lies outside the file."""
    bpy.data.orphans_purge(do_recursive=True)
    bpy.context.preferences.filepaths.save_version = 0
    for space in (space for screen in bpy.data.screens for area in screen.areas for space in area.spaces):
        if space.type == "FILE_BROWSER" and space.params:
            space.params.directory = b"//"  # Blender writes the user's home folder here
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True, relative_remap=True)


def write(script: str, build: Callable[[], bpy.types.Scene]) -> None:
    """Build a scene and save it beside its script, as `__file__` names it."""
    path = Path(script).with_suffix(".blend")
    build()
    save(path)
    print(f"wrote {path.name}: {path.stat().st_size / 1024:.0f} KiB")
