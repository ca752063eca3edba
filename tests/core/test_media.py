# SPDX-License-Identifier: GPL-3.0-or-later
"""Videos read by frame, and the stream of pictures that trains on them.

Every codec's frames are the right ones, colors are right, what is no video is refused. The stream draws every view
equally often, the same sequence however slow reading is, in little memory.
"""

import gc
import threading
import time
from collections import Counter
from pathlib import Path

import av
import imageio.v3 as imageio
import numpy as np
import pytest
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, View
from holoreel.core.capture import capture as capture_module
from holoreel.core.capture import media as media_module
from holoreel.core.capture.media import VideoFrame, iterate, keyframes, probe, read_frame
from holoreel.core.capture.stream import PictureStream
from holoreel.core.errors import HoloreelError

FRAMES, WIDTH, HEIGHT = 30, 48, 32


def picture(camera: int, frame: int) -> np.ndarray:
    """Black and white blocks that spell both numbers in binary, on noise that changes little: shifted, it is wrong."""
    pixels = np.full((HEIGHT, WIDTH, 3), (90, 140, 60 + 3 * frame), np.uint8)
    for bit in range(6):
        pixels[:8, 8 * bit : 8 * bit + 8] = 255 * (frame >> bit & 1)
        pixels[8:16, 8 * bit : 8 * bit + 8] = 255 * (camera >> bit & 1)
    return pixels


def numbers(pixels: np.ndarray) -> tuple[int, int]:
    """Camera and frame of a picture, even a lossy one."""
    bits = (pixels[:16].reshape(2, 8, 6, 8, 3).mean(axis=(1, 3, 4)) > 128) @ (1 << np.arange(6))
    return int(bits[1]), int(bits[0])


def write_video(
    path: Path, codec: str, pix_fmt: str, camera: int = 0, count: int = FRAMES, gop: int = 10, b_frames: int = 0,
    size: int = 1, **options: str,
) -> Path:  # fmt: skip
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH * size, HEIGHT * size, pix_fmt
        stream.codec_context.gop_size, stream.codec_context.max_b_frames = gop, b_frames
        for frame in range(count):
            pixels = picture(camera, frame).repeat(size, axis=0).repeat(size, axis=1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    return path


VIDEOS = {
    "rgb.mkv": ("ffv1", "bgr0", 0, {}),
    "rgb.avi": ("ffv1", "bgr0", 0, {}),
    "b_frames.mp4": ("libx264", "yuv444p", 3, {"crf": "0", "x264-params": "scenecut=0"}),
    "open_gop.mp4": ("libx264", "yuv420p", 3, {"crf": "10", "x264-params": "scenecut=0:open-gop=1"}),
    "packed.avi": ("mpeg4", "yuv420p", 2, {"b": "4M"}),
    "stream.ts": ("libx264", "yuv420p", 3, {"crf": "10", "x264-params": "scenecut=0"}),
    "raw.h264": ("libx264", "yuv420p", 2, {"crf": "10"}),
    "hidden.webm": ("libvpx-vp9", "yuv420p", 0, {"b": "4M", "auto-alt-ref": "1"}),
}


@pytest.mark.parametrize("name", VIDEOS)
def test_any_frame_in_any_order(tmp_path: Path, name: str) -> None:
    codec, pix_fmt, b_frames, options = VIDEOS[name]
    path = write_video(tmp_path / name, codec, pix_fmt, 5, b_frames=b_frames, **options)
    facts = probe(path)
    assert (facts.width, facts.height, facts.frames, facts.fps) == (WIDTH, HEIGHT, FRAMES, 25)
    assert np.allclose(np.diff(facts.times), 1 / 25)
    whole = list(iterate(path))
    assert [numbers(pixels) for pixels in whole] == [(5, frame) for frame in range(FRAMES)]
    for frame in np.random.default_rng(0).integers(0, FRAMES, 40):
        assert np.array_equal(read_frame(VideoFrame(path, int(frame))), whole[frame])
    assert [numbers(pixels)[1] for pixels in iterate(path, 13, 4)] == [13, 14, 15, 16]
    if codec == "ffv1":
        assert all(np.array_equal(pixels, picture(5, frame)) for frame, pixels in enumerate(whole))
    if name == "b_frames.mp4":
        assert keyframes(path) == (0, 10, 20)


def test_many_videos_take_turns(tmp_path: Path) -> None:
    """More videos than are kept open, and one that is written anew."""
    paths = [write_video(tmp_path / f"{c}.mkv", "ffv1", "bgr0", c) for c in range(media_module.OPEN_VIDEOS + 2)]
    for frame in (3, 4, 17):
        for camera, path in enumerate(paths):
            assert numbers(read_frame(VideoFrame(path, frame))) == (camera, frame)
    write_video(paths[0], "ffv1", "bgr0", 9, count=20)
    assert numbers(read_frame(VideoFrame(paths[0], 5))) == (9, 5)
    assert probe(paths[0]).frames == 20


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(("space", "kr", "kb"), [(1, 0.2126, 0.0722), (5, 0.299, 0.114), (2, 0.299, 0.114)])
def test_colors_follow_the_file(tmp_path: Path, full: bool, space: int, kr: float, kb: float) -> None:
    """Range and matrix by their definitions (ITU-R BT.601 and 709); a matrix that is not named is BT.601."""
    color = np.array([200.0, 90.0, 40.0])
    y = kr * color[0] + (1 - kr - kb) * color[1] + kb * color[2]
    cb, cr = (color[2] - y) / (2 - 2 * kb), (color[0] - y) / (2 - 2 * kr)
    scale, chroma, black = (1, 1, 0) if full else (219 / 255, 224 / 255, 16)
    planes = [round(black + scale * y), round(128 + chroma * cb), round(128 + chroma * cr)]
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 16, 16, "yuv444p"
        stream.codec_context.color_range, stream.codec_context.colorspace = 2 if full else 1, space
        frame = av.VideoFrame.from_ndarray(
            np.broadcast_to(np.array(planes, np.uint8)[:, None, None], (3, 16, 16)).copy(), format="yuv444p"
        )
        frame.color_range, frame.colorspace = 2 if full else 1, space
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert np.abs(read_frame(VideoFrame(path, 0)).reshape(-1, 3) - color).max() <= 2


def test_turned_videos_are_turned_back(tmp_path: Path) -> None:
    """A display matrix as phones write it, put into the track's header."""
    path = write_video(tmp_path / "a.mp4", "libx264rgb", "rgb24", 3, crf="0")
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40  # version 0: 40 bytes before the matrix
    quarter = np.array([0, 1 << 16, 0, -1 << 16, 0, 0, HEIGHT << 16, 0, 1 << 30], ">i4")  # clockwise
    data[matrix : matrix + 36] = quarter.tobytes()
    path.write_bytes(data)
    assert (probe(path).width, probe(path).height) == (HEIGHT, WIDTH)
    assert np.array_equal(read_frame(VideoFrame(path, 6)), np.rot90(picture(3, 6), -1))


def test_a_capture_of_videos(tmp_path: Path) -> None:
    """Frames of larger videos are averaged down; other sizes are refused."""
    path = write_video(tmp_path / "a.mkv", "ffv1", "bgr0", 6, size=3)
    images = {("a", j): VideoFrame(path, j + 4) for j in range(5)}
    capture = Capture({"a": Camera(WIDTH, HEIGHT, 40, 40, 24, 16)}, images, 5)
    capture.check_files()
    assert np.array_equal(capture.image("a", 2), picture(6, 6))
    assert capture.image("a", 2, background=(1, 1, 1)).shape == (HEIGHT, WIDTH, 3)
    wrong = Capture({"a": Camera(WIDTH + 1, HEIGHT, 40, 40, 24, 16)}, images, 5)
    with pytest.raises(HoloreelError, match=r"a\.mkv \(frame 4\) is 144x96, its camera says 49x32"):
        wrong.image("a", 0)


def test_what_is_no_video_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = write_video(tmp_path / "good.mp4", "libx264", "yuv420p", crf="10")
    with pytest.raises(HoloreelError, match="has 30 frames, and no frame 30"):
        read_frame(VideoFrame(good, 30))
    with pytest.raises(HoloreelError, match=r"none\.mp4 cannot be read"):
        probe(tmp_path / "none.mp4")
    bad = tmp_path / "bad.mp4"
    other = tmp_path / "list.txt"
    other.write_text(f"ffconcat version 1.0\nfile '{good}'\n")
    playlist = tmp_path / "list.m3u8"
    playlist.write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{good}\n#EXT-X-ENDLIST\n")
    data = good.read_bytes()
    for content in (b"", b"text", data[: len(data) // 3], other.read_bytes(), playlist.read_bytes()):
        bad.write_bytes(content)
        with pytest.raises(HoloreelError, match=r"bad\.mp4 cannot be read as a video \(.*\): fetch or encode it again"):
            probe(bad)
    for file in (other, playlist, tmp_path):
        with pytest.raises(HoloreelError, match="cannot be read as a video"):
            probe(file)
    monkeypatch.setattr(media_module, "MAX_PIXELS", 1000)
    bad.write_bytes(data)
    with pytest.raises(HoloreelError, match="frames are 48x32"):
        probe(bad)


def test_damage_inside_never_shifts_frames(tmp_path: Path) -> None:
    """One frame's bytes overwritten: it is shown as well as it can be, or refused; all others are the right ones."""
    path = write_video(tmp_path / "a.mp4", "libx264", "yuv444p", 2, gop=1, crf="0")
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    data = bytearray(path.read_bytes())
    place, size = packets[12]
    data[place : place + size] = b"\xff" * size
    path.write_bytes(data)
    assert probe(path).frames == FRAMES
    with pytest.raises(HoloreelError, match=r"a\.mp4: frame 12 cannot be read \(.*\): fetch or encode the video again"):
        read_frame(VideoFrame(path, 12))
    others = [frame for frame in range(FRAMES) if frame != 12]
    assert [numbers(read_frame(VideoFrame(path, frame)))[1] for frame in others] == others


CAMERAS = 4
BYTES = 3 * WIDTH * HEIGHT
NUMBER = {f"cam{index}": index for index in range(CAMERAS)}


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Four cameras, 30 frames; two videos with keyframes far apart, two with near ones."""
    folder = tmp_path_factory.mktemp("videos")
    images, cameras = {}, {}
    for name, index in NUMBER.items():
        path = write_video(folder / f"{name}.mp4", "libx264", "yuv444p", index, gop=(15, 3)[index % 2], crf="0")
        cameras[name] = Camera(WIDTH, HEIGHT, 40, 40, 24, 16, name=name)
        images |= {(name, j): VideoFrame(path, j) for j in range(FRAMES)}
    return Capture(cameras, images, FRAMES)


def draw(stream: PictureStream, count: int) -> list[View]:
    """Draw views, checking that every picture is its view's."""
    views = []
    for _ in range(count):
        view, picture = stream.next()
        assert numbers(picture) == (NUMBER[view[0]], view[1])
        assert picture.dtype == np.uint8
        views.append(view)
    return views


def test_what_fits_is_permuted(videos: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each pass has every view once, and no picture is read twice."""
    read: Counter[object] = Counter()
    before = capture_module.read_frame
    monkeypatch.setattr(capture_module, "read_frame", lambda frame: read.update([frame]) or before(frame))
    views = videos.views()
    with PictureStream(videos, views, seed=3, limit_bytes=BYTES * len(views)) as stream:
        passes = [draw(stream, len(views)) for _ in range(3)]
    assert all(sorted(part) == sorted(views) for part in passes)
    assert passes[0] != passes[1] != passes[2] != views
    assert set(read.values()) == {1}
    # Permutations without a pattern: neighbors in time are not neighbors in the sequence.
    steps = [abs(a[1] - b[1]) for a, b in zip(passes[1], passes[1][1:], strict=False)]
    assert 7 < np.mean(steps) < 13


def test_what_does_not_fit_is_shuffled_in_a_window(videos: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Equally often in the long run, never more than the limit in memory, and mostly decoded in sequence."""
    views, decoded = videos.views(), 0
    before = media_module._Decoder._jump
    jumps = []
    monkeypatch.setattr(media_module._Decoder, "_jump", lambda self, pts: jumps.append(pts) or before(self, pts))
    with PictureStream(videos, views, seed=3, limit_bytes=40 * BYTES) as stream:
        drawn = []
        for _ in range(10 * len(views)):
            drawn += draw(stream, 1)
            assert stream._shelf is not None
            assert len(stream._shelf._pictures) <= 40
            decoded += 1
    counts = Counter(drawn)
    assert set(counts) == set(views)
    assert 8 <= min(counts.values()) <= max(counts.values()) <= 12
    assert len(jumps) < decoded / 2
    cameras = [NUMBER[name] for name, _ in drawn[200:]]
    assert np.mean(np.diff(cameras) == 0) < 0.45  # 0.25 without any order
    steps = np.abs(np.diff([frame for _, frame in drawn[200:]]))
    assert steps.mean() > 7  # 10 without any order


@pytest.mark.parametrize("limit", [10, 40, 1000])
def test_the_seed_alone_decides(videos: Capture, limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    views = videos.views()

    def sequence(seed: int) -> list[View]:
        with PictureStream(videos, views, seed=seed, limit_bytes=limit * BYTES) as stream:
            return draw(stream, 150)

    quick = sequence(1)
    before = Capture.image
    slow = np.random.default_rng(0)

    def late(*args: object, **kwargs: object) -> np.ndarray:
        time.sleep(slow.uniform(0, 0.004))
        return before(*args, **kwargs)

    monkeypatch.setattr(Capture, "image", late)
    assert sequence(1) == quick
    assert sequence(2) != quick


@pytest.mark.parametrize("limit", [10, 40, 1000])
@pytest.mark.parametrize("after", [0, 1, 70, 300])
def test_a_state_goes_on(videos: Capture, limit: int, after: int) -> None:
    arguments = {"views": videos.views(), "seed": 5, "limit_bytes": limit * BYTES}
    with PictureStream(videos, **arguments) as stream:
        draw(stream, after)
        state = stream.state()
        expected = draw(stream, 130)
    with PictureStream(videos, **arguments) as stream:
        stream.load_state(state)
        assert draw(stream, 130) == expected
        stream.load_state(state)
        assert draw(stream, 30) == expected[:30]
    with PictureStream(videos, videos.views(), seed=5, limit_bytes=20 * BYTES) as other:
        other.load_state(state)
        assert len(draw(other, 50)) == 50


def test_no_thread_is_left(videos: Capture) -> None:
    others = set(threading.enumerate())

    def threads() -> list[str]:
        return [thread.name for thread in threading.enumerate() if thread not in others]

    stream = PictureStream(videos, videos.views(), limit_bytes=20 * BYTES)
    assert threads() == []
    first = draw(stream, 3)
    assert threads() == ["holoreel pictures"]
    stream.close()
    assert threads() == []
    stream.close()
    again = PictureStream(videos, videos.views(), limit_bytes=20 * BYTES)
    assert draw(again, 3) == first
    assert len(threads()) == 1
    del again
    gc.collect()
    assert threads() == []


def test_files_with_alpha_and_errors(tmp_path: Path) -> None:
    """PNGs over the background; a file that vanishes is named by the draw that needs it."""
    images = {}
    for frame in range(6):
        images["a", frame] = tmp_path / f"{frame}.png"
        imageio.imwrite(images["a", frame], np.full((4, 6, 4), (200, 100, 50, 51 * (frame % 2)), np.uint8))
    capture = Capture({"a": Camera(6, 4, 5, 5, 3, 2)}, images, 6)
    with PictureStream(capture, capture.views(), (1.0, 0.0, 0.0)) as stream:
        for _ in range(12):
            view, picture = stream.next()
            assert picture.shape == (4, 6, 3)
            assert picture[0, 0].tolist() == ([244, 20, 10] if view[1] % 2 else [255, 0, 0])
    images["a", 4].unlink()
    with PictureStream(capture, capture.views()) as stream, pytest.raises(HoloreelError, match=r"4\.png"):
        [stream.next() for _ in range(7)]
    with pytest.raises(HoloreelError, match="no pictures"):
        PictureStream(capture, [])
    monkey = pytest.MonkeyPatch()
    with monkey.context() as patch, PictureStream(capture, capture.views()) as stream:
        patch.setattr(Capture, "image", lambda *_args, **_kwargs: 1 // 0)
        with pytest.raises(HoloreelError, match="ZeroDivisionError"):
            stream.next()
