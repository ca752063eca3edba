# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing listed rows alone: the same picture, to the last bit, at frames, between them and outside the segment."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera, read_camera
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.player import GaussianPlayer
from holoreel.core.render import cpu, reference
from holoreel.core.render.contract import DensityStats, Rules, SpacetimeTensors, listed
from holoreel.core.render.lifetimes import Lifetimes
from holoreel.core.render.scenes import random_scene
from holoreel.core.render.view import DecoderTensors, render_view

FRAMES = 25
TIMES = (0.0, 7 / FRAMES, np.nextafter(7 / FRAMES, 0), 0.3141, 24 / FRAMES, 0.999, 1.0, 1.5, -0.7)


def brief_scene(channels: int = 3) -> tuple[SpacetimeTensors, Camera]:
    """Short lives, in all places of the timeline and beyond; some rows never seen, always on, or not finite."""
    gaussians, camera = random_scene(6000, 120, 88, channels, seed=6)
    generator = torch.Generator().manual_seed(7)
    gaussians.trbf_centers[:] = 2 * torch.rand(6000, generator=generator) - 0.5
    gaussians.trbf_log_scales[:] = -5 + 3 * torch.rand(6000, generator=generator)
    gaussians.trbf_log_scales[:50] = math.inf
    gaussians.trbf_log_scales[50:60], gaussians.trbf_centers[60:70] = math.nan, math.nan
    gaussians.opacity_logits[70:500] = math.log((1 / 255) / (254 / 255))  # at the threshold itself
    gaussians.opacity_logits[500:900] = -9.0
    gaussians.opacity_logits[900:910] = math.nan
    return gaussians, camera


def test_lists_hold_all_that_is_alive_and_little_more() -> None:
    gaussians, _ = brief_scene()
    lifetimes = Lifetimes(gaussians, FRAMES, Rules().alpha_min)
    for time in TIMES:
        rows = lifetimes.rows(float(time))
        assert rows.dtype == torch.int32
        assert (rows.diff() > 0).all()
        alive = reference.alive(SpacetimeTensors(*(array.double() for array in gaussians)), float(time), Rules())
        assert torch.isin(alive, rows).all()
        assert lifetimes.rows(float(time)) is rows
    # What is listed is alive at some time of the frame: no later than a tenth of a life away from either end.
    moments = torch.linspace(7 / FRAMES, 8 / FRAMES, 41).tolist()
    ever = torch.cat([reference.alive(gaussians, moment, Rules()) for moment in moments]).unique()
    assert len(ever) <= len(lifetimes.rows(7.5 / FRAMES)) <= 1.03 * len(ever)


def test_few_lists_are_kept() -> None:
    lifetimes = Lifetimes(brief_scene()[0], 3, Rules().alpha_min)
    first = lifetimes.rows(0.1)
    for time in (0.4, 0.7, 1.2):
        lifetimes.rows(time)
    assert lifetimes.rows(0.1) is not first
    assert torch.equal(lifetimes.rows(0.1), first)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
@pytest.mark.parametrize("full", [False, True])
def test_listed_rows_make_the_same_picture(model: str, full: bool) -> None:
    gaussians, camera = brief_scene(9 if full else 3)
    if model == "OPENCV":
        c = camera
        camera = Camera(
            c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.world_to_camera, model=model, distortion=(-0.1, 0.02, 0.0, 0.0)
        )
    generator = torch.Generator().manual_seed(8)
    decoder = DecoderTensors(torch.randn(6, 12, generator=generator), torch.randn(3, 6, generator=generator), "sigmoid")
    lifetimes = Lifetimes(gaussians, FRAMES, Rules().alpha_min)
    pictures = []
    for time in map(float, TIMES):
        arguments = (cpu, gaussians, time, camera, None, decoder if full else None)
        with torch.no_grad():
            whole = render_view(*arguments)
            short = render_view(*arguments, rows=lifetimes.rows(time))
        assert all(torch.equal(a, b) for a, b in zip(short, whole, strict=True))
        assert whole.alpha.max() > 0.1
        pictures.append(whole.features)
    assert all(not torch.equal(a, b) for a, b in pairwise(pictures[:2] + pictures[3:]))


@pytest.mark.parametrize("backend", [cpu, reference])
def test_a_list_means_these_rows_alone(backend) -> None:
    """Also with gradients, and for any number of threads."""
    gaussians, camera = random_scene(5000, 64, 48, 3, seed=9)
    rows = torch.arange(1, 5000, 2, dtype=torch.int32)
    expected = backend.rasterize_spacetime(listed(gaussians, rows), 0.4, camera)
    with torch.no_grad():
        ours = backend.rasterize_spacetime(gaussians, 0.4, camera, rows=rows)
    assert all(torch.equal(a, b) for a, b in zip(ours, expected, strict=True))
    nothing = backend.rasterize_spacetime(gaussians, 0.4, camera, rows=rows[:0])
    assert nothing.alpha.max() == 0
    learned = gaussians._replace(features=gaussians.features.clone().requires_grad_())
    backend.rasterize_spacetime(learned, 0.4, camera, rows=rows).features.sum().backward()
    assert learned.features.grad is not None
    assert learned.features.grad[1::2].abs().sum() > 0
    assert learned.features.grad[::2].abs().sum() == 0


def test_bad_lists_are_refused() -> None:
    gaussians, camera = random_scene(50, 40, 30, 3)
    for rows in (torch.arange(3), torch.zeros(2, 2, dtype=torch.int32)):
        with pytest.raises(ValueError, match="int32"):
            cpu.rasterize_spacetime(gaussians, 0.4, camera, rows=rows)
    for row in (50, -1):
        with pytest.raises(HoloreelError, match="row is not there"):
            cpu.rasterize_spacetime(gaussians, 0.4, camera, rows=torch.tensor([3, row], dtype=torch.int32))
    density = DensityStats(torch.zeros(50), torch.zeros(50, dtype=torch.int32), torch.zeros(50))
    with pytest.raises(ValueError, match="density"):
        cpu.rasterize_spacetime(gaussians, 0.4, camera, None, None, density, torch.zeros(1, dtype=torch.int32))


def test_the_player_lists_unless_all_shall_be_drawn(recording, monkeypatch) -> None:
    """What is timed as the authors draw must not profit from lists."""
    player = GaussianPlayer(recording.reel, "cpu")
    seen = []
    honest = cpu.rasterize_spacetime
    monkeypatch.setattr(cpu, "rasterize_spacetime", lambda *a, **k: seen.append(a[6]) or honest(*a, **k))
    camera = read_camera(recording.camera)
    pictures = [
        player.draw(camera, player.frame_start + 0.3, **options)
        for options in ({}, {"listed": False}, {"rules": Rules(cull_faded=False)}, {"rules": Rules(alpha_min=1e-3)})
    ]
    assert [rows is None for rows in seen] == [False, True, True, True]
    for picture in pictures[1:3]:
        assert all(np.array_equal(a, b) for a, b in zip(picture, pictures[0], strict=True))
