# SPDX-License-Identifier: GPL-3.0-or-later
"""The evaluation of Spacetime Gaussians against the paper's equations, written out one Gaussian at a time."""

import math

import numpy as np
import pytest
from holoreel.core.gaussians.model import ROWS, SpacetimeGaussians, concatenate, logit, sigmoid
from hypothesis import given
from hypothesis import strategies as st


def paper(model: SpacetimeGaussians, row: int, time: float) -> dict[str, list[float]]:
    """Eqs. 7 to 10 for one Gaussian, in plain Python floats."""
    dt = time - float(model.trbf_centers[row])
    m = model.motions[row].tolist()
    mean = [float(model.means[row, a]) + m[0][a] * dt + m[1][a] * dt**2 + m[2][a] * dt**3 for a in range(3)]
    quat = [float(q) + float(w) * dt for q, w in zip(model.quats[row], model.omegas[row], strict=True)]
    length = math.sqrt(sum(q * q for q in quat))
    width = math.exp(float(model.trbf_log_scales[row]))
    opacity = 1.0 / (1.0 + math.exp(-float(model.opacity_logits[row]))) * math.exp(-((dt / width) ** 2))
    features = model.features[row].tolist()
    return {
        "means": mean,
        "quats": [q / length for q in quat],
        "scales": [math.exp(float(s)) for s in model.log_scales[row]],
        "opacities": [opacity],
        "features": features[:6] + [f * dt for f in features[6:]],
    }


@pytest.mark.parametrize("features", [3, 9])
def test_evaluation_is_the_papers(random_model, features):
    model = random_model(40, seed=3, features=features)
    for time in (-0.2, 0.0, 0.37, 1.0):
        evaluated = model.evaluate(time)
        for row in range(len(model)):
            for name, expected in paper(model, row, time).items():
                actual = getattr(evaluated, name)
                assert actual.dtype == np.float32
                np.testing.assert_allclose(np.atleast_1d(actual[row]), expected, rtol=2e-7, atol=1e-30, err_msg=name)
        assert evaluated.alive.tolist() == [i for i in range(40) if paper(model, i, time)["opacities"][0] >= 1 / 255]


def test_zero_quaternions_mean_no_rotation(random_model):
    model = random_model(3)
    model.quats[1] = model.omegas[1] = 0.0
    model.quats[2] = 0.0  # turns with omega alone, and is at rest at its center
    at_center = model.evaluate(float(model.trbf_centers[2])).quats
    np.testing.assert_array_equal(at_center[1:], [[1, 0, 0, 0], [1, 0, 0, 0]])
    later = model.evaluate(float(model.trbf_centers[2]) + 0.5).quats[2]
    np.testing.assert_allclose(later, model.omegas[2] / np.linalg.norm(model.omegas[2]), rtol=1e-6)


@given(st.floats(-3.0, 3.0), st.floats(-38.0, 50.0), st.floats(-200.0, 200.0))
def test_evaluation_stays_finite(time, log_width, opacity_logit):
    model = SpacetimeGaussians(
        [[0, 0, 0]], np.ones((1, 3, 3)), [[0, 0, 0, 1e-30]], np.zeros((1, 4)), [[29.0, -500.0, 0.0]], [opacity_logit],
        [[1, 2, 3]], [0.5], [log_width],
    )  # fmt: skip
    assert not model.bad_rows().any()
    evaluated = model.evaluate(time)
    for name in ("means", "quats", "scales", "opacities", "features"):
        assert np.isfinite(getattr(evaluated, name)).all(), name
    assert 0.0 <= evaluated.opacities[0] <= 1.0
    assert np.linalg.norm(evaluated.quats) == pytest.approx(1.0)


def test_bounds_hold_what_is_seen_and_no_more(random_model):
    model = random_model(300, seed=5)
    low, high = model.bounds(0.2, 0.9)
    boxes = []
    for time in np.linspace(0.2, 0.9, 701):
        evaluated = model.evaluate(time)
        seen = evaluated.means[evaluated.alive]
        boxes.append([seen.min(0), seen.max(0)])
    seen_low, seen_high = np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)
    assert (seen_low >= low - 1e-5).all()
    assert (seen_high <= high + 1e-5).all()
    np.testing.assert_allclose([low, high], [seen_low, seen_high], atol=5e-3)


def test_bounds_reach_the_turning_point_of_a_path(random_model):
    model = random_model(1)
    model.means[:], model.motions[:], model.trbf_centers[:] = 0.0, 0.0, 0.0
    model.opacity_logits[:], model.trbf_log_scales[:] = 5.0, 10.0
    model.motions[0, :, 0] = 0.0, 1.0, -1.0  # dt² - dt³ has its top, 4/27, at 2/3
    model.motions[0, :, 1] = 1.0, -1.0, 0.0  # dt - dt² has its top, 1/4, at 1/2
    np.testing.assert_allclose(model.bounds(), [[0, 0, 0], [4 / 27, 1 / 4, 0]], atol=1e-7)


def test_bounds_of_nothing_visible(random_model):
    model = random_model(4)
    model.opacity_logits[:] = -20.0
    assert model.bounds() is None


def test_take_and_concatenate_keep_rows_together(telling_model):
    model = telling_model()
    joined = concatenate([model.take([4, 5, 6]), model.take(slice(0, 4))])
    back = joined.take(np.argsort(joined.means[:, 0]))
    for name in ROWS:
        np.testing.assert_array_equal(getattr(back, name), getattr(model, name), err_msg=name)
    with pytest.raises(ValueError, match="variant"):
        concatenate([model, telling_model(2, 3)])


def test_wrong_shapes_are_named(random_model):
    arrays = vars(random_model(5))
    for name in ROWS:
        if name != "means":
            with pytest.raises(ValueError, match=name):
                SpacetimeGaussians(**{**arrays, name: arrays[name][:4]})
    with pytest.raises(ValueError, match="features"):
        SpacetimeGaussians(**{**arrays, "features": np.zeros((5, 4))})


@pytest.mark.parametrize("name", ROWS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
def test_bad_rows_are_found_in_every_parameter(random_model, name, value):
    model = random_model(10)
    getattr(model, name).reshape(10, -1)[7, -1] = value
    assert np.flatnonzero(model.bad_rows()).tolist() == [7]
    assert any(name in sentence and sentence.startswith("1 row ") for sentence in model.problems())
    good = model.without_bad_rows()
    assert len(good) == 9
    assert not good.bad_rows().any()


def test_problems_are_said(random_model):
    model = random_model(50)
    model.opacity_logits[:] = 3.0
    assert model.problems() == []
    model.quats[:3] = model.omegas[:3] = 0.0
    model.trbf_log_scales[5:7] = -10.0
    model.trbf_centers[8], model.trbf_log_scales[8] = 40.0, 0.0
    model.log_scales[9, 1] = 8.0
    said = " ".join(model.problems())
    for words in ("3 rows with zero quat", "2 rows with a temporal width", "1 row with a life", "1 row with a scale"):
        assert words in said


def test_an_empty_model_is_a_model(random_model):
    model = random_model(5).take([])
    assert len(model) == len(model.evaluate(0.5)) == 0
    assert model.bounds() is None
    assert model.problems() == []


@given(st.floats(0.001, 0.999))
def test_logit_inverts_sigmoid(probability):
    assert sigmoid(logit(np.float64(probability))) == pytest.approx(probability)
