# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel doctor`: what works on this machine, and how to get what does not."""

import importlib.metadata
import json
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..blender import Blender, find_blender
from ..errors import HoloreelError

DEPENDENCIES = (
    *("numpy", "torch", "imageio", "OpenEXR", "scikit-image", "matplotlib", "jinja2"),
    *("av", "pycolmap", "safetensors", "scipy", "pillow"),
)
OLDEST_BLENDER = (4, 5)
_PATIENCE_SECONDS = 120
_LANES = {8: "8 lanes (AVX2 and FMA)", 4: "4 lanes (SSE4.1 or NEON)"}


@dataclass(frozen=True)
class Finding:
    """One thing that works (`detail` says how well) or does not (`remedy` says what to do)."""

    name: str
    works: bool
    detail: str
    remedy: str = ""


def run(blender: Path | None = None, as_json: Annotated[bool, tyro.conf.arg(name="json")] = False) -> None:
    """Say what works on this machine, and how to get what does not.

    Args:
        blender: the Blender to look at; without it, the one that `holoreel synth` would find.
        as_json: print JSON for programs to read.
    """
    findings = [*dependencies(), kernels(), gpu(), find(blender)]
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
        return
    width = max(len(finding.name) for finding in findings)
    print(f"{platform.platform()}, Python {platform.python_version()} ({sys.executable})")
    for finding in findings:
        print(f"{'ok     ' if finding.works else 'MISSING'}  {finding.name:{width}}  {finding.detail}")
        if finding.remedy:
            print(f"{'':7}  {'':{width}}  → {finding.remedy}")


def dependencies() -> list[Finding]:
    """Look at the Python packages, without importing them."""
    findings = []
    for name in DEPENDENCIES:
        try:
            findings.append(Finding(name, True, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            remedy = f"pip install {name}, or install Holoreel again: pip install -e ."
            findings.append(Finding(name, False, "not installed", remedy))
    return findings


def kernels() -> Finding:
    """Look at the compiled kernels: vector width and threads."""
    from ..render.native import available_cores, get_threads, set_lanes

    def look() -> str:
        lanes, used, cores = _LANES[set_lanes(0)], get_threads(), available_cores()
        return f"{lanes}, {used} threads on {cores} cores (HOLOREEL_THREADS changes that)"

    return _judge("kernels", look, " Until then everything runs on plain torch, about 50 times slower.")


def gpu() -> Finding:
    """Look at what the `cuda` backend needs: a torch for CUDA that sees a GPU, gsplat, and the compiler it needs.

    gsplat is not loaded: that may compile for minutes.
    """

    def look() -> str:
        import torch

        if torch.version.cuda is None:
            raise HoloreelError(
                "torch is a build for the CPU: for --backend cuda take one for CUDA from https://pytorch.org."
            )
        if not torch.cuda.is_available():
            raise HoloreelError("torch sees no NVIDIA GPU: for --backend cuda install one and its driver.")
        try:
            version = importlib.metadata.version("gsplat")
        except importlib.metadata.PackageNotFoundError as error:
            raise HoloreelError("gsplat is not installed: pip install -e '.[cuda]'.") from error
        if shutil.which("nvcc") is None:
            raise HoloreelError(
                f"nvcc is not on the PATH: gsplat compiles its kernels with it; install CUDA {torch.version.cuda}."
            )
        return f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}, gsplat {version}"

    return _judge("GPU", look, " Until then the CPU is used; nothing else is missing.")


def find(path: Path | None) -> Finding:
    """Look for Blender, and ask it for its version."""

    def look() -> str:
        blender = find_blender(path)
        return f"{_version(blender)} ({blender.path})"

    return _judge("Blender", look)


def _judge(name: str, look: Callable[[], str], remark: str = "") -> Finding:
    try:
        return Finding(name, True, look())
    except HoloreelError as error:
        what, _, remedy = str(error).partition(": ")
        return Finding(name, False, what, remedy + remark)


def _version(blender: Blender) -> str:
    code = "import bpy; print('version', bpy.app.version_string)"
    try:
        said = subprocess.run(
            blender.command(code), capture_output=True, text=True, timeout=_PATIENCE_SECONDS, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise HoloreelError(f"{blender.path} does not run: give another with --blender ({error}).") from error
    found = re.search(r"^version (\d+)\.(\d+)\S*.*$", said, re.MULTILINE)
    if not found:
        raise HoloreelError(f"{blender.path} did not say its version: give another with --blender.")
    if (int(found[1]), int(found[2])) < OLDEST_BLENDER:
        raise HoloreelError(
            f"{blender.path} is Blender {found[1]}.{found[2]}: install {'.'.join(map(str, OLDEST_BLENDER))} or newer."
        )
    return found[0].removeprefix("version ")
