# SPDX-License-Identifier: GPL-3.0-or-later
"""The worker: its pictures are the players' own, and whatever happens to it comes out as a sentence, in time."""

import errno
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.draw import open_player
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians.decoder import Decoder
from holoreel.core.reel import save_gaussians
from holoreel.core.videorf.encode import RungSpec, write_reel
from holoreel.core.worker import frames, protocol
from holoreel.core.worker.client import Client
from holoreel.core.worker.process import Limits
from holoreel.core.worker.protocol import CancelledError, Layer, Shot

from .videorf_model import ball_model

BEHIND = (0.25, 0.5, 0.75)
SIDE_SIGHT = Camera.look_at((2.5, -3.0, 1.2), (0.0, 0.0, 0.0), width=52, height=41, fx=80.0)
AHEAD = Camera(52, 41, 44.0, 43.0, 25.0, 22.0)
FISHEYE = Camera(52, 41, 30.0, 30.0, 26.0, 20.5, model="OPENCV_FISHEYE", distortion=(0.0, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def client(tmp_path_factory) -> Iterator[Client]:
    made = Client(Path(sys.executable), log=tmp_path_factory.mktemp("worker") / "worker.log")
    yield made
    made.close()
    assert made.pid is None


@pytest.fixture(scope="module")
def files(tmp_path_factory, random_model) -> dict[str, Path]:
    """A reel of each kind."""
    folder, random = tmp_path_factory.mktemp("reels"), np.random.default_rng(3)
    facts = {"fps": 24.0, "frame_start": 101, "frame_count": 5}
    save_gaussians(folder / "lite.reel", random_model(80), background=BEHIND, **facts)
    save_gaussians(folder / "other.reel", random_model(80, seed=1), background=(1, 0, 0), **facts)
    decoder = Decoder(random.normal(size=(6, 12)), random.normal(size=(3, 6)), "sigmoid")
    save_gaussians(folder / "full.reel", random_model(80, features=9), decoder=decoder, **facts)
    write_reel(ball_model(), folder / "field.reel", [RungSpec(8)])
    return {path.stem: path for path in folder.glob("*.reel")}


def layer(path: Path, camera: Camera = AHEAD, step: float = 2.0, **fields) -> Layer:
    return Layer(path, step, 5, camera, **fields)


def picture(client: Client, shot: Shot) -> frames.Pixels:
    """What the worker draws, rows from the top."""
    with client.draw(shot) as drawing:
        return frames.Pixels(*(part[::-1].copy() for part in drawing.pixels))


def linear(color):
    return np.where(color <= 0.04045, color / 12.92, ((np.maximum(color, 0) + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("camera", [AHEAD, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("name", ["lite", "full", "field"])
def test_pictures_are_the_players_own(client, files, name, camera):
    if name == "field":
        camera = Camera(**{**vars(camera), "world_to_camera": SIDE_SIGHT.world_to_camera})
    wanted = open_player(files[name]).draw(camera, 103.0)
    shown = picture(client, Shot((layer(files[name], camera),)))
    assert wanted.alpha.mean() > 0.02
    np.testing.assert_allclose(shown.rgba[..., :3], wanted.image, atol=2e-6)
    np.testing.assert_array_equal(shown.rgba[..., 3], 1.0)
    np.testing.assert_array_equal(shown.alpha, wanted.alpha)
    np.testing.assert_array_equal(shown.depth, np.where(wanted.alpha > 0, wanted.depth, np.float32(1e10)))
    np.testing.assert_allclose(
        picture(client, Shot((layer(files[name], camera),), linear=True)).rgba[..., :3],
        linear(wanted.image.astype(np.float64)),
        atol=2e-5,
    )


@pytest.mark.parametrize("name", ["lite", "full", "field"])
def test_transparent_pictures_are_premultiplied(client, files, name):
    """Over any background they give what is drawn over it; of a full model, the decoder's colors times alpha."""
    camera = SIDE_SIGHT if name == "field" else AHEAD
    player, shot = open_player(files[name]), Shot((layer(files[name], camera),), transparent=True)
    shown = picture(client, shot)
    np.testing.assert_array_equal(shown.rgba[..., 3], shown.alpha)
    if player.takes_background:
        over = shown.rgba[..., :3] + (1 - shown.rgba[..., 3:]) * np.float32(BEHIND)
        np.testing.assert_allclose(over, player.draw(camera, 103.0, BEHIND).image, atol=2e-6)
    else:
        drawn = player.draw(camera, 103.0)
        np.testing.assert_allclose(shown.rgba[..., :3], drawn.image * drawn.alpha[..., None], atol=2e-6)
    straight = shown.rgba[..., :3] / np.maximum(shown.alpha, 1e-8)[..., None]
    mixed = picture(client, Shot(shot.layers, transparent=True, linear=True)).rgba[..., :3]
    np.testing.assert_allclose(mixed, linear(straight) * shown.alpha[..., None], atol=3e-5)


@pytest.mark.parametrize("name", ["lite", "full", "field"])
def test_a_region_is_a_part_of_the_whole(client, files, name):
    shot = Shot((layer(files[name], SIDE_SIGHT if name == "field" else AHEAD),))
    whole = picture(client, shot)
    part = picture(client, Shot(shot.layers, region=(7, 3, 40, 29)))
    for mine, all_of_it in zip(part, whole, strict=True):
        np.testing.assert_allclose(mine, all_of_it[3:29, 7:40], rtol=1e-6, atol=1e-6)


def test_depth_can_be_measured_along_the_rays(client, files):
    shot = Shot((layer(files["lite"], FISHEYE, scale=3.0),))
    flat, along = picture(client, shot), picture(client, Shot(shot.layers, along_rays=True))
    direct = picture(client, Shot((layer(files["lite"], FISHEYE),)))
    seen = flat.alpha > 0
    cosine = (FISHEYE.rays()[1] @ [0, 0, 1.0]).reshape(41, 52)
    np.testing.assert_allclose(along.depth[seen] * cosine[seen], flat.depth[seen], rtol=1e-5)
    np.testing.assert_allclose(flat.depth[seen], 3 * direct.depth[seen], rtol=1e-5)
    assert (flat.depth[~seen] == np.float32(1e10)).all()


def test_reels_lie_over_each_other_by_depth(client, files):
    """Against the rule, pixel by pixel, whichever is named first; the first one's background lies behind."""
    both = [files["lite"], files["other"]]
    drawn = [open_player(path).draw(AHEAD, 103.0, (0, 0, 0)) for path in both]
    for order in ([0, 1], [1, 0]):
        shown = picture(client, Shot(tuple(layer(both[index]) for index in order)))
        nearer_first = np.argsort([np.where(d.alpha > 0, d.depth, np.inf) for d in drawn], axis=0)
        color, weighted, left = np.zeros((41, 52, 3)), np.zeros((41, 52)), np.ones((41, 52))
        for place in range(2):
            for index, one in enumerate(drawn):
                here = nearer_first[place] == index
                color += (left * here)[..., None] * one.image
                weighted += left * here * one.alpha * one.depth
                left = np.where(here, left * (1 - one.alpha), left)
        color += left[..., None] * open_player(both[order[0]]).background
        np.testing.assert_allclose(shown.rgba[..., :3], color, atol=1e-5)
        np.testing.assert_allclose(shown.alpha, 1 - left, atol=1e-6)
        seen = shown.alpha > 1e-3
        np.testing.assert_allclose(shown.depth[seen], (weighted / np.maximum(1 - left, 1e-9))[seen], rtol=1e-4)
    assert (np.ptp(nearer_first[0]), len(np.unique(left > 0.5))) == (1, 2)


def test_steps_are_those_of_the_scene_even_where_it_counts_other_frames(client, files):
    """A bare file does not know its frames: the scene may say that they are ten."""
    wanted = open_player(files["lite"]).draw(AHEAD, 103.25)
    shown = picture(client, Shot((Layer(files["lite"], 4.5, 10, AHEAD),)))
    np.testing.assert_allclose(shown.rgba[..., :3], wanted.image, atol=2e-6)


def test_a_file_that_has_changed_is_read_again(client, tmp_path, random_model):
    path = tmp_path / "a.reel"
    for seed in (5, 6):
        save_gaussians(path, random_model(40 + seed, seed=seed), fps=24, frame_start=101, frame_count=5)
        os.utime(path, ns=(seed * 10**9, seed * 10**9))
        shown = picture(client, Shot((layer(path),)))
        np.testing.assert_allclose(shown.rgba[..., :3], open_player(path).draw(AHEAD, 103.0).image, atol=2e-6)


def test_what_the_user_can_mend_is_said_in_the_players_words(client, files, tmp_path):
    with pytest.raises(HoloreelError, match=r"gone\.reel cannot be read"):
        client.draw(Shot((layer(tmp_path / "gone.reel"),)))
    (tmp_path / "bad.reel").write_text('{"kind": "spacetime_gaussians"}')
    with pytest.raises(HoloreelError, match=r"bad\.reel"):
        client.open(tmp_path / "bad.reel")
    before = client.pid
    assert client.open(files["lite"])["frame_count"] == 5
    assert client.pid == before


def test_a_worker_that_died_meanwhile_is_started_again(client, files):
    shot = Shot((layer(files["lite"]),))
    picture(client, shot)
    killed = client.pid
    os.kill(killed, signal.SIGKILL)
    while client.pid is not None:
        time.sleep(0.01)
    assert picture(client, shot).alpha.any()
    assert client.pid not in (None, killed)
    assert not list(Path("/dev/shm").glob(f"holoreel-{os.getpid()}-*"))


# --- Workers that misbehave: they are faked, in a few lines each ---------------------------------------------------

FAKE = """
    import json, os, sys, time
    def say(message): print(json.dumps({"jsonrpc": "2.0", **message}), flush=True)
    def hear():
        line = sys.stdin.readline()
        return json.loads(line) if line else sys.exit()
    def greet(**facts):
        say({"id": hear()["id"], "result": {"protocol": PROTOCOL, **facts}})
"""
SHOT = Shot((Layer(Path("any.reel"), 0.0, 5, AHEAD),))


@pytest.fixture
def fake(tmp_path) -> Iterator:
    """`fake(code, **limits)` is the client of a worker that runs `code`."""
    made = []

    def make(code: str, **limits: float) -> Client:
        text = textwrap.dedent(FAKE).replace("PROTOCOL", str(protocol.PROTOCOL)) + textwrap.dedent(code)
        command = [sys.executable, "-c", text]
        made.append(Client(Path(), log=tmp_path / "log", command=command, limits=Limits(leave=0.2, **limits)))
        return made[-1]

    yield make
    for client in made:
        client.close()


@pytest.mark.parametrize(
    ("code", "sentence"),
    [
        ("greet(); hear(); print('all is well', flush=True); time.sleep(60)", "no message"),
        ('greet(); hear(); print(\'{"jsonrpc": "2.0"}\', flush=True); time.sleep(60)', "no message"),
        ("greet(); hear(); say({'id': 99, 'result': {}}); time.sleep(60)", "no message"),
        ("greet(); hear(); say({'id': 2, 'result': 3}); time.sleep(60)", "no message"),
        ("greet(); hear(); sys.stdout.write('x' * 3_000_000); time.sleep(60)", "no message"),
        ("greet(); hear(); sys.exit('out of luck')", "status 1, last saying 'out of luck'"),
        ("greet(); hear(); os.kill(os.getpid(), 11)", "SIGSEGV"),
        ("greet(); hear(); os.close(1); time.sleep(60)", "worker"),
        ("greet()\nwhile True: say({'id': hear()['id'], 'error': {'code': -32603, 'message': 'Oops'}})", "'Oops'"),
        ("say({'id': hear()['id'], 'result': {'protocol': 0, 'version': '0.0.1'}}); hear(); time.sleep(60)", "0.0.1"),
        ("say({'id': hear()['id'], 'result': {}}); time.sleep(60)", "same version in both"),
        ("raise ModuleNotFoundError(\"No module named 'holoreel'\")", "has no Holoreel"),
    ],
)
def test_a_worker_that_misbehaves_gives_a_sentence(fake, code, sentence):
    client = fake(code)
    for _ in range(2):  # and so does the next one
        with pytest.raises(HoloreelError, match=re.escape(sentence)):
            client.draw(SHOT)


def test_a_worker_that_is_killed_while_it_draws_is_named(fake):
    """And the next picture has another one."""
    client = fake("""
        greet()
        number = hear()["id"]
        say({"method": "progress", "params": {"id": number, "done": 0, "of": 1}})
        time.sleep(60)
    """)
    killed = []

    def kill(done: int, of: int) -> None:
        killed.append(client.pid)
        os.kill(client.pid, signal.SIGKILL)

    for _ in range(2):
        with pytest.raises(HoloreelError, match="SIGKILL; the next picture starts it anew"):
            client.draw(SHOT, on_progress=kill)
    assert len(set(killed)) == 2


def test_a_worker_that_hangs_is_ended(fake):
    with pytest.raises(HoloreelError, match=r"did not answer within 0\.3 s"):
        fake("time.sleep(60)", hello=0.3).draw(SHOT)
    client = fake("greet(); time.sleep(60)", draw=0.3)
    with pytest.raises(HoloreelError, match=r"no picture within 0\.3 s"):
        client.draw(SHOT)
    assert client.pid is None


def test_cancelling_returns_at_once_and_ends_a_worker_that_does_not_listen(fake):
    client = fake("greet(); time.sleep(60)", cancel=0.2)
    client.hello()
    with pytest.raises(CancelledError):
        client.draw(SHOT, stop=lambda: True)
    deaf = client.pid
    assert deaf is not None
    time.sleep(0.3)
    assert client.hello()["protocol"] == protocol.PROTOCOL
    assert client.pid != deaf


def test_cancelling_is_answered_between_parts(fake, files):
    """A real server whose drawing waits for the word: it gives up, stays alive, and draws the next picture."""
    client = fake("""
        from holoreel.core.worker import picture, server
        draw = picture.draw_shot
        def slowly(players, shot, pixels, step):
            if not shot.transparent:
                while True:
                    step(0, 1)
                    time.sleep(0.01)
            return draw(players, shot, pixels, step)
        picture.draw_shot = slowly
        server.serve()
    """)
    client.hello()
    progress = threading.Event()
    with pytest.raises(CancelledError):
        client.draw(Shot((layer(files["lite"]),)), stop=progress.is_set, on_progress=lambda done, of: progress.set())
    before = client.pid
    assert picture(client, Shot((layer(files["lite"]),), transparent=True)).alpha.any()
    assert client.pid == before


def test_an_interpreter_that_is_not_there_is_named(tmp_path):
    for python in (tmp_path / "none" / "python", tmp_path):
        client = Client(python, log=tmp_path / "log")
        with pytest.raises(HoloreelError, match=re.escape(f"{python} cannot be run")):
            client.draw(SHOT)
        client.close()


def test_no_room_for_pixels_is_said_before_anything_is_drawn(fake, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    client = fake("greet(); time.sleep(60)")
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(HoloreelError, match="No space left"):
        client.draw(SHOT)


@pytest.mark.parametrize("asking", [[], ["again"]], ids=["idle", "asking"])
def test_the_worker_ends_with_its_client(tmp_path, files, asking):
    """Whatever takes the client away; and nothing of it stays in shared memory."""
    code = f"""
        import os, signal, sys
        from pathlib import Path
        from holoreel.core.camera import Camera
        from holoreel.core.worker.client import Client
        from holoreel.core.worker.protocol import Layer, Shot
        client = Client(Path(sys.executable), log=Path({str(tmp_path / "log")!r}))
        camera = Camera(52, 41, 44.0, 43.0, 25.0, 22.0)
        drawing = client.draw(Shot((Layer(Path({str(files["lite"])!r}), 0.0, 5, camera),)))
        if sys.argv[1:]:  # another one, in a buffer that the worker has not seen yet
            client.begin(Shot((Layer(Path({str(files["lite"])!r}), 1.0, 5, camera),)))
        print(os.getpid(), client.pid, flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *asking], capture_output=True, text=True, check=False
    )
    ours, worker = map(int, done.stdout.split())
    for _ in range(200):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            break
        time.sleep(0.05)
    else:
        pytest.fail("the worker outlived its client")
    assert not list(Path("/dev/shm").glob(f"holoreel-{ours}-*"))


@pytest.mark.parametrize(
    "broken",
    [
        {"layers": []},
        {"layers": [3]},
        {"region": [0, 0, 0, 5]},
        {"region": [0, 0, 500, 5]},
        {"region": "all"},
        {"background": [0, 1]},
        {"background": [0, 1, float("nan")]},
    ],
)
def test_shots_that_cannot_be_are_refused(broken):
    value = {**SHOT.to_json(), **broken}
    with pytest.raises(HoloreelError):
        Shot.from_json(value)


def test_shots_come_back_as_they_went():
    shot = Shot(
        (Layer(Path("/a/b.reel"), 1.25, 7, FISHEYE, 2.5, "20"),), (1, 2, 3, 4), True, BEHIND, True, "fast", True
    )
    back = Shot.from_json(protocol.decode(protocol.encode({"id": 1, **shot.to_json()})))
    assert back.to_json() == shot.to_json()
    assert back.size == (2, 2)
