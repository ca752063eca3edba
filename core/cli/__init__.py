# SPDX-License-Identifier: GPL-3.0-or-later
"""`holoreel COMMAND ...`: one module per command, imported only when it is asked for."""

import importlib
import os
import sys

from ..errors import HoloreelError

# Each module `core/cli/<name>.py` has one function `run` whose arguments are the command line; where defaults depend on
# the arguments themselves, `prepare(arguments)` returns that function instead.
COMMANDS = {
    "synth": "render a multi-view capture from a Blender scene",
    "sfm": "find points of the scene in every frame, and poses where a capture has none",
    "train": "train a reel from a capture",
    "render": "render a reel, PLY or .splatv from given cameras",
    "eval": "measure a reel against the held-out views of its capture",
    "export": "write a reel for other programs (splatv, 3D Gaussian PLY, points, the authors' files), or smaller",
    "info": "say what a reel, PLY, .splatv or capture holds, and what is wrong with it",
    "demo": "take a scene through the whole loop and write a report",
    "convert": "write a capture in the layout of another dataset",
    "bench": "measure the kernels on this machine",
    "doctor": "say what works on this machine, and how to get what does not",
}


def usage() -> str:
    """Return the overview that `holoreel --help` prints."""
    rows = "\n".join(f"  {name:<8} {text}" for name, text in COMMANDS.items())
    return f"usage: holoreel COMMAND ...\n\n{rows}\n\n`holoreel COMMAND --help` explains one command."


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return the exit status (2 for anything the user can mend)."""
    try:
        return _main(sys.argv[1:] if arguments is None else arguments)
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage(), flush=True)
        return 0 if arguments else 2
    name, rest = arguments[0], arguments[1:]
    if name not in COMMANDS:
        print(f"holoreel: no command '{name}'; take one of {', '.join(COMMANDS)}.", file=sys.stderr)
        return 2
    import tyro

    module = importlib.import_module(f".{name.replace('-', '_')}", __name__)
    try:
        command = module.prepare(rest) if hasattr(module, "prepare") else module.run
        tyro.cli(command, prog=f"holoreel {name}", args=rest)
        sys.stdout.flush()
    except HoloreelError as error:
        print(f"holoreel {name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\nholoreel {name}: stopped.", file=sys.stderr)
        return 130
    return 0
