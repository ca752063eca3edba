# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene settings under which the look Splats gives the pictures a model was trained to give."""

import bpy

from . import compat, reels
from .nodes.show import DISPLAY

TRANSPARENT_BOUNCES = 1024  # surfaces that one ray may cross, a splat is one and a hull two; costs only where they are
ENOUGH_BOUNCES = 128  # fewer are seen
CLIP_START, CLIP_END = 0.01, 1e5


def setup_exact_render(scene: bpy.types.Scene) -> None:
    """Set the scene, its active camera and its reels up for exact rendering with the current engine.

    One sample through the middle of each pixel, nothing random, no color management, black and transparent background.
    Cycles and EEVEE are both set up; an engine of another kind is replaced by Cycles.
    """
    if scene.render.engine not in ("CYCLES", compat.eevee_engine()):
        scene.render.engine = "CYCLES"
    _setup_output(scene)
    _setup_cycles(scene)
    _setup_eevee(scene)
    if scene.camera is not None:
        setup_exact_camera(scene.camera.data)
    for candidate in scene.objects:
        modifier = reels.modifier_of(candidate)
        if modifier is not None:
            compat.set_input(modifier, "Color", DISPLAY)


def let_rays_through(scene: bpy.types.Scene) -> None:
    """Let the rays of Cycles pass through as many splats as they meet; a limit that is higher already stays."""
    cycles = scene.cycles
    cycles.transparent_max_bounces = max(cycles.transparent_max_bounces, TRANSPARENT_BOUNCES)
    # Without this, rays that have crossed some splats end at random.
    cycles.min_transparent_bounces = max(cycles.min_transparent_bounces, TRANSPARENT_BOUNCES)


def ends_rays_early(scene: bpy.types.Scene) -> bool:
    """Return whether the scene is rendered by Cycles with fewer transparent bounces than splats need."""
    if scene.render.engine != "CYCLES":
        return False
    return min(scene.cycles.transparent_max_bounces, scene.cycles.min_transparent_bounces) < ENOUGH_BOUNCES


def setup_exact_camera(camera: bpy.types.Camera) -> None:
    """Let a camera see everything, all of it sharp."""
    camera.clip_start = min(camera.clip_start, CLIP_START)
    camera.clip_end = max(camera.clip_end, CLIP_END)
    camera.dof.use_dof = False


def _setup_output(scene: bpy.types.Scene) -> None:
    render, view = scene.render, scene.view_settings
    render.film_transparent = True
    render.use_motion_blur = False
    render.dither_intensity = 0.0
    render.filter_size = 0.0  # EEVEE's pixel filter
    view.view_transform = "Raw"
    view.look = "None"
    view.exposure = 0.0
    view.gamma = 1.0
    view.use_curve_mapping = False


def _setup_cycles(scene: bpy.types.Scene) -> None:
    cycles = scene.cycles
    cycles.samples = 1
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 0.01
    cycles.max_bounces = 0
    let_rays_through(scene)
    cycles.sample_clamp_direct = 0.0
    cycles.film_exposure = 1.0


def _setup_eevee(scene: bpy.types.Scene) -> None:
    scene.eevee.taa_render_samples = 1
    scene.eevee.use_raytracing = False
    scene.eevee.use_shadows = False
