# SPDX-License-Identifier: GPL-3.0-or-later
"""Training rays, bounds and the visual hull, against spheres whose silhouettes are known exactly."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture
from holoreel.core.errors import HoloreelError
from holoreel.core.images import write_png
from holoreel.core.videorf.hull import carve, visual_hull
from holoreel.core.videorf.occupancy import Lattice
from holoreel.core.videorf.views import FrameViews, subject_bounds

from .videorf_ball import CENTER, RADIUS, SIZE, alpha_of, around, ball_capture, distances, dome

MOVED = np.array([0.2, 0, 0.1])


def test_pool_is_the_pixels_near_the_subject(tmp_path):
    cameras = dome(4)
    capture = ball_capture(tmp_path, cameras=cameras, splits={"cam02": "test"})
    views = FrameViews(capture, 0, border=2)
    assert list(views.masks) == ["cam00", "cam01", "cam03"]
    expected = []
    for index, camera in enumerate(cameras.values()):
        if index == 2:
            continue
        mask = alpha_of(camera)
        near = np.zeros_like(mask)
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                near |= np.roll(np.roll(np.pad(mask, 2), dy, 0), dx, 1)[2:-2, 2:-2]
        rows, columns = np.nonzero(near)
        expected += [(x, y, index) for y, x in zip(rows, columns, strict=True)]
    assert [tuple(pixel) for pixel in views.rgba[:, :3].tolist()] == expected
    every = views.rays(slice(None))
    for ray in (0, 700, len(views) - 1):
        x, y, index = expected[ray]
        origin, direction = cameras[f"cam{index:02d}"].rays(np.array([[x + 0.5, y + 0.5]]))
        assert every.origins[ray].numpy() == pytest.approx(origin[0], abs=1e-6)
        assert every.directions[ray].numpy() == pytest.approx(direction[0], abs=1e-6)
        assert views.origins[ray].tolist() == every.origins[ray].tolist()
    assert set(views.rgba[:, 3].tolist()) == {0, 255}
    assert every.rgba.dtype == torch.float32
    assert every.rgba.max() == 1


def test_samples_are_rays_of_the_pool(tmp_path):
    views = FrameViews(ball_capture(tmp_path, cameras=dome(3)), 0)
    batch = views.sample(500, torch.Generator().manual_seed(3))
    again = views.sample(500, torch.Generator().manual_seed(3))
    assert all(torch.equal(one, other) for one, other in zip(batch, again, strict=True))
    pool = {tuple(row) for row in torch.cat((views.origins, views.directions, views.rgba / 255), 1).tolist()}
    assert all(tuple(row) in pool for row in torch.cat(tuple(batch), 1).tolist())
    assert len({tuple(row) for row in batch.rgba.tolist()}) > 300


def test_rays_through_a_lens(tmp_path):
    cameras = dome(3, lens=True)
    views = FrameViews(ball_capture(tmp_path, cameras=cameras), 0, border=0)
    to_center = torch.from_numpy(CENTER.astype(np.float32)) - views.origins
    missed = torch.linalg.cross(to_center, views.directions).norm(dim=1)
    assert float(missed.max()) <= RADIUS + 1e-5  # border 0: every ray meets the ball
    assert len(views) == sum(int(alpha_of(camera).sum()) for camera in cameras.values())


def test_no_mask_shows_anything(tmp_path):
    capture = ball_capture(tmp_path, cameras=dome(3), centers=[[90, 90, 90]])
    with pytest.raises(HoloreelError, match=r"no camera's mask shows anything in frame 1"):
        FrameViews(capture, 0)


@pytest.mark.parametrize("lens", [False, True])
def test_bounds_from_masks_hold_the_subject_tightly(tmp_path, lens):
    centers = [CENTER, CENTER + MOVED]
    low, high = subject_bounds(ball_capture(tmp_path, 2, dome(lens=lens), centers))
    assert (low <= CENTER - RADIUS).all()
    assert (high >= CENTER + MOVED + RADIUS).all()
    assert (high - low <= 2 * RADIUS * 1.35 + MOVED).all()


def test_given_bounds_are_taken(tmp_path):
    capture = ball_capture(tmp_path, bounds=((-1, -2, -3), (4, 5, 6)))
    low, high = subject_bounds(capture)
    assert (low.tolist(), high.tolist()) == ([-1, -2, -3], [4, 5, 6])


def test_masks_that_enclose_nothing(tmp_path):
    cameras = dome(5)
    wrong = cameras["cam02"]
    turned = Camera.look_at(wrong.center, 2 * wrong.center - CENTER, width=56, height=48, fx=62, name="cam02")
    capture = ball_capture(tmp_path, cameras=cameras)
    with pytest.raises(HoloreelError, match=r"transforms.json.*give the subject's bounds"):
        subject_bounds(Capture(cameras | {"cam02": turned}, capture.images, source=capture.source))
    with pytest.raises(HoloreelError, match="give the subject's bounds"):  # all from one side: no end to the far one
        subject_bounds(ball_capture(tmp_path / "one", cameras=dict(list(cameras.items())[:1])))


def test_hull_holds_every_cell_of_the_subject(tmp_path):
    views = FrameViews(ball_capture(tmp_path), 0)
    lattice = around()
    hull = visual_hull(views, lattice)
    away = distances(lattice)
    assert hull[away < RADIUS + 3**0.5 * lattice.spacing].all()  # every corner of every cell that the ball touches
    assert not hull[away > RADIUS + 5 * lattice.spacing].any()
    assert not hull.all()


def test_thin_subjects_are_not_lost_between_vertices(tmp_path):
    cameras = dome()
    lattice = around(16)
    needle = lattice.positions([7.5, 7.5, 7.5]) + np.linspace(-0.3, 0.3, 40)[:, None] * [0, 0, 1]
    images = {}
    for name, camera in cameras.items():
        picture = np.zeros((camera.height, camera.width, 4))
        column, row = np.floor(camera.project(needle)[0]).astype(int).T
        picture[row, column] = 1
        images[name, 0] = tmp_path / f"{name}.png"
        write_png(images[name, 0], picture)
    hull = visual_hull(FrameViews(Capture(cameras, images), 0), lattice)
    cells = np.floor((needle - lattice.lowest) / lattice.spacing).astype(int)
    for corner in np.ndindex(2, 2, 2):
        assert hull[tuple((cells + corner).T)].all()


def test_misses_forgive_bad_masks(tmp_path):
    capture = ball_capture(tmp_path)
    for name in ("cam03", "cam08"):
        write_png(capture.images[name, 0], np.zeros((SIZE, SIZE + 8, 4)))
    views, lattice = FrameViews(capture, 0), around()
    with pytest.raises(HoloreelError, match=r"frame 1 .*cam03, cam08 are empty"):
        visual_hull(views, lattice)
    with pytest.raises(HoloreelError, match="frame 1"):
        visual_hull(views, lattice, misses=1)
    hull = visual_hull(views, lattice, misses=2)
    assert hull[distances(lattice) < RADIUS + lattice.spacing].all()
    assert hull.mean() < 0.6


def test_more_misses_never_carve_more(tmp_path):
    views, lattice = FrameViews(ball_capture(tmp_path), 0), around(24)
    hulls = [visual_hull(views, lattice, misses) for misses in range(3)]
    assert all((less <= more).all() for less, more in pairwise(hulls))
    assert hulls[0].sum() < hulls[2].sum()


def test_a_camera_does_not_judge_beyond_its_picture(tmp_path):
    """A close-up sees a part of the ball: the hull keeps the rest."""
    cameras = dome()
    near = Camera.look_at(cameras["cam04"].center, CENTER, width=32, height=32, fx=160, name="close")
    capture = ball_capture(tmp_path, cameras=cameras | {"close": near})
    lattice = around()
    assert visual_hull(FrameViews(capture, 0), lattice)[distances(lattice) < RADIUS].all()


def test_nothing_is_known_of_what_few_cameras_see(tmp_path):
    capture = ball_capture(tmp_path)
    seen = list(FrameViews(capture, 0).masks.values())
    away = Camera.look_at([0, 0, 50], [0, 0, 90], width=32, height=32, fx=40)
    blind = [type(seen[0])(away, np.ones((32, 32), bool))] * 3
    assert not carve([*seen[:2], *blind], around()).any()
    assert carve(seen[:2], around()).any()


def test_hull_off_the_subject(tmp_path):
    views = FrameViews(ball_capture(tmp_path), 0)
    with pytest.raises(HoloreelError, match="bounds, the calibration or the masks"):
        visual_hull(views, Lattice.around(CENTER + 1.5, CENTER + 2, 16))


def test_pictures_without_masks(tmp_path):
    path = tmp_path / "plain.png"
    write_png(path, np.ones((SIZE, SIZE + 8, 3)))
    with pytest.raises(HoloreelError, match=r"cam01.*mask"):
        FrameViews(Capture({"cam01": dome(3)["cam01"]}, {("cam01", 0): path}), 0)
