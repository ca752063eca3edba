# SPDX-License-Identifier: GPL-3.0-or-later
"""Ranges, tiles and feature videos: what goes in comes out, and what is not ours is refused."""

import hashlib
import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.videorf.codec import CODECS, FeatureVideo, encode_video
from holoreel.core.videorf.mp4 import boxes, fragments
from holoreel.core.videorf.quantize import Ranges, fit_ranges
from holoreel.core.videorf.tiles import PROFILES, Tiling, tiling_of
from hypothesis import given, settings
from hypothesis import strategies as st

COUNTS = (4, 1, 3)
PICTURE = (64, 128)


def smooth_lumas(count=8, size=PICTURE):
    """Smooth pictures that move and reach both ends of the range; no two of them are alike."""
    y, x = np.mgrid[: size[0], : size[1]]
    waves = [np.sin(x / 17 + t / 2) + np.cos(y / 11 - t / 3) for t in range(count)]
    return [np.clip(128 + 70 * wave, 0, 255).astype(np.uint8) for wave in waves]


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("codec") / "a.mp4"
    lumas = smooth_lumas()
    return path, encode_video(path, iter(lumas), COUNTS, fps=23.976, qp=10), lumas


@settings(deadline=None)
@given(st.integers(2, 16), st.integers(0, 2**32 - 1))
def test_codes_are_within_half_a_step(channels, seed):
    random = np.random.default_rng(seed)
    low = random.uniform(-20, 5, channels)
    ranges = Ranges(tuple(low.tolist()), tuple((low + random.uniform(1e-3, 40, channels)).tolist()))
    values = low + (np.array(ranges.high) - low) * random.random((50, channels))
    assert (abs(ranges.decode(ranges.encode(values)) - values) <= 0.501 * ranges.step + 1e-5).all()
    codes = random.integers(0, 256, (50, channels)).astype(np.uint8)
    assert (ranges.encode(ranges.decode(codes)) == codes).all()
    assert (ranges.encode(np.stack((values[0] - 100, values[0] + 100))) == [[0], [255]]).all()


def test_ranges_are_the_widest_of_all_frames_and_leave_outliers_out():
    random = np.random.default_rng(0)
    frames = [np.column_stack((random.uniform(-3, 6, 2000), random.uniform(-1, 1, 2000), np.full(2000, 0.25)))] * 2
    frames[1] = frames[1] + [1, 0.5, 0]
    frames[0][0, 1] = 90.0
    plain, tight = fit_ranges(frames), fit_ranges(frames, percentile=1)
    assert plain.low[0] == tight.low[0] == -8
    assert plain.high[0] == pytest.approx(frames[1][:, 0].max())
    assert plain.high[1] == 90
    assert tight.high[1] == pytest.approx(1.5, abs=0.05)
    assert tight.low[1] == pytest.approx(-1, abs=0.05)
    assert tight.high[2] > tight.low[2]
    assert (tight.empty == [-8, 0, 0]).all()
    assert tight.encode(tight.empty)[0] == 0
    with pytest.raises(HoloreelError, match="nothing to encode"):
        fit_ranges([np.zeros((0, 3))])
    with pytest.raises(ValueError, match="NaN"):
        tight.encode(np.array([np.nan, 0, 0]))
    for bad in (((0.0, 1.0), (1.0, 1.0)), ((0.0,), (1.0,)), ((0.0, 0.0), (1.0, np.inf))):
        with pytest.raises(HoloreelError, match="ranges"):
            Ranges(*bad)


@settings(deadline=None)
@given(st.integers(2, 16), st.integers(1, 3), st.integers(1, 3))
def test_every_channel_has_its_tile(channels, high, wide):
    tiling = tiling_of("quality", channels, 16 * high, 16 * wide)
    place = np.arange(16 * high * 16 * wide).reshape(16 * high, 16 * wide, 1)
    image = ((place * 31 + np.arange(channels) * 7) % 256).astype(np.uint8)
    luma = tiling.pack(image)
    assert luma.shape == (4 * 16 * high, 4 * 16 * wide)
    assert (tiling.unpack(luma) == image).all()
    row, column = divmod(channels - 1, 4)
    tile = luma[row * 16 * high : (row + 1) * 16 * high, column * 16 * wide : (column + 1) * 16 * wide]
    assert (tile == image[..., -1]).all()


def test_profiles_are_what_decoders_take():
    assert tiling_of("universal", 8, 512, 512).picture == (1024, 2048)
    assert tiling_of("quality", 13, 512, 512).picture == (2048, 2048)
    assert set(PROFILES) == {"universal", "quality"}
    for arguments, message in (
        (("universal", 9, 512, 512), "9 channels do not fit into 4 x 2 tiles"),
        (("universal", 8, 512, 528), "up to 512 x 512"),
        (("universal", 8, 500, 512), "multiples of 16"),
        (("tiny", 8, 512, 512), "'tiny' is unknown"),
    ):
        with pytest.raises(HoloreelError, match=message):
            tiling_of(*arguments)
    with pytest.raises(ValueError, match="the luma is"):
        Tiling(2, 16, 16, 2, 1).unpack(np.zeros((16, 16), np.uint8))


@pytest.mark.parametrize(("profile", "level"), [("universal", 40), ("quality", 50)])
def test_the_largest_pictures_are_of_the_level_that_hardware_decodes(tmp_path, profile, level):
    import av

    picture = tiling_of(profile, 8, 512, 512).picture
    lumas = [np.full(picture, value, np.uint8) for value in (90, 91, 92, 93, 94)]
    encode_video(tmp_path / "a.mp4", lumas, (5,), fps=30, qp=20)
    with av.open(str(tmp_path / "a.mp4")) as container:
        context = container.streams.video[0].codec_context
        version, kind, _, coded = context.extradata[:4]
        assert (version, kind, coded) == (1, 100, level)  # 100: High
        assert context.pix_fmt in ("yuv420p", "yuvj420p")


@pytest.mark.parametrize("codec", CODECS)
def test_any_frame_decodes_to_what_all_frames_in_order_do(tmp_path, codec):
    lumas = smooth_lumas()
    coded = encode_video(tmp_path / "a.mp4", lumas, COUNTS, fps=30, qp=8, codec=codec)
    assert [(group.first, group.frames) for group in coded.groups] == [(0, 4), (4, 1), (5, 3)]
    in_order = FeatureVideo(tmp_path / "a.mp4", coded, PICTURE)
    decoded = [in_order.luma(frame) for frame in range(len(lumas))]
    for luma, truth in zip(decoded, lumas, strict=True):
        assert np.abs(luma.astype(int) - truth).max() <= 6
    assert decoded[0].max() == 255  # full range, and not only by its tag
    assert decoded[0].min() == 0
    anywhere = FeatureVideo(tmp_path / "a.mp4", coded, PICTURE)
    for frame in (7, 0, 2, 2, 1, 4, 5, 6, 3):
        assert (anywhere.luma(frame) == decoded[frame]).all()
    assert anywhere.luma(3) is anywhere.luma(3)  # not decoded again
    with pytest.raises(HoloreelError, match="no frame 8: take 0 to 7"):
        anywhere.luma(8)


def test_fragments_lie_back_to_back_and_rungs_get_smaller(video, tmp_path):
    path, coded, lumas = video
    assert coded.size == path.stat().st_size
    ends = [coded.head.size, *(group.offset + group.size for group in coded.groups)]
    assert [group.offset for group in coded.groups] == ends[:-1]
    assert ends[-1] == coded.size
    with path.open("rb") as file:
        kinds = [kind for kind, _ in boxes(file, coded.size)]
    assert kinds == [b"ftyp", b"moov", *[b"moof", b"mdat"] * 3]
    smaller = encode_video(tmp_path / "b.mp4", lumas, COUNTS, fps=30, qp=40)
    assert smaller.size < 0.8 * coded.size
    again = encode_video(tmp_path / "c.mp4", lumas, COUNTS, fps=23.976, qp=10)
    assert again == coded  # the same bytes


def test_what_is_whole_of_a_truncated_file_plays(video, tmp_path):
    path, coded, _ = video
    whole = FeatureVideo(path, coded, PICTURE)
    cut = tmp_path / "cut.mp4"
    last = coded.groups[-1]
    cut.write_bytes(path.read_bytes()[: last.offset + last.size - 1])
    player = FeatureVideo(cut, coded, PICTURE)
    assert player.missing() == [last]
    assert (player.luma(4) == whole.luma(4)).all()
    with pytest.raises(HoloreelError, match=r"cut.mp4 is cut off: frames 5 to 7 are not whole; fetch the rest"):
        player.luma(6)
    assert (player.luma(0) == whole.luma(0)).all()
    with pytest.raises(HoloreelError, match="put it beside its reel"):
        FeatureVideo(tmp_path / "none.mp4", coded, PICTURE)


def encoded_again(path: Path, source: Path, limited: bool) -> None:
    """Decode a video and encode it once more, as a careless tool would."""
    import av

    with av.open(str(source)) as old, av.open(str(path), "w") as new:
        stream = new.add_stream("libx264", rate=24, options={"qp": "10"})
        stream.height, stream.width = PICTURE
        stream.pix_fmt = "yuv420p"
        stream.codec_context.color_range = 1 if limited else 2
        for frame in old.decode(video=0):
            if limited:
                frame = frame.reformat(format="yuv420p", src_color_range="JPEG", dst_color_range="MPEG")
            frame.pts, frame.pict_type = None, 0
            new.mux(stream.encode(frame))
        new.mux(stream.encode(None))


def test_videos_encoded_again_are_refused_by_name(video, tmp_path):
    path, coded, _ = video
    for limited, message in ((True, "encoded again to a limited range"), (False, "damaged, cut, or encoded again")):
        other = tmp_path / "again.mp4"
        encoded_again(other, path, limited)
        other.write_bytes(other.read_bytes() + bytes(coded.size))  # long enough to hold every fragment
        with pytest.raises(HoloreelError, match=message):
            FeatureVideo(other, coded, PICTURE).luma(0)


def test_videos_that_are_not_as_their_reel_says_are_refused(video, tmp_path):
    """A reel may be written to lie: its checksums fit, its pictures do not."""
    path, coded, _ = video

    def refused(coded, picture, message, file=path):
        with pytest.raises(HoloreelError, match=message):
            FeatureVideo(file, coded, picture).luma(3)

    refused(coded, (128, 64), "its pictures are 128 x 64, not 64 x 128")
    first = coded.groups[0]
    refused(coded._replace(groups=(first._replace(luma_crc32=first.luma_crc32 ^ 1),)), PICTURE, "decoded luma is not")
    longer = first._replace(frames=6)
    with pytest.raises(HoloreelError, match="the group from frame 0 on has 4 frames"):
        FeatureVideo(path, coded._replace(groups=(longer,)), PICTURE).luma(5)
    # A limited-range video of which the manifest was written to match.
    limited = tmp_path / "limited.mp4"
    encoded_again(tmp_path / "plain.mp4", path, limited=True)
    import av

    with av.open(str(tmp_path / "plain.mp4")) as old:
        flags = {"movflags": "frag_keyframe+empty_moov+default_base_moof+skip_trailer"}
        with av.open(str(limited), "w", format="mp4", container_options=flags) as new:
            stream = new.add_stream_from_template(old.streams.video[0])
            for packet in old.demux(video=0):
                if packet.dts is not None:
                    packet.stream = stream
                    new.mux(packet)
    head, spans = fragments(limited)
    part = limited.read_bytes()[spans[0].offset :][: spans[0].size]
    lie = first._replace(offset=spans[0].offset, size=spans[0].size, sha256=hashlib.sha256(part).hexdigest())
    refused(coded._replace(head=head, groups=(lie,)), PICTURE, "of limited range", limited)


def without_packet(path: Path, source: Path, gone: int) -> None:
    """Copy a video, fragment by fragment, without one of its packets."""
    import av

    flags = {"movflags": "frag_keyframe+empty_moov+default_base_moof+skip_trailer"}
    with av.open(str(source)) as old, av.open(str(path), "w", format="mp4", container_options=flags) as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        packets = [packet for packet in old.demux(video=0) if packet.dts is not None]
        for packet in packets[:gone] + packets[gone + 1 :]:
            packet.stream = stream
            new.mux(packet)


def test_groups_cut_in_the_middle_are_refused(video, tmp_path):
    path, coded, _ = video
    cut = tmp_path / "cut.mp4"
    for gone, message in ((3, "group from frame 0 on has 3 frames"), (0, "group from frame 0 on has 0 frames")):
        without_packet(cut, path, gone)
        cut.write_bytes(cut.read_bytes() + bytes(coded.size))
        with pytest.raises(HoloreelError, match="damaged, cut, or encoded again"):
            FeatureVideo(cut, coded, PICTURE).luma(0)
        # The manifest of somebody who only wrote new checksums.
        without_packet(cut, path, gone)
        head, spans = fragments(cut)
        first = coded.groups[0]._replace(
            offset=spans[0].offset,
            size=spans[0].size,
            sha256=hashlib.sha256(cut.read_bytes()[spans[0].offset :][: spans[0].size]).hexdigest(),
        )
        with pytest.raises(HoloreelError, match=message):
            FeatureVideo(cut, coded._replace(head=head, groups=(first,)), PICTURE).luma(3)


def test_encoding_refuses_what_makes_no_video(tmp_path):
    lumas = smooth_lumas(3)
    for change, message in (
        ({"codec": "mpeg1"}, "'mpeg1' is unknown"),
        ({"qp": 52}, "QP of 52"),
        ({"counts": (2,)}, "3 frames came for groups of 2"),
        ({"counts": (2, 2)}, "3 frames came for groups of 4"),
        ({"lumas": []}, "0 frames came for groups of 3"),
    ):
        arguments = {"lumas": lumas, "counts": (2, 1), "qp": 20, "codec": "h264"} | change
        with pytest.raises(HoloreelError, match=message):
            encode_video(tmp_path / "a.mp4", fps=24, **arguments)
    assert list(tmp_path.iterdir()) == []


def test_files_that_are_no_fragmented_mp4_are_refused(video, tmp_path):
    path, coded, _ = video
    data = path.read_bytes()
    for index, bad in enumerate((b"", b"text that is no box", data[: coded.head.size], data[:-1], data + b"\0")):
        file = tmp_path / f"{index}.mp4"
        file.write_bytes(bad)
        with pytest.raises(HoloreelError, match="encode it again"):
            fragments(file)
    shutil.copy(path, tmp_path / "copy.mp4")
    assert fragments(tmp_path / "copy.mp4")[0] == coded.head
    large = (1).to_bytes(4, "big") + b"free" + (24).to_bytes(8, "big") + bytes(8)
    assert [kind for kind, _ in boxes(io.BytesIO(large), 24)] == [b"free"]
