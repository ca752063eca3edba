# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line as a whole: help, unknown commands, and errors without tracebacks."""

import subprocess
import sys

import pytest
from holoreel.core.cli import COMMANDS, main


def test_help_lists_every_command(capsys: pytest.CaptureFixture) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS)


def test_no_command_and_a_wrong_one_are_status_2(capsys: pytest.CaptureFixture) -> None:
    assert main([]) == 2
    assert main(["trian"]) == 2
    assert "train" in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    assert len(capsys.readouterr().out) > 100


def test_a_reader_that_goes_away_is_no_error() -> None:
    command = f"{sys.executable} -m holoreel.core --help | head -n 1; test ${{PIPESTATUS[0]}} -eq 0"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
