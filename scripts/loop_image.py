# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the README's picture of the loop from a finished demo: `.venv/bin/python scripts/loop_image.py demo`."""

import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "loop.jpg"
WIDTH, GAP, CAPTION = 480, 16, 34


def panel(path: Path, caption: str) -> Image.Image:
    """Return a picture of the common width with its caption below."""
    picture = Image.open(path).convert("RGB")
    picture = picture.resize((WIDTH, round(picture.height * WIDTH / picture.width)), Image.Resampling.LANCZOS)
    framed = Image.new("RGB", (WIDTH, picture.height + CAPTION), "white")
    framed.paste(picture, (0, 0))
    ImageDraw.Draw(framed).text((2, picture.height + 8), caption, "#3a3f4b", ImageFont.load_default(17))
    return framed


def main(demo: Path) -> None:
    """Lay the stations of the loop out in two rows."""
    comparisons = sorted((demo / "report").glob("compare-*-0.png"))
    stem = str(comparisons[len(comparisons) // 2])[: -len("0.png")]
    panels = [
        panel(demo / "report" / "capture.png", "1  twelve cameras film a scene in Blender"),
        panel(Path(f"{stem}0.png"), "2  a view held out of the training"),
        panel(Path(f"{stem}1.png"), "3  the trained reel, Holoreel's raster"),
        panel(Path(f"{stem}2.png"), "4  the reel on Blender's timeline, Cycles"),
        panel(Path(f"{stem}3.png"), "5  their difference, eightfold"),
        panel(demo / "report" / "moving.png", "6  a new camera moves through it"),
    ]
    height = max(item.height for item in panels)
    sheet = Image.new("RGB", (3 * WIDTH + 2 * GAP, 2 * height + GAP), "white")
    for index, item in enumerate(panels):
        sheet.paste(item, (index % 3 * (WIDTH + GAP), index // 3 * (height + GAP)))
    sheet.save(OUT, quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
