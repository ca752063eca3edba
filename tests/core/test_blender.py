# SPDX-License-Identifier: GPL-3.0-or-later
"""Running functions in a child process: the protocol, crashes, and that nothing is left behind. Needs no Blender."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from holoreel.core.blender import Blender, find_blender, run_in_blender
from holoreel.core.errors import HoloreelError

PYTHON = Blender(Path(sys.executable), is_python=True)
HERE = "holoreel.tests.core.blender_scene"


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().split(")")[-1].split()[0] != "Z"


def gone(pid: int) -> bool:
    for _ in range(100):
        if not is_alive(pid):
            return True
        time.sleep(0.05)
    return False


def test_job_events_and_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    events: list[dict[str, Any]] = []
    job = {"text": "é\n@holoreel {}", "numbers": [1, 2.5, None]}
    result = run_in_blender(PYTHON, f"{HERE}:echo", job, log=tmp_path / "log", on_event=events.append)
    assert result["job"] == job
    assert result["pythonpath"] is None
    assert events == [{"event": "seen", "job": job}]
    assert (tmp_path / "log").read_text().splitlines() == ["half a line", "talk"]
    assert gone(result["pid"])


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("mendable", r"^the scene is empty: put something in\.$"),
        ("broken", r"KeyError: 'oops'; all it said is in .*log"),
        ("crash", r"ended by SIGSEGV, last saying 'Error: the last words'"),
        ("nothing", "AttributeError"),
    ],
)
def test_failures_are_one_sentence(tmp_path: Path, function: str, message: str) -> None:
    with pytest.raises(HoloreelError, match=message):
        run_in_blender(PYTHON, f"{HERE}:{function}", {}, log=tmp_path / "log")


def test_stopping_kills_the_child(tmp_path: Path) -> None:
    pids = []

    def stop(event: dict[str, Any]) -> None:
        pids.append(event["pid"])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_in_blender(PYTHON, f"{HERE}:linger", {}, log=tmp_path / "log", on_event=stop)
    assert gone(pids[0])


def test_child_ends_with_a_killed_parent(tmp_path: Path) -> None:
    code = f"""
from pathlib import Path
import sys
from holoreel.core.blender import Blender, run_in_blender
run_in_blender(Blender(Path(sys.executable), True), "{HERE}:linger", {{}}, log="{tmp_path}/log",
               on_event=lambda event: print(event["pid"], flush=True))
"""
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    assert is_alive(pid)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    assert gone(pid)


def test_python_without_bpy_and_programs_that_are_no_blender(tmp_path: Path) -> None:
    with pytest.raises(HoloreelError, match="has no bpy"):
        run_in_blender(PYTHON, f"{HERE}:build", {"path": str(tmp_path / "a.blend")}, log=tmp_path / "log")
    for name in ("/bin/false", "/bin/true"):
        with pytest.raises(HoloreelError, match="stopped with status"):
            run_in_blender(Blender(Path(name), False), f"{HERE}:echo", {}, log=tmp_path / "log")


def executable(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return path


def test_search_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from holoreel.core import blender as module

    def use(specs: Callable[[str], Any] = lambda name: None) -> None:
        monkeypatch.setattr(module.importlib.util, "find_spec", specs)

    monkeypatch.setattr(module, "_ROOT", tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("HOLOREEL_BLENDER", raising=False)
    use()
    with pytest.raises(HoloreelError, match="no Blender was found"):
        find_blender()
    old = executable(tmp_path / ".venv-bpy45/bin/python")
    assert find_blender() == Blender(old, True)
    new = executable(tmp_path / ".venv-bpy52/bin/python")
    assert find_blender() == Blender(new, True)
    binary = executable(tmp_path / "bin/blender")
    assert find_blender() == Blender(binary, False)
    use(lambda name: object())
    assert find_blender() == Blender(Path(sys.executable), True)
    monkeypatch.setenv("HOLOREEL_BLENDER", str(binary))
    assert find_blender() == Blender(binary, False)
    assert find_blender(tmp_path / ".venv-bpy45") == Blender(old, True)
    with pytest.raises(HoloreelError, match="no Blender at"):
        find_blender(tmp_path / "nothing")
    (tmp_path / "plain").write_text("")
    with pytest.raises(HoloreelError, match="no Blender at"):
        find_blender(tmp_path / "plain")
