# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel render`, `eval`, `info` and `export` on a VideoRF, and the measures of a subject that was cut out."""

import json
import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from holoreel.core import evaluate as evaluation
from holoreel.core.camera import Camera, write_camera
from holoreel.core.capture import Capture, read_capture, write_capture
from holoreel.core.cli import main
from holoreel.core.draw import Drawing, Player
from holoreel.core.evaluate import evaluate_player
from holoreel.core.images import picture_path, read_exr, read_image, write_png
from holoreel.core.metrics import bounding_box, ssim, ssim_gauss, subject_scores
from holoreel.core.plyfile import read_vertices
from holoreel.core.videorf.encode import RungSpec, decoded_rows, write_reel
from holoreel.core.videorf.player import FieldPlayer, VideoPlayer
from holoreel.core.videorf.points import field_points, sphere
from holoreel.core.videorf.shading import Shading, ShadingShape

from .videorf_model import ball_model

EYES = {"front": (0.0, -3.5, 0.4), "side": (3.5, 0.3, -0.2), "back": (-0.4, 3.4, 0.9)}


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A model, its reel, its folder, and what three cameras saw of it: RGBA pictures, `back` held out."""
    folder = tmp_path_factory.mktemp("filmed")
    model = ball_model()
    player = FieldPlayer(model)
    cameras = {
        name: Camera.look_at(eye, (0, 0, 0), width=44, height=36, fx=90.0, name=name) for name, eye in EYES.items()
    }
    images = {}
    for name, camera in cameras.items():
        for frame in range(5):
            image, alpha, _ = player.draw(camera, 101 + frame, (0.0, 0.0, 0.0))
            straight = image / np.maximum(alpha, 1e-6)[..., None]
            images[name, frame] = picture_path(folder / "pictures", name, 101 + frame)
            write_png(images[name, frame], np.concatenate((straight, alpha[..., None]), 2))
    capture = Capture(cameras, images, 5, {"back": "test"}, fps=24.0, frame_start=101, source=folder)
    write_capture(folder, capture)
    write_camera(folder / "front.json", cameras["front"])
    model.write(folder / "ball.model")
    rungs = [RungSpec(8), RungSpec(34), RungSpec(34, "hevc")]
    return folder, model, write_reel(model, folder / "ball.reel", rungs), cameras


class Gray(Player):
    """Draws gray, whatever it is asked for."""

    backend_name, report, frame_start, frame_count, background = "none", [], 101, 5, (1.0, 1.0, 1.0)
    subject_alone = True

    def __init__(self, path):
        self.path = path

    def draw(self, camera, frame, background=None):
        shape = camera.height, camera.width
        return Drawing(np.full((*shape, 3), 0.5, np.float32), np.ones(shape), np.ones(shape))

    def reach(self, camera):
        return None

    def size(self):
        return 1000

    def facts(self):
        return {}


def test_subjects_are_measured_over_white_and_over_their_masks(filmed):
    """Against the pictures themselves, without any of our own measures where a formula will do."""
    folder, *_ = filmed
    metrics = evaluate_player(Gray(folder), read_capture(folder), "all")
    errors, inner = [], []
    for view in metrics["views"]:
        rgba = read_image(folder / "pictures" / view["camera"] / f"{view['frame']:04d}.png").astype(np.float64)
        white = np.rint(255 * (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])) / 255
        square, inside = (white - 0.5) ** 2, rgba[..., 3] > 0
        assert 0 < inside.mean() < 0.8
        assert view["psnr"] == pytest.approx(-10 * math.log10(square.mean()), abs=0.02)
        assert view["psnr_mask"] == pytest.approx(-10 * math.log10(square[inside].mean()), abs=0.02)
        rows, columns = np.nonzero(inside)
        box = white[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        assert view["ssim_crop"] == pytest.approx(ssim(np.full_like(box, 0.5), box), abs=2e-3)
        assert view["ssim_gauss"] == pytest.approx(ssim_gauss(np.full_like(white, 0.5), white), abs=2e-3)
        errors.append(square.mean())
        inner.append(square[inside].mean())
    assert len(errors) == 15
    assert metrics["pooled"]["psnr"] == pytest.approx(-10 * math.log10(np.mean(errors)), abs=0.02)
    assert metrics["pooled"]["psnr_mask"] == pytest.approx(-10 * math.log10(np.mean(inner)), abs=0.02)
    assert metrics["pooled_cameras"]["side"]["psnr"] == pytest.approx(-10 * math.log10(np.mean(errors[1::3])), abs=0.02)
    assert metrics["size"]["bytes_per_frame"] == 200


def test_surroundings_count_where_they_are_drawn(tmp_path):
    """Pictures with surroundings and masks: who shows the subject alone is compared with it alone, others with all."""
    random = np.random.default_rng(2)
    picture = random.integers(0, 256, (24, 32, 3)) / 255
    half = np.zeros((24, 32, 3))
    half[:, 16:] = 1
    write_png(tmp_path / "picture.png", picture)
    write_png(tmp_path / "mask.png", half)
    view, camera = ("a", 0), Camera.look_at((0, -3, 0), (0, 0, 0), width=32, height=24, fx=30)
    plain = Capture({"a": camera}, {view: tmp_path / "picture.png"}, 1, frame_start=101, source=tmp_path)
    masked = replace(plain, masks={view: tmp_path / "mask.png"})
    alone, all_of_it = Gray(tmp_path), Gray(tmp_path)
    all_of_it.subject_alone = False
    right = -10 * math.log10(np.square(picture[:, 16:] - 0.5).mean())
    cut = -10 * math.log10(np.square(np.where(half > 0, picture, 1.0) - 0.5).mean())
    full = -10 * math.log10(np.square(picture - 0.5).mean())
    for player, capture, psnr, inside in (
        (alone, masked, cut, right),
        (all_of_it, masked, full, right),
        (alone, plain, full, None),
        (all_of_it, plain, full, None),
    ):
        mean = evaluate_player(player, capture, "train")["mean"]
        assert mean["psnr"] == pytest.approx(psnr, abs=1e-4)
        assert mean.get("psnr_mask") == (None if inside is None else pytest.approx(inside, abs=1e-4))


def test_networks_see_the_whole_and_the_subjects_box(filmed, monkeypatch):
    folder, *_ = filmed
    monkeypatch.setattr(evaluation, "LPIPS_LEAST", 8)
    shapes = []

    class Spy:
        name, input_range = "lpips_alex", "standard"

        def __call__(self, image, truth):
            shapes.append(truth.shape[:2])
            return float(truth.shape[0])

    metrics = evaluate_player(Gray(folder), read_capture(folder), lpips=[Spy()])
    for view, (whole, box) in zip(metrics["views"], zip(shapes[::2], shapes[1::2], strict=True), strict=True):
        rgba = read_image(folder / "pictures" / view["camera"] / f"{view['frame']:04d}.png")
        rows, columns = np.nonzero(rgba[..., 3])
        assert whole == (36, 44)
        assert box == (np.ptp(rows) + 1, np.ptp(columns) + 1)
        assert (view["lpips_alex"], view["lpips_alex_crop"]) == (36, box[0])


def test_what_cannot_be_measured_of_a_subject_is_left_out():
    random = np.random.default_rng(0)
    image, truth = random.random((2, 30, 40, 3))
    nothing = np.zeros((30, 40), bool)
    assert set(subject_scores(image, truth, nothing)) == {"ssim_gauss"}
    sliver = nothing.copy()
    sliver[5:20, 8:10] = True
    assert bounding_box(sliver) == (slice(5, 20), slice(8, 10))
    scores = subject_scores(image, truth, sliver)
    assert set(scores) == {"psnr_mask", "ssim_gauss"}
    assert scores["psnr_mask"] == pytest.approx(-10 * math.log10(np.square(image - truth)[sliver].mean()))
    same = subject_scores(truth, truth, sliver | (image[..., 0] > 0.5))
    assert same == {"psnr_mask": 100.0, "ssim_crop": pytest.approx(1), "ssim_gauss": pytest.approx(1)}
    assert set(subject_scores(image[:9], truth[:9], np.ones((9, 40), bool))) == {"psnr_mask", "ssim_crop"}


def test_gaussian_ssim_is_the_one_of_its_inventors():
    """One window, summed by hand."""
    image, truth = np.random.default_rng(1).random((2, 11, 11, 1))
    bell = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights = np.outer(bell, bell)[..., None] / bell.sum() ** 2
    mean, other = (weights * image).sum(), (weights * truth).sum()
    variance, further = (weights * (image - mean) ** 2).sum(), (weights * (truth - other) ** 2).sum()
    together = (weights * (image - mean) * (truth - other)).sum()
    expected = (2 * mean * other + 1e-4) * (2 * together + 9e-4)
    expected /= (mean**2 + other**2 + 1e-4) * (variance + further + 9e-4)
    assert ssim_gauss(image, truth) == pytest.approx(expected, rel=1e-6)


def test_eval_tells_rungs_apart(filmed, tmp_path, capsys):
    folder, _, reel, _ = filmed
    found = {}
    for name, arguments in {"model": [], "8": ["--rung", "8", "--speed"], "34": ["--rung", "hevc:34"]}.items():
        file = folder / "ball.model" if name == "model" else reel.path
        assert main(["eval", str(file), str(folder), "--out", str(tmp_path / name), *arguments]) == 0
        found[name] = json.loads((tmp_path / name / "metrics.json").read_text())
        said = capsys.readouterr().out
        assert "PSNR mask dB" in said
        assert f"{found[name]['mean']['psnr_mask']:.2f}" in said
    assert found["model"]["mean"]["psnr"] > 45  # 8 bits of color and of alpha
    assert found["model"]["mean"]["psnr"] > found["8"]["mean"]["psnr"] > found["34"]["mean"]["psnr"] + 2
    assert found["8"]["rung"] == "h264:8"
    assert list(found["8"]["rungs"]) == ["h264:8", "h264:34", "hevc:34"]
    names = (reel.rungs[0].file, reel.tables_file, reel.shading_file, reel.path.name)
    assert found["8"]["size"]["bytes"] == sum((folder / name).stat().st_size for name in names)
    assert found["8"]["speed"]["fps"] > 0
    assert {"decode", "unpack", "draw"} <= found["8"]["speed"]["milliseconds"].keys()
    page = (tmp_path / "8" / "index.html").read_text()
    assert "SSIM crop" in page
    assert "frames per second" in page
    drawn = read_image(tmp_path / "8" / "back" / "0103.png")
    wanted = VideoPlayer(reel.path, "8").draw(read_capture(folder).cameras["back"], 103).image
    np.testing.assert_allclose(drawn, wanted, atol=0.51 / 255)


def test_render_draws_any_frame(filmed, tmp_path, capsys):
    folder, _, reel, cameras = filmed
    look = ["--camera", str(folder / "front.json")]
    out = tmp_path / "a.exr"
    assert main(["render", str(reel.path), *look, "--frame", "104.7", "--rung", "34", "--out", str(out)]) == 0
    drawing = VideoPlayer(reel.path, "34").draw(cameras["front"], 104)
    image, depth = read_exr(out)
    np.testing.assert_array_equal(image, np.concatenate((drawing.image, drawing.alpha[..., None]), 2))
    np.testing.assert_array_equal(depth, drawing.depth)
    assert 2 < depth[depth > 0].min() < depth.max() < 5
    arguments = ["--time", "0", "--quality", "draft", "--background", "0,0,1", "--out", str(tmp_path / "b.png")]
    assert main(["render", str(reel.path), *look, *arguments]) == 0
    assert read_image(tmp_path / "b.png")[0, 0].tolist() == [0, 0, 1]
    assert main(["render", str(folder / "ball.model"), *look, "--frame", "101", "--out", str(tmp_path / "c.png")]) == 0
    for arguments, words in (
        (["--frame", "101", "--rung", "20"], "has no rung 20: take one of h264:8"),
        (["--frame", "101", "--decoder-output", "clamp"], "has no use for --decoder-output"),
    ):
        assert main(["render", str(reel.path), *look, *arguments, "--out", str(tmp_path / "d.png")]) == 2
        assert words in capsys.readouterr().err


def test_render_leaves_out_what_was_cut_off(filmed, tmp_path, capsys):
    folder, model, _, _ = filmed
    reel = write_reel(model, tmp_path / "cut.reel", [RungSpec(20)])
    video, last = tmp_path / reel.rungs[0].file, reel.rungs[0].video.groups[-1]
    video.write_bytes(video.read_bytes()[: last.offset + 9])
    out = tmp_path / "out"
    assert main(["render", str(reel.path), "--cameras", str(folder), "--split", "test", "--out", str(out)]) == 0
    assert "is cut off: frame" in capsys.readouterr().err
    assert sorted(path.name for path in (out / "back").iterdir()) == [f"{101 + j:04d}.png" for j in range(last.first)]
    assert main(["eval", str(reel.path), str(folder)]) == 2  # half a reel is not the reel
    assert "is cut off" in capsys.readouterr().err


def test_points_are_the_vertices_that_can_be_seen(filmed, tmp_path, capsys):
    folder, model, reel, _ = filmed
    frames = {frame: (table, rows) for frame, table, rows in decoded_rows(reel, 0)}
    for arguments, eyes in (
        (["--camera", str(folder / "front.json")], [EYES["front"]]),
        (["--cameras", str(folder)], [EYES["front"], EYES["side"]]),
        ([], None),
    ):
        out = tmp_path / "a.ply"
        command = ["export", str(reel.path), "--to", "points", "--frame", "103", "--out", str(out)]
        assert main([*command, *arguments]) == 0
        points = read_vertices(out)
        table, rows = frames[2]
        wanted = []
        for vertex, row in zip(table.vertices, rows.astype(np.float64), strict=True):
            extinction = math.log1p(math.exp(row[0]))
            if 1 - math.exp(-extinction) <= 0.05:
                continue
            place = np.array(model.lattice.lowest) + model.lattice.spacing * vertex
            ways = -sphere(32) if eyes is None else [(place - eye) / np.linalg.norm(place - eye) for eye in eyes]
            color = np.mean([model.shading(row[1:], np.array(way)) for way in ways], 0)
            wanted.append((*place, *np.rint(255 * color), extinction / model.lattice.spacing))
        assert len(wanted) == len(points) > 100
        names = ("x", "y", "z", "red", "green", "blue", "density")
        for name, column in zip(names, zip(*wanted, strict=True), strict=True):
            atol = 1.01 if points[name].dtype == "u1" else 1e-6
            np.testing.assert_allclose(points[name].astype(float), column, rtol=1e-5, atol=atol)
    many = tmp_path / "many"
    assert (
        main(["export", str(folder / "ball.model"), "--to", "points", "--frames", "102:104", "--out", str(many)]) == 0
    )
    assert sorted(path.name for path in many.iterdir()) == ["0102.ply", "0103.ply", "0104.ply"]


def test_decoding_and_points_need_numpy_alone():
    modules = "export, videorf.decode, videorf.points, videorf.inspect".replace(", ", ", holoreel.core.")
    code = f"import sys; sys.modules.update(torch=None, av=None, scipy=None); import holoreel.core.{modules}"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_directions_are_spread_and_may_not_matter(filmed):
    ways = sphere(32)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1)
    np.testing.assert_allclose(ways.mean(0), 0, atol=0.02)
    closest = np.sort(ways @ ways.T, axis=1)[:, -2]
    assert closest.max() < math.cos(0.4)  # no two are near each other
    _, model, *_ = filmed
    shape = ShadingShape(7, None, 4)
    layers = [(np.full((o, i), 0.1, np.float32), np.full(o, 0.2, np.float32)) for o, i in shape.layers]
    shading = Shading(shape, tuple(layers))
    table, rows = model.table_of(0), model.rows(0)
    around = field_points(model.lattice, table, rows, shading)
    ahead = field_points(model.lattice, table, rows, shading, np.array([[9.0, 0, 0]]))
    np.testing.assert_array_equal(around.rgb, ahead.rgb)
    dense = field_points(model.lattice, table, rows, shading, gamma=0.6)
    assert 0 < len(dense.xyz) == int((np.exp(rows[:, 0]) > 1.5).sum()) < len(around.xyz)  # 1 - 1 / (1 + e^d) > 0.6
    assert (dense.density * model.lattice.spacing > -math.log(0.4) - 1e-6).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("REEL --to points --out OUT/a.ply", "needs --frame N or --frames"),
        ("REEL --to points --frame 101.5 --out OUT/a.ply", "no frame 101.5 to make points of: take 101 to 105"),
        ("REEL --to points --frames 104:106 --out OUT", "no frame 106"),
        ("REEL --to points --frame 101 --out OUT/a.obj", "--to points writes .ply"),
        ("REEL --to points --frame 101 --rung 9 --out OUT/a.ply", "has no rung 9"),
        ("REEL --to points --frame 101 --camera FRONT --cameras CAPTURE --out OUT/a.ply", "give one of them"),
        ("REEL --to 3dgs --frame 101 --out OUT/a.ply", "holds no Gaussians"),
        ("REEL --to compact --rung 8 --out OUT/a.stgc", "for --to points alone"),
        ("MODEL --to points --frame 101 --rung 8 --out OUT/a.ply", "leave --rung away"),
        ("LITE --to points --frame 101 --out OUT/a.ply", "with --to 3dgs"),
    ],
)
def test_mistakes_of_export_get_a_sentence(filmed, recording, tmp_path, capsys, arguments, words):
    folder, _, reel, _ = filmed
    names = {"REEL": reel.path, "MODEL": folder / "ball.model", "LITE": recording.reel, "CAPTURE": folder,
             "FRONT": folder / "front.json", "OUT": tmp_path}  # fmt: skip
    for name, path in names.items():
        arguments = arguments.replace(name, str(path))
    assert main(["export", *arguments.split()]) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.rglob("*")) == []


def facts_of(path, capsys):
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert main(["info", str(path)]) == 0
    said = capsys.readouterr().out
    assert all(problem in said for problem in facts["problems"])
    return facts


def test_info_says_what_a_reel_holds(filmed, capsys):
    folder, model, reel, _ = filmed
    facts = facts_of(reel.path, capsys)
    assert facts["what"] == "a VideoRF reel"
    assert facts["frames"] == "5 from frame 101 at 24 fps"
    assert len(facts["groups"]) == len(model.groups)
    assert facts["groups"][0].startswith(f"frames 101 to {100 + model.groups[0].count}: {model.tables[0].count:,} vert")
    assert list(facts["rungs"]) == ["h264:8", "h264:34", "hevc:34"]
    names = (*(rung.file for rung in reel.rungs), reel.tables_file, reel.shading_file, reel.path.name)
    assert facts["bytes on disk"] == sum((folder / name).stat().st_size for name in names)
    assert facts["problems"] == []
    facts = facts_of(folder / "ball.model", capsys)
    assert facts["what"] == "a trained VideoRF, not coded yet"
    assert facts["frames"] == "5 from frame 101 at 24 fps"
    facts = facts_of(folder, capsys)
    assert facts["subject"] == "cut out of every picture"


def test_info_names_everything_that_is_wrong(filmed, tmp_path, capsys):
    _, model, _, _ = filmed
    reel = write_reel(model, tmp_path / "a.reel", [RungSpec(qp) for qp in (8, 20, 30, 40)])
    cut, gone, other, longer = (tmp_path / rung.file for rung in reel.rungs)
    cut.write_bytes(cut.read_bytes()[:-1])
    gone.unlink()
    data = bytearray(other.read_bytes())
    data[reel.rungs[2].video.groups[0].offset + 99] ^= 1
    other.write_bytes(bytes(data))
    longer.write_bytes(longer.read_bytes() + b"more")
    tables = bytearray((tmp_path / reel.tables_file).read_bytes())
    tables[-1] ^= 1
    (tmp_path / reel.tables_file).write_bytes(bytes(tables))
    (tmp_path / reel.shading_file).write_bytes(b"")
    problems = facts_of(reel.path, capsys)["problems"]
    last = len(reel.groups) - 1
    for words in (
        f"{cut} is cut off: frame",
        f"{gone} cannot be read",
        f"{other} is not the file that was encoded",
        f"{longer} has 4 bytes more",
        f"{tmp_path / reel.tables_file} is cut off or damaged at group {last}",
        f"{tmp_path / reel.shading_file} does not hold",
    ):
        assert sum(words in problem for problem in problems) == 1, words
    assert len(problems) == 6
