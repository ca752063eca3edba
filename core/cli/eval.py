# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel eval REEL CAPTURE`: measure a reel against the held-out views of its capture."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from ..capture import CaptureOptions, read_capture
from ..capture.layouts import named_protocol
from ..draw import Drawing, Quality, open_player
from ..errors import HoloreelError
from ..evaluate import evaluate_player
from ..files import write_json
from ..gaussians.decoder import Activation
from ..images import picture_path, write_png
from ..lpips import InputRange, Lpips, load_lpips
from ..render import Backend
from ..report.evaluation import as_text, merge, write_page

NO_LPIPS = "LPIPS was not measured: it needs network weights that are not part of Holoreel (--lpips-weights)."


def run(
    file: tyro.conf.Positional[Path],
    capture: tyro.conf.Positional[Path],
    /,
    split: Literal["test", "train", "all"] = "test",
    protocol: Literal["rerf", "humanrf"] | None = None,
    out: Path | None = None,
    pictures: bool = True,
    speed: bool = False,
    json: Path | None = None,
    lpips_weights: Path | None = None,
    lpips_heads: Path | None = None,
    lpips_input: InputRange = "paper",
    rung: str | None = None,
    quality: Quality | None = None,
    decoder_output: Activation | None = None,
    backend: Backend = "auto",
    options: Annotated[CaptureOptions, tyro.conf.arg(name="")] = CaptureOptions(),  # noqa: B008
) -> None:
    """Measure PSNR, SSIM, DSSIM1, DSSIM2 and, with weights, LPIPS per camera and frame; the model's size and its speed.

    Where the capture tells its subject apart, also PSNR over the pixels of the mask and SSIM over its box.

    Args:
        file: the .reel, .ply, .stgc or .splatv, or the NAME.model of a VideoRF.
        capture: folder of a capture in any layout that `holoreel info` knows.
        split: which cameras of the capture.
        protocol: keep a dataset's protocol: rerf all frames of its held-out cameras over white, humanrf every third and
            every fifth of its own over black.
        out: folder for metrics.json, a page index.html and the drawn pictures (OUT/CAMERA/FRAME.png).
        pictures: write the drawn pictures too.
        speed: measure frames per second too, by the authors' protocol and by ours.
        json: add the result to this file, under the capture's name: one file for the scenes of a dataset, with means.
        lpips_weights: torchvision's alexnet-*.pth and/or vgg16-*.pth (or .safetensors): their folder, or one of them.
        lpips_heads: folder with the linear weights alex.pth and vgg.pth, if they are neither there nor installed.
        lpips_input: paper gives the networks pictures in [0, 1], standard in [-1, 1].
        rung: of a VideoRF: which rate, by its QP as 20, or with its codec as hevc:20; the best without it.
        quality: of a VideoRF: full takes the steps of its training, fast and draft longer ones; full without it.
        decoder_output: what the decoder of a bare .ply with a .pt beside it ends in; sigmoid without it.
        backend: which rasterizer.
        options: how the capture is read.
    """
    recording = read_capture(capture, options)
    if protocol and split != "test":
        raise HoloreelError(f"--protocol {protocol} looks at held-out cameras: leave --split {split} out.")
    rules = named_protocol(protocol, recording) if protocol else None
    player = open_player(file, backend, decoder_output=decoder_output, rung=rung, quality=quality)
    for sentence in player.report:
        print(f"note: {sentence}", file=sys.stderr)
    measures = _lpips(lpips_weights, lpips_heads, lpips_input)

    def keep(camera: str, frame: int, drawing: Drawing) -> None:
        if out and pictures:
            write_png(picture_path(out, camera, frame), drawing.image)

    with tqdm(unit="picture", dynamic_ncols=True, desc="eval", disable=not sys.stderr.isatty()) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        metrics = evaluate_player(player, recording, split, show, keep, measures, rules)
    if speed:
        from ..bench.play import measure_play

        name = recording.views(None if split == "all" else split)[0][0]
        metrics["speed"] = measure_play(player, recording.cameras[name])
    print(as_text(metrics))
    if not measures:
        print(NO_LPIPS)
    if out:
        write_json(out / "metrics.json", metrics)
        print(out / "metrics.json")
        print(write_page(out / "index.html", metrics))
    if json:
        merge(json, metrics)
        print(json)


def _lpips(weights: Path | None, heads: Path | None, input_range: InputRange) -> list[Lpips]:
    if weights is None:
        if heads is not None:
            raise HoloreelError(f"--lpips-heads {heads}: it is of no use without --lpips-weights; give both.")
        return []
    return load_lpips(weights, heads, input_range)
