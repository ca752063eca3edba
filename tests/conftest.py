# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures for every room's tests. Needs numpy and pytest only: Blender's Python loads this file too."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.gaussians.model import SpacetimeGaussians

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """`shared_data("folder/file")` is the path of third-party data; the test is skipped where it is absent."""

    def find(name: str) -> Path:
        path = SHARED_DATA / name
        if not path.exists():
            pytest.skip(f"../shared/data/{name} is absent")
        return path

    return find


def make_model(count: int = 100, seed: int = 0, features: int = 3) -> SpacetimeGaussians:
    """Return random Gaussians of middling sizes and lives in front of a camera at the origin that looks along +z."""
    random = np.random.default_rng(seed)
    return SpacetimeGaussians(
        means=random.uniform([-1, -1, 3], [1, 1, 6], (count, 3)),
        motions=random.normal(0, [[0.5], [0.3], [0.2]], (count, 3, 3)),
        quats=random.normal(size=(count, 4)),
        omegas=random.normal(0, 0.5, (count, 4)),
        log_scales=random.uniform(-4, -1.5, (count, 3)),
        opacity_logits=random.normal(0, 2, count),
        features=random.random((count, features)),
        trbf_centers=random.random(count),
        trbf_log_scales=random.uniform(-3, 1, count),
    )


@pytest.fixture(scope="session")
def random_model() -> Callable[..., SpacetimeGaussians]:
    """`random_model(count=100, seed=0, features=3)` makes a small random model."""
    return make_model


def make_telling_model(count: int = 7, features: int = 9) -> SpacetimeGaussians:
    """Return Gaussians whose values encode their place: the float at column c of row r is (100 r + c) / 64.

    Columns are counted over all parameters in the model's order, so that swapped rows, fields or components all show.
    The division is exact and keeps the scales in their allowed range.
    """
    shapes = {"means": (3,), "motions": (3, 3), "quats": (4,), "omegas": (4,), "log_scales": (3,), "opacity_logits": (),
              "features": (features,), "trbf_centers": (), "trbf_log_scales": ()}  # fmt: skip
    arrays, column = {}, 0
    for name, shape in shapes.items():
        size = int(np.prod(shape, dtype=int))
        places = 100 * np.arange(count)[:, None] + column + np.arange(size)
        arrays[name] = (places / 64.0).reshape(count, *shape)
        column += size
    return SpacetimeGaussians(**arrays)


@pytest.fixture(scope="session")
def telling_model() -> Callable[..., SpacetimeGaussians]:
    """`telling_model(count=7, features=9)` makes a model whose values encode their place."""
    return make_telling_model
