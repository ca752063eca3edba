# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the pictures of docs/blender.md: `.venv/bin/python scripts/docs_images.py --demo demo --blender PATH`.

Renders come from the wheels, through the same jobs as `make demo`; pictures of windows from a real Blender on a virtual
screen (Xvfb, software OpenGL) that has the built extension in a profile of its own. Needs a finished demo.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from holoreel.core.blender import find_blender, run_in_blender
from holoreel.core.camera import Camera
from holoreel.core.capture import read_capture
from PIL import Image, ImageDraw, ImageFont, ImageGrab

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "images"
SCREEN = (1400, 900)
LOOKS = ("Splats", "Hull", "Points")
PATIENCE_SECONDS = 3600
GAP, CAPTION = 12, 30
CROPS = {
    "preferences": (176, 276, 1144, 520),
    "train": (0, 0, 292, 420),
    "synthesize": (0, 0, 292, 420),
}  # parts of pictures


def main() -> None:
    """Make all pictures, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--demo", type=Path, default=ROOT / "demo", help="a finished demo")
    parser.add_argument("--field", type=Path, help="a VideoRF reel to show; none without it")
    parser.add_argument("--blender", type=Path, help="a real Blender for the windows; renders alone without it")
    parser.add_argument("--only", choices=("looks", "windows"), help="make these alone")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--width", type=int, default=320, help="of the renders, in pixels")
    chosen = parser.parse_args()
    reel = next(chosen.demo.glob("*.reel"), None)
    if reel is None:
        sys.exit(f"There is no finished demo in {chosen.demo}: run make demo first.")
    if chosen.blender and shutil.which("Xvfb") is None:
        sys.exit("Windows need a virtual screen: apt-get install xvfb, or leave --blender away.")
    chosen.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        if chosen.only != "windows":
            looks(reel, chosen.demo, chosen.width, work, chosen.out / "blender-looks.jpg")
        if chosen.blender and chosen.only != "looks":
            windows(chosen, stage(reel, chosen.demo, work), work)


def looks(reel: Path, demo: Path, width: int, work: Path, out: Path) -> None:
    """Draw the same frame in each look, with Cycles."""
    camera = held_out_camera(demo, width)
    blender = find_blender(newest_wheel())
    pictures = []
    for look in LOOKS:
        shot = {"camera": camera.to_json(), "time": 0.25, "out": str(work / f"{look}.png")}
        setting = {"reel": str(reel.absolute()), "look": look, "engine": "CYCLES"}
        job: dict[str, Any] = {"setting": setting, "shots": [shot]}
        run_in_blender(blender, "holoreel.addon.render:main", job, log=work / "blender.log")
        pictures.append((work / f"{look}.png", look))
    strip(pictures, out)


def held_out_camera(demo: Path, width: int) -> Camera:
    """Return the camera that the demo's training did not see, at another size."""
    capture = read_capture(demo / "capture")
    camera = capture.cameras[capture.camera_names("test")[0]]
    return camera.scaled(width, round(camera.height * width / camera.width))


def stage(reel: Path, demo: Path, work: Path) -> Path:
    """Save a scene that plays the reel, with the held-out camera."""
    path = [(1, held_out_camera(demo, 960).to_json())]
    job = {
        "setting": {"reel": str(reel.absolute()), "engine": "EEVEE"},
        "stage": {"out": str(work / "scene.blend"), "path": path},
    }
    run_in_blender(find_blender(newest_wheel()), "holoreel.addon.render:save_scene", job, log=work / "blender.log")
    return work / "scene.blend"


def newest_wheel() -> Path:
    """Return the checkout's newest environment that has bpy."""
    return max(ROOT.glob(".venv-bpy*/bin/python"), key=str)


def windows(chosen: argparse.Namespace, scene: Path, work: Path) -> None:
    """Take pictures of the real Blender's window."""
    (package,) = ROOT.glob("dist/holoreel-*.zip")
    environment = {
        **os.environ,
        "BLENDER_USER_RESOURCES": str(work / "profile"),
        "LIBGL_ALWAYS_SOFTWARE": "1",
    }
    (work / "profile").mkdir()
    install = ["--command", "extension", "install-file", "--repo", "user_default", "--enable", package]
    subprocess.run([chosen.blender, *install], env=environment, check=True, stdout=subprocess.DEVNULL)
    job = {"scene": str(scene)}
    if chosen.field:
        job["field"] = str(chosen.field.absolute())
    with Screen() as screen:
        taken = photograph(chosen.blender, job, work, environment | {"DISPLAY": screen.name})
    for name, picture in taken.items():
        if not name.startswith("viewport-"):
            picture.crop(CROPS.get(name)).convert("RGB").save(chosen.out / f"blender-{name}.jpg", quality=85)
            continue
        picture.convert("RGB").save(work / f"{name}.png")
    titles = {"solid": "Solid", "material": "Material Preview", "rendered": "Rendered (EEVEE)",
              "free": "Rendered, from elsewhere"}  # fmt: skip
    pictures = [(work / f"viewport-{name}.png", title) for name, title in titles.items()]
    strip(pictures, chosen.out / "blender-shading.jpg", columns=2, width=620)


class Screen:
    """A virtual screen, for as long as it is used."""

    def __enter__(self) -> "Screen":
        read, write = os.pipe()
        size = f"{SCREEN[0]}x{SCREEN[1]}x24"
        command = ["Xvfb", "-displayfd", str(write), "-screen", "0", size, "+extension", "GLX"]
        self.server = subprocess.Popen(command, pass_fds=(write,), stderr=subprocess.DEVNULL)
        os.close(write)
        with os.fdopen(read) as pipe:
            self.name = f":{pipe.readline().strip()}"
        return self

    def __exit__(self, *_: object) -> None:
        self.server.terminate()
        self.server.wait()


def photograph(blender: Path, job: dict[str, str], work: Path, environment: dict[str, str]) -> dict[str, Image.Image]:
    """Run the tour, and take the pictures it asks for."""
    width, height = map(str, SCREEN)
    options = ["--enable-event-simulate", "--gpu-backend", "opengl", "-p", "0", "0", width, height]
    script = Path(__file__).with_name("docs_window.py")
    command = [blender, *options, "--python", script, "--", work, json.dumps(job)]
    taken: dict[str, Image.Image] = {}
    with (
        open(work / "window.log", "w+") as log,
        subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT) as child,
    ):
        began = time.monotonic()
        while child.poll() is None:
            if time.monotonic() - began > PATIENCE_SECONDS:
                child.terminate()
            for request in work.glob("*.request"):
                time.sleep(1.0)  # until what was drawn last is on the screen
                picture = ImageGrab.grab(xdisplay=environment["DISPLAY"])
                box = json.loads(request.read_text())
                taken[request.stem] = picture.crop(tuple(box)) if box else picture
                request.unlink()
            time.sleep(0.1)
        log.seek(0)
        said = log.read()
    if child.returncode or "Traceback" in said:
        sys.exit(said)
    return taken


def strip(pictures: list[tuple[Path, str]], out: Path, columns: int = 3, width: int | None = None) -> None:
    """Lay pictures out in rows, with captions."""
    images = [Image.open(path).convert("RGB") for path, _ in pictures]
    width = width or min(image.width for image in images)
    images = [image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
              for image in images]  # fmt: skip
    height = max(image.height for image in images) + CAPTION
    rows = -(-len(images) // columns)
    size = (columns * width + (columns - 1) * GAP, rows * height + (rows - 1) * GAP)
    sheet = Image.new("RGB", size, "white")
    for index, (image, (_, caption)) in enumerate(zip(images, pictures, strict=True)):
        left, top = index % columns * (width + GAP), index // columns * (height + GAP)
        sheet.paste(image, (left, top))
        place = (left + 2, top + image.height + 6)
        ImageDraw.Draw(sheet).text(place, caption, "#3a3f4b", ImageFont.load_default(17))
    sheet.save(out, quality=86)


if __name__ == "__main__":
    main()
