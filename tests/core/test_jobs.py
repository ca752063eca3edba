# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs: they end as their commands do, stop when asked to, and are taken up by whoever finds their folder."""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from holoreel.core import presets, supervise
from holoreel.core.errors import HoloreelError
from holoreel.core.gaussians import config as gaussians
from holoreel.core.jobs import Command, Job, JobRecord, State, begin, job_folders, open_job
from holoreel.core.videorf import config as videorf

PYTHON = Path(sys.executable)
PATIENCE = 30.0  # seconds; a machine may be busy

# Says that it runs (in a word that its code does not hold), then does nothing; Ctrl-C leaves a checkpoint behind.
SLEEPER = """
import pathlib, sys, time
try:
    print("a" + "wake", flush=True)
    while True:
        time.sleep(0.05)
except KeyboardInterrupt:
    pathlib.Path(sys.argv[1]).touch()
    sys.exit(130)
"""
STUBBORN = (
    "import signal, time\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\nprint('a' + 'wake', flush=True)\ntime.sleep(60)"
)


def job_of(folder: Path, *codes: str, checkpoint: Path | None = None) -> Job:
    """Start a job whose commands are Python code."""
    commands = [Command("", [sys.executable, "-c", code, str(checkpoint)]) for code in codes]
    record = JobRecord("train", "Train it", commands, str(folder / "result"), str(checkpoint or ""), "--resume")
    return begin(folder / "jobs", record, PYTHON, os.environ)


def wait(job: Job, ready: Callable[[Job], bool] = lambda job: not job.state.alive) -> State:
    """Look at a job until it has ended, or something else is so."""
    end = time.monotonic() + PATIENCE
    while not ready(job):
        assert time.monotonic() < end, (job.state, job.log.read_text())
        time.sleep(0.02)
        job.look()
    return job.state


def awake(job: Job) -> bool:
    """Whether the job's command has said that it runs."""
    return job.log.exists() and "awake" in job.log.read_text()


def test_commands_run_one_after_the_other_until_one_fails(tmp_path: Path) -> None:
    good = job_of(tmp_path, "print('one')", "print('two')")
    bad = job_of(tmp_path, "import sys; sys.exit('holoreel train: the file x: mend it.')", "print('never')")
    assert (wait(good), good.message) == (State.DONE, "")
    assert [line for line in good.log.read_text().splitlines() if not line.startswith("$")][-1] == "two"
    assert wait(bad) == State.FAILED
    assert bad.message == "the file x: mend it."
    assert "never" not in bad.log.read_text().splitlines()
    assert [folder.name for folder in job_folders(tmp_path / "jobs")] == sorted((bad.name, good.name), reverse=True)


def test_a_job_stops_at_a_checkpoint_and_goes_on_from_there(tmp_path: Path) -> None:
    job = job_of(tmp_path, SLEEPER, checkpoint=tmp_path / "checkpoint")
    wait(job, awake)
    job.stop()
    job.look()
    assert job.state == State.STOPPING
    assert wait(job) == State.STOPPED
    assert (tmp_path / "checkpoint").exists()
    job.resume(PYTHON, os.environ)
    wait(job, lambda job: job.log.read_text().count("awake") == 2)
    assert open_job(job.folder).record.commands[-1].argv[-1] == "--resume"
    job.stop()
    assert wait(job) == State.STOPPED
    job.resume(PYTHON, os.environ)
    assert job.record.commands[-1].argv.count("--resume") == 1
    job.stop(at_once=True)
    wait(job)


def test_what_does_not_listen_is_ended_at_once(tmp_path: Path) -> None:
    job = job_of(tmp_path, STUBBORN)
    wait(job, awake)
    job.stop()
    time.sleep(0.3)
    job.look()
    assert job.state == State.STOPPING
    job.stop(at_once=True)
    assert wait(job) == State.STOPPED


def test_another_program_takes_a_job_up(tmp_path: Path) -> None:
    """Nothing but the folder is handed on: not even a process number."""
    job = job_of(tmp_path, SLEEPER, checkpoint=tmp_path / "checkpoint")
    wait(job, awake)
    found = open_job(job.folder)
    assert (found.state, found.record) == (State.RUNNING, job.record)
    found.stop()
    assert wait(found) == State.STOPPED
    assert wait(job) == State.STOPPED
    assert open_job(job.folder).state == State.STOPPED


def test_a_killed_job_is_told_from_one_that_runs(tmp_path: Path) -> None:
    job = job_of(
        tmp_path, "import os, time\nprint(os.getpgid(0), flush=True)\nprint('a' + 'wake', flush=True)\ntime.sleep(60)"
    )
    wait(job, awake)
    group = int(job.log.read_text().splitlines()[-2])
    assert job._process is not None
    job._process.send_signal(signal.SIGKILL)
    job._process.wait()
    job.look()
    assert job.state.alive  # what it started still runs, and still holds the lock
    os.killpg(group, signal.SIGKILL)
    assert wait(job) == State.FAILED
    assert "ended from outside" in job.message
    assert open_job(job.folder).state == State.FAILED


def test_a_command_that_was_killed_or_says_nothing_is_spoken_for(tmp_path: Path) -> None:
    killed = job_of(tmp_path, "import os; os.kill(os.getpid(), 9)")
    mute = job_of(tmp_path, "")
    assert wait(killed) == State.FAILED
    assert killed.message == "it was ended by SIGKILL, as systems do when memory runs out; resume it to go on."
    assert wait(mute) == State.DONE
    mute.log.write_text("")
    (mute.folder / "end.json").write_text('{"status": 4, "cancelled": false}')
    assert open_job(mute.folder).message == "it ended with status 4 and without a word."


def test_a_job_runs_once_however_many_start_it(tmp_path: Path) -> None:
    job = job_of(tmp_path, SLEEPER, checkpoint=tmp_path / "checkpoint")
    wait(job, awake)
    assert supervise.main(job.folder) == supervise.TAKEN
    job.stop(at_once=True)
    wait(job)


def test_the_first_who_asks_takes_the_result(tmp_path: Path) -> None:
    job = job_of(tmp_path, "")
    wait(job)
    assert [open_job(job.folder).take_result(), job.take_result()] == [True, False]
    job.remove()
    assert job_folders(tmp_path / "jobs") == []


def test_titles_become_steps(tmp_path: Path) -> None:
    record = JobRecord("environment", "Make", [Command(name, [sys.executable, "-c", SLEEPER, ""]) for name in "ab"], "")
    job = begin(tmp_path, record, PYTHON, os.environ)
    wait(job, awake)
    job.look()
    assert (job.status.stage, job.status.share, job.status.figures) == ("a", 0.0, {"step": "1 of 2"})
    job.stop(at_once=True)
    assert wait(job) == State.STOPPED


def test_what_cannot_start_leaves_nothing(tmp_path: Path) -> None:
    record = JobRecord("train", "Train", [Command("", ["nowhere/python"])], "")
    with pytest.raises(HoloreelError, match=r"nowhere/python cannot be run .*: choose another core environment"):
        begin(tmp_path / "jobs", record, Path("nowhere/python"), os.environ)
    assert job_folders(tmp_path / "jobs") == []
    (tmp_path / "file").touch()
    with pytest.raises(HoloreelError, match=r"cannot be made .*: choose a log folder"):
        begin(tmp_path / "file" / "jobs", record, PYTHON, os.environ)
    job = begin(tmp_path / "jobs", record, PYTHON, os.environ)
    assert wait(job) == State.FAILED
    assert job.message == "nowhere/python cannot be run (No such file or directory)."


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"commands": 3}', '{"commands": [{"title": "a", "argv": null}]}'])
def test_a_foreign_record_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "job.json").write_text(text)
    with pytest.raises(HoloreelError, match=r"job\.json"):
        open_job(tmp_path)


def test_a_foreign_ending_is_a_failure(tmp_path: Path) -> None:
    job = job_of(tmp_path, "")
    wait(job)
    for text in ("torn", json.dumps({"status": "0"}), "[]"):
        (job.folder / "end.json").write_text(text)
        assert open_job(job.folder).state == State.FAILED


def test_presets_are_told_by_the_names_they_have() -> None:
    assert [name for name, *_ in presets.STG] == list(gaussians.PRESETS)
    assert [name for name, *_ in presets.VIDEORF] == list(videorf.PRESETS)
