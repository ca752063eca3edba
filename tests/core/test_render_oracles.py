# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of another renderer: the test cases of Brush, whose images were made by gsplat.

What differs from our rules: the alpha cap is 0.999, and color comes from spherical harmonics of degree 3, plus 0.5, in
the direction from the camera to the Gaussian. The camera stands at (0.123, 0.456, -8), looks along +z and is 90 degrees
wide. Scales are logarithms, opacities logits, quaternions w x y z. The rest is the same: pixel centers at 0.5, low pass
0.3, cut at 1/255, stop at 1e-4, Jacobian clamp 1.3, black background; the fourth channel is alpha.
"""

import math

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.render import cpu, reference
from holoreel.core.render.contract import Rules

load_file = pytest.importorskip("safetensors.torch").load_file
POSITION = (0.123, 0.456, -8.0)


def harmonics(directions):
    """The 16 real spherical harmonics up to degree 3 at (N, 3) unit directions, with the signs 3D Gaussians use."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3 = math.sqrt(3 / math.pi) / 2, math.sqrt(15 / math.pi) / 2, math.sqrt(35 / (2 * math.pi)) / 4
    c4, c5, c6 = math.sqrt(105 / math.pi) / 2, math.sqrt(21 / (2 * math.pi)) / 4, math.sqrt(7 / math.pi) / 4
    columns = (
        *(torch.full_like(x, 1 / math.sqrt(4 * math.pi)), -c1 * y, c1 * z, -c1 * x),
        *(c2 * x * y, -c2 * y * z, c2 / (2 * math.sqrt(3)) * (2 * zz - xx - yy), -c2 * x * z, c2 / 2 * (xx - yy)),
        *(-c3 * y * (3 * xx - yy), c4 * x * y * z, -c5 * y * (4 * zz - xx - yy)),
        *(c6 * z * (2 * zz - 3 * xx - 3 * yy), -c5 * x * (4 * zz - xx - yy), c4 / 2 * z * (xx - yy)),
        -c3 * x * (xx - 3 * yy),
    )
    return torch.stack(columns, 1)


@pytest.mark.parametrize("backend", [cpu, reference], ids=["cpu", "reference"])
@pytest.mark.parametrize("name", ["basic_case", "tiny_case"])
def test_matches_the_picture_of_another_renderer(shared_data, backend, name):
    case = load_file(shared_data(f"rasterizer_oracles/{name}.safetensors"))
    height, width, _ = case["out_img"].shape
    pose = np.eye(4)
    pose[:3, 3] = -np.array(POSITION)
    camera = Camera(width, height, width / 2, width / 2, width / 2, height / 2, pose)
    directions = torch.nn.functional.normalize(case["means"] - torch.tensor(POSITION), dim=1)
    colors = (torch.einsum("nk,nkc->nc", harmonics(directions), case["coeffs"]) + 0.5).clamp(min=0)
    features, alpha, _ = backend.rasterize(
        case["means"],
        case["quats"],
        case["scales"].exp(),
        case["opacities"].sigmoid(),
        colors,
        camera,
        rules=Rules(alpha_max=0.999),
    )
    ours = torch.cat((features, alpha[..., None]), 2)
    psnr = -10 * math.log10(float((ours - case["out_img"]).square().mean()))
    assert psnr >= 100, psnr
