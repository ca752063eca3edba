# SPDX-License-Identifier: GPL-3.0-or-later
"""The core environment: the Python that trains, synthesizes and renders, outside Blender.

Blender's own Python has numpy alone, so what needs torch runs in an environment of its own, as a child process. It is
never searched for on the disk: the preferences name it, or $HOLOREEL_PYTHON does, or it lies where `Create` makes it
(`default_folder`), or in the source checkout that this add-on runs from.
"""

import json
import os
import subprocess
import tomllib
from pathlib import Path

import bpy

from ..core.errors import HoloreelError
from ..core.jobs import Command, JobRecord

ENVIRONMENT_VARIABLE = "HOLOREEL_PYTHON"
PACKAGE = __package__.rpartition(".")[0]  # `holoreel`, or `bl_ext.<repository>.holoreel`
ROOT = Path(__file__).resolve().parents[1]

# What must not leak from Blender's Python into another one.
_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH")


def user_folder(name: str) -> Path:
    """Return the folder `name` among the user's files of this add-on; it need not exist yet.

    An installed extension has a folder of its own, which goes when the extension goes; a checkout that runs as the
    plain package takes Blender's folder for data files.
    """
    try:
        folder = bpy.utils.extension_path_user(PACKAGE, path=name)
    except ValueError:  # not installed as an extension
        folder = bpy.utils.user_resource("DATAFILES", path=f"holoreel/{name}")
    return Path(folder)


def default_folder() -> Path:
    """Return where `Create` puts the core environment unless told otherwise."""
    return user_folder("environment")


def python_in(environment: Path) -> Path:
    """Return the interpreter of a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def find_python(chosen: str) -> Path:
    """Return the interpreter of the core environment; `chosen` is what the preferences say, or empty.

    A folder stands for the virtual environment in it. Raises `HoloreelError` where what was chosen is no program, or
    nothing was chosen and there is none.
    """
    for path, source in (
        (chosen, "Preferences > Add-ons > Holoreel"),
        (os.environ.get(ENVIRONMENT_VARIABLE, ""), f"${ENVIRONMENT_VARIABLE}"),
    ):
        if path:
            return _existing(Path(path).expanduser(), source)
    for folder in (default_folder(), ROOT / ".venv"):
        if python_in(folder).is_file():
            return python_in(folder)
    raise HoloreelError(
        "the core environment is missing: choose or create one in Preferences > Add-ons > Holoreel, or set "
        f"${ENVIRONMENT_VARIABLE} to its Python."
    )


def _existing(path: Path, source: str) -> Path:
    if path.is_dir():
        path = python_in(path)
    if not (path.is_file() and os.access(path, os.X_OK)):
        raise HoloreelError(f"{path}: there is no Python here; give the core environment's in {source}.")
    return path.absolute()  # not resolved: a virtual environment is known by its own link


def child_environment() -> dict[str, str]:
    """Return the environment variables for a program outside Blender."""
    return {key: value for key, value in os.environ.items() if key not in _FOREIGN}


# --- Is it the right one? -------------------------------------------------------------------------------------------

CHECK_SECONDS = 120.0  # the first import of torch after a start may take long

# Exits with a sentence where the environment has no Holoreel, or that of another version.
_VERSION_CHECK = """
import importlib.metadata, sys
wanted = {wanted!r}
try:
    found = importlib.metadata.version("holoreel")
except importlib.metadata.PackageNotFoundError:
    sys.exit(f"the core environment {{sys.executable}} has no Holoreel: install it there, or choose another.")
if found != wanted:
    sys.exit(f"the core environment has Holoreel {{found}}, the add-on is {{wanted}}: install the same version there.")
"""

_REPORT = """
import json, platform, torch
from holoreel.core.render import get_backend
device = get_backend("auto").__name__.rpartition(".")[2]
said = {"Holoreel": found, "Python": platform.python_version(), "torch": torch.__version__, "draws by": device}
print(json.dumps(said))
"""


def addon_version() -> str:
    """Return this add-on's version, as its manifest says."""
    with open(ROOT / "blender_manifest.toml", "rb") as file:
        return str(tomllib.load(file)["version"])


def version_check(python: Path) -> Command:
    """Return the command that fails, with a sentence, where an environment is not of this add-on's version."""
    return Command("", [str(python), "-I", "-c", _VERSION_CHECK.format(wanted=addon_version())])


def check(python: Path, timeout: float = CHECK_SECONDS) -> dict[str, str]:
    """Run the core environment's Python once, and return what it says of itself: versions, and what it draws by.

    Raises `HoloreelError` where it does not run, takes longer than `timeout` seconds, or is of another version.
    """
    code = _VERSION_CHECK.format(wanted=addon_version()) + _REPORT
    try:
        ran = subprocess.run(
            [str(python), "-I", "-c", code],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout,
            env=child_environment(),
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise HoloreelError(
            f"{python} has not answered in {timeout:g} seconds: try again, or choose another."
        ) from error
    except OSError as error:
        raise HoloreelError(f"{python} cannot be run ({error.strerror or error}): choose another Python.") from error
    lines = (ran.stdout if ran.returncode == 0 else ran.stderr).strip().splitlines() or [""]
    if ran.returncode != 0:
        raise HoloreelError(f"{python} is no core environment: {lines[-1] or f'it ended with status {ran.returncode}'}")
    try:
        return {str(name): str(text) for name, text in json.loads(lines[-1]).items()}
    except (ValueError, AttributeError) as error:
        raise HoloreelError(f"{python} says {lines[-1][:80]!r}: this is no Python; choose another.") from error


# --- Making one -----------------------------------------------------------------------------------------------------

TORCH = "torch>=2.6,<3"
CPU_INDEX = "https://download.pytorch.org/whl/cpu"


def checkout() -> str:
    """Return the source checkout that this add-on runs from, empty where it is an installed extension.

    The extension's zip holds only what Blender's Python can run: it is no source to install the core from.
    """
    return str(ROOT) if (ROOT / "pyproject.toml").is_file() else ""


def creation(folder: Path, base: Path, package: str, wheels: str, cuda: bool) -> JobRecord:
    """Return the job that makes a core environment in `folder`, or brings the one there up to date.

    `base` is the Python it is made with, `package` what pip installs Holoreel from: a source checkout, a wheel, or an
    address. With a folder of `wheels`, everything comes from there and nothing from the network. `cuda` takes the torch
    of the Python Package Index and gsplat, for a graphics card; otherwise torch is the small build for processors.
    Raises `HoloreelError` where that cannot work, or needs the network and Blender may not use it.
    """
    if not package:
        raise HoloreelError(
            "Package is empty: give Holoreel's source checkout, a wheel of it, or an address that pip understands; the "
            "extension itself holds only what Blender's Python can run."
        )
    address = "://" in package
    if not address:
        package = str(Path(bpy.path.abspath(package)).expanduser())
        if not Path(package).exists():
            raise HoloreelError(
                f"{package}: there is nothing here; give Holoreel's source checkout, a wheel, or an address."
            )
    if wheels and not Path(wheels).is_dir():
        raise HoloreelError(f"{wheels} is no folder: give one with wheels of all that Holoreel needs.")
    if (address or not wheels) and not bpy.app.online_access:
        raise HoloreelError(
            "packages come from the network, and Blender may not use it: allow Online Access in Preferences > System, "
            "or give a folder of wheels."
        )
    pip = [str(python_in(folder)), "-m", "pip", "install", "--progress-bar", "off", "--disable-pip-version-check"]
    source = ["--no-index", "--find-links", wheels] if wheels else []
    torch_source = source or ([] if cuda else ["--index-url", CPU_INDEX])
    wanted = package
    if cuda:
        wanted = f"holoreel[cuda] @ {package}" if address else f"{package}[cuda]"
    commands = [
        Command("Make the environment", [str(base), "-m", "venv", str(folder)]),
        Command("Install torch", [*pip, TORCH, *torch_source]),
        Command("Install Holoreel", [*pip, wanted, *source]),
        Command("Check", version_check(python_in(folder)).argv),
    ]
    return JobRecord("environment", "Create the core environment", commands, result=str(folder))
