# SPDX-License-Identifier: GPL-3.0-or-later
"""The order in which Gaussians matter: what it promises, and what the first of them look like."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.gaussians.importance import importance, most_important_first
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.player import draw, to_tensors
from holoreel.core.reel import load_gaussians
from holoreel.core.render import get_backend
from holoreel.core.render.contract import Rules
from numpy.typing import NDArray

Model = Callable[..., SpacetimeGaussians]


def picture(model: SpacetimeGaussians) -> NDArray[np.float32]:
    """Draw a model as its first camera saw it."""
    camera = Camera(240, 180, 216, 216, 120, 90)
    return draw(to_tensors(model), 0.3, camera, get_backend("cpu"), (0, 0, 0), None, Rules(), None).image


def psnr(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Return the PSNR in dB."""
    return -10 * np.log10(np.mean((one - other) ** 2))


def test_half_of_a_real_model_looks_like_it(shared_data: Callable[[str], Path]) -> None:
    model = load_gaussians(shared_data("stg_splatv/spinach_4.splatv")).gaussians
    order = most_important_first([model])
    whole = picture(model)
    parts = [psnr(picture(model.take(order[: len(order) * percent // 100])), whole) for percent in (10, 25, 50, 75)]
    assert parts == sorted(parts)
    assert parts[2] > 33
    volume = np.argsort(-model.log_scales.sum(axis=1))
    assert parts[2] > psnr(picture(model.take(volume[: len(order) // 2])), whole) + 2


@pytest.mark.parametrize("change", ["opacity", "size", "life"])
def test_more_of_anything_matters_more(change: str, random_model: Model) -> None:
    less, more = random_model(200), random_model(200)
    if change == "opacity":
        more.opacity_logits += 0.1
    elif change == "size":
        more.log_scales += 0.1
    else:
        more.trbf_log_scales += 0.1
    assert np.all(importance(more) > importance(less))


def test_extremes_have_a_place(random_model: Model) -> None:
    model = random_model(8)
    model.trbf_log_scales[:4] = (1e30, -40, 16, 0)
    model.trbf_centers[4:6] = (1e6, -1e6)
    model.opacity_logits[6:8] = (-1e30, 1e30)
    model.log_scales[0] = 30
    values = importance(model)
    assert np.isfinite(values).all()
    assert sorted(most_important_first([model])) == list(range(8))


def test_segments_take_turns_by_their_sizes(random_model: Model) -> None:
    segments = [random_model(count, count) for count in (30, 60, 10)]
    order = most_important_first(segments)
    assert sorted(order) == list(range(100))
    of = np.repeat((0, 1, 2), (30, 60, 10))[order]
    for part in (10, 50, 90):
        assert np.bincount(of[:part], minlength=3) == pytest.approx(np.array([0.3, 0.6, 0.1]) * part, abs=1)
    alone = order[of == 1] - 30
    np.testing.assert_array_equal(alone, most_important_first([segments[1]]))
