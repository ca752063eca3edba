# SPDX-License-Identifier: GPL-3.0-or-later
"""Our reader and writer of COLMAP models against pycolmap, which runs in processes of its own."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.capture.colmap_model import MODELS, points_file, read_cameras, read_points3d, write_model
from holoreel.core.capture.points import Points
from holoreel.core.capture.rotations import (
    matrix_from_quaternion,
    matrix_from_vector,
    quaternion_from_matrix,
    vector_from_matrix,
)
from hypothesis import given
from hypothesis import strategies as st

# Writes a model with one camera per lens model, with points and observations, in both forms.
WRITE = """
import json, sys
import numpy as np
import pycolmap as pc

out, models = sys.argv[1], json.loads(sys.argv[2])
random = np.random.default_rng(7)
rec = pc.Reconstruction()
for number, (name, size) in enumerate(models.items(), start=1):
    focal = 1 if name.startswith("SIMPLE") or name.startswith("RADIAL") else 2
    terms = [0.01 * k for k in range(size - focal - 2)]
    parameters = [500.0 + number] * focal + [320.0 + number, 240.0 - number] + terms
    camera = pc.Camera(camera_id=number, model=name, width=640 + number, height=480, params=parameters)
    rec.add_camera_with_trivial_rig(camera)
    image = pc.Image(name=f"folder/{name} x.png", camera_id=number, image_id=number)
    image.points2D = pc.Point2DList([pc.Point2D(random.uniform(0, 400, 2)) for _ in range(5)])
    q = random.normal(size=4)
    pose = pc.Rigid3d(pc.Rotation3d(q / np.linalg.norm(q)), random.normal(size=3))
    rec.add_image_with_trivial_frame(image, pose)
for index in range(5):
    track = pc.Track()
    track.add_element(1, index)
    track.add_element(2, index)
    rec.add_point3D(random.normal(size=3), track, random.integers(0, 255, 3, dtype=np.uint8))
rec.write_binary(out + "/bin")
rec.write_text(out + "/txt")
found = {i.name: i.cam_from_world().matrix().tolist() for i in rec.images.values()}
points = [[*p.xyz, *map(int, p.color)] for _, p in sorted(rec.points3D.items())]
print(json.dumps({"poses": found, "points": points}))
"""

# Says what pycolmap finds in a model: per image its pose, lens and where it sees a point.
READ = """
import json, sys
import pycolmap as pc

rec = pc.Reconstruction(sys.argv[1])
images = {}
for image in rec.images.values():
    camera = rec.cameras[image.camera_id]
    seen = image.project_point([0.1, -0.2, 0.4])
    images[image.name] = {"model": camera.model.name, "size": [camera.width, camera.height],
                          "parameters": camera.params.tolist(), "pose": image.cam_from_world().matrix().tolist(),
                          "seen": list(seen)}
points = [[*p.xyz, *map(int, p.color)] for _, p in sorted(rec.points3D.items())]
print(json.dumps({"images": images, "points": points}))
"""


def pycolmap(script: str, *arguments: str) -> dict:
    done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("pycolmap")
    for kind in ("bin", "txt"):
        (folder / kind).mkdir()
    sizes = {name: len(model.parameters) for name, model in MODELS.items()}
    return folder, pycolmap(WRITE, str(folder), json.dumps(sizes))


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_what_pycolmap_wrote(written: tuple[Path, dict], kind: str) -> None:
    folder, truth = written
    cameras = read_cameras(folder / kind)
    assert set(cameras) == set(truth["poses"]) == {f"folder/{name} x.png" for name in MODELS}
    for number, (name, model) in enumerate(MODELS.items(), start=1):
        camera = cameras[f"folder/{name} x.png"]
        np.testing.assert_allclose(camera.world_to_camera[:3], truth["poses"][f"folder/{name} x.png"], atol=1e-12)
        assert (camera.model, camera.width, camera.height) == (model.ours, 640 + number, 480)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500 + number, 500 + number, 320 + number, 240 - number)
        terms = [0.01 * k for k in range(sum(parameter[0] in "kp" for parameter in model.parameters))]
        assert camera.distortion[: len(terms)] == pytest.approx(terms)
        assert not any(camera.distortion[len(terms) :])
    file = points_file(folder / kind)
    assert file is not None
    assert file.suffix == f".{kind}"
    points = read_points3d(file)
    np.testing.assert_allclose(points.xyz, np.array(truth["points"])[:, :3], rtol=1e-6)
    np.testing.assert_array_equal(points.rgb, np.array(truth["points"])[:, 3:])


DISTORTION = {
    "PINHOLE": (),
    "OPENCV": (0.1, -0.02, 0.003, -0.004),
    "OPENCV_FISHEYE": (0.02, -0.01, 0.003, -0.001),
    "FULL_OPENCV": (0.1, -0.02, 0.003, -0.004, 0.01, 0.02, -0.03, 0.004),
}


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_what_pycolmap_reads(tmp_path: Path, suffix: str) -> None:
    cameras = {
        f"{model}.png": Camera(
            64 + i, 48, 70.0 + i, 71.0 + i, 31.0, 25.0 + i,
            Camera.look_at((i, -4, 1), (0, 0, 0), width=8, height=8, fx=8).world_to_camera,
            model=model, distortion=distortion,
        )
        for i, (model, distortion) in enumerate(DISTORTION.items())
    }  # fmt: skip
    random = np.random.default_rng(1)
    points = Points(random.normal(size=(7, 3)).astype(np.float32), random.integers(0, 255, (7, 3), dtype=np.uint8))
    write_model(tmp_path, cameras, points, suffix)
    found = pycolmap(READ, str(tmp_path))
    assert set(found["images"]) == set(cameras)
    for name, camera in cameras.items():
        image = found["images"][name]
        assert (image["model"], image["size"]) == (camera.model, [camera.width, camera.height])
        assert image["parameters"] == [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]
        np.testing.assert_allclose(image["pose"], camera.world_to_camera[:3], atol=1e-9)
        np.testing.assert_allclose(image["seen"], camera.project([(0.1, -0.2, 0.4)])[0][0], atol=1e-6)
    np.testing.assert_allclose(np.array(found["points"])[:, :3], points.xyz, rtol=1e-6)
    np.testing.assert_array_equal(np.array(found["points"])[:, 3:], points.rgb)


unit = st.floats(-1, 1, allow_nan=False)


@given(st.tuples(unit, unit, unit, unit))
def test_quaternions_there_and_back(values: tuple[float, ...]) -> None:
    q = np.array(values)
    if np.linalg.norm(q) < 1e-6:
        return
    matrix = matrix_from_quaternion(q)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) > 0
    np.testing.assert_allclose(matrix_from_quaternion(quaternion_from_matrix(matrix)), matrix, atol=1e-9)


@given(st.tuples(unit, unit, unit), st.sampled_from([1e-12, 1e-4, 1.0, 3.0, 10.0]))
def test_rotation_vectors_there_and_back(values: tuple[float, ...], size: float) -> None:
    vector = np.array(values) * size
    matrix = matrix_from_vector(vector)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    back = vector_from_matrix(matrix)
    assert np.linalg.norm(back) <= np.pi + 1e-9
    np.testing.assert_allclose(matrix_from_vector(back), matrix, atol=1e-7)
    np.testing.assert_allclose(matrix @ vector, vector, atol=1e-12 * max(size, 1))  # the axis stays
    if np.linalg.norm(vector) < 3.0:
        np.testing.assert_allclose(back, vector, atol=1e-7)
