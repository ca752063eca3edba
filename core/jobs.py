# SPDX-License-Identifier: GPL-3.0-or-later
"""Long work outside this process: started, watched, stopped and resumed through files in a folder of its own.

    job.json     what was asked for (`JobRecord`)
    lock         held as long as the job runs: no process number is ever trusted
    log.txt      all that the commands print
    status.json  how far it is (`core.status`), and status.png, the newest preview
    cancel       somebody wants it to stop
    end.json     how it ended
    taken        its result was taken (imported), by one program alone

The job goes on when the program that started it ends; another one finds it by its folder. Needs numpy only.
"""

import os
import secrets
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any

from . import supervise
from .errors import HoloreelError
from .files import read_json, write_json
from .status import Status, read_status

_TAIL_BYTES = 4096
_TAKEN = "taken"
_SIGKILL = 9  # which Windows does not name
_TEXTS = ("kind", "title", "result", "checkpoint", "resume_flag")


class State(Enum):
    """Where a job stands; the value is what people read."""

    RUNNING = "Running"
    STOPPING = "Stopping"
    DONE = "Done"
    STOPPED = "Stopped"
    FAILED = "Failed"

    @property
    def alive(self) -> bool:
        """Whether the job still runs."""
        return self in (State.RUNNING, State.STOPPING)


@dataclass(frozen=True)
class Command:
    """One program to run: its arguments, and what it is called while it runs; without a title it tells itself."""

    title: str
    argv: list[str]


@dataclass(frozen=True)
class JobRecord:
    """What a job is to do.

    `result` is the file or folder it makes. With `checkpoint` and `resume_flag`, the flag is added to the last command
    when the job is run again and the checkpoint is there. `notes` are the caller's own.
    """

    kind: str
    title: str
    commands: list[Command]
    result: str
    checkpoint: str = ""
    resume_flag: str = ""
    notes: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "JobRecord":
        """Read a record; raises `HoloreelError` where it is none."""
        value = read_json(path)
        try:
            commands = [Command(str(one["title"]), [str(part) for part in one["argv"]]) for one in value["commands"]]
            kind, title, result, checkpoint, flag = (str(value[key]) for key in _TEXTS)
            return cls(kind, title, commands, result, checkpoint, flag, dict(value["notes"]))
        except (KeyError, TypeError, ValueError) as error:
            raise HoloreelError(f"{path} is no record of a job ({error}): remove its folder.") from error


class Job:
    """A job and its folder. `state`, `status` and `message` are as of the last `look`."""

    def __init__(self, folder: Path, record: JobRecord) -> None:
        self.folder, self.record = folder, record
        self.state, self.status, self.message = State.RUNNING, Status(), ""
        self._process: subprocess.Popen[bytes] | None = None
        self._status_time = 0

    @property
    def name(self) -> str:
        """The name of the folder: it tells jobs apart, and sorts them by when they were begun."""
        return self.folder.name

    @property
    def log(self) -> Path:
        """Everything the commands have printed."""
        return self.folder / supervise.LOG

    @property
    def status_file(self) -> Path:
        """What the command writes its progress to."""
        return self.folder / supervise.STATUS

    def look(self) -> bool:
        """Look how the job stands; return whether anything has changed. Opens at most three small files."""
        before = (self.state, self.status)
        if self.state.alive:
            alive = self._is_alive()  # asked first: what it wrote before it ended is read below
            self._read_status()
            if alive:
                self.state = State.STOPPING if (self.folder / supervise.CANCEL).exists() else State.RUNNING
            else:
                self._conclude()
        return (self.state, self.status) != before

    def stop(self, at_once: bool = False) -> None:
        """Ask the job to stop: at the next checkpoint, or now. Raises `HoloreelError` where that cannot be written."""
        try:
            (self.folder / supervise.CANCEL).write_text(supervise.NOW if at_once else "", encoding="utf-8")
        except OSError as error:
            raise HoloreelError(f"{self.folder} cannot be written ({error.strerror}): stop the job by hand.") from error

    def resume(self, python: Path, environment: Mapping[str, str]) -> None:
        """Run the job again, from its checkpoint if there is one."""
        for name in (supervise.CANCEL, supervise.END, supervise.STATUS, _TAKEN):
            (self.folder / name).unlink(missing_ok=True)
        last = self.record.commands[-1]
        argv = [part for part in last.argv if part != self.record.resume_flag]
        if self.record.checkpoint and Path(self.record.checkpoint).exists():
            argv.append(self.record.resume_flag)
        self.record.commands[-1] = Command(last.title, argv)
        self.state, self.status, self.message, self._status_time = State.RUNNING, Status(), "", 0
        self.launch(python, environment)

    def launch(self, python: Path, environment: Mapping[str, str]) -> None:
        """Start the supervisor, with any Python; raises `HoloreelError` where that cannot be done."""
        write_json(self.folder / supervise.RECORD, asdict(self.record))
        try:
            self._process = subprocess.Popen(
                [str(python), "-I", str(Path(supervise.__file__).resolve()), str(self.folder)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=dict(environment),
                cwd=self.folder,
                start_new_session=True,
            )
        except OSError as error:
            raise HoloreelError(
                f"{python} cannot be run ({error.strerror or error}): choose another core environment."
            ) from error

    def take_result(self) -> bool:
        """Claim the result; True for the first who asks, whatever program that is."""
        try:
            os.close(os.open(self.folder / _TAKEN, os.O_CREAT | os.O_EXCL))
        except OSError:
            return False
        return True

    def remove(self) -> None:
        """Forget the job: its folder goes, its result stays."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _is_alive(self) -> bool:
        if self._process is not None:
            if self._process.poll() is None:
                return True
            self._process = None
        lock = supervise.take_lock(self.folder / supervise.LOCK)
        if lock is None:
            return True
        os.close(lock)
        return False

    def _read_status(self) -> None:
        with suppress(OSError, HoloreelError):
            changed = self.status_file.stat().st_mtime_ns
            if changed != self._status_time:
                self._status_time = changed
                self.status = read_status(self.status_file)

    def _conclude(self) -> None:
        """Say how the job ended."""
        try:
            end = read_json(self.folder / supervise.END)
        except HoloreelError:
            end = {}
        status, cancelled = end.get("status"), end.get("cancelled") is True
        if status == 0:
            self.state, self.message = State.DONE, ""
        elif cancelled:
            self.state, self.message = State.STOPPED, ""
        else:
            self.state, self.message = State.FAILED, self._obituary(status)

    def _obituary(self, status: object) -> str:
        """Say why a job has failed."""
        if not isinstance(status, int):
            return "it was ended from outside, or the disk of the log folder is full; resume it to go on."
        if status < 0:
            reason = ", as systems do when memory runs out" if status == -_SIGKILL else ""
            return f"it was ended by {_signal_name(-status)}{reason}; resume it to go on."
        return self._last_words() or f"it ended with status {status} and without a word."

    def _last_words(self) -> str:
        """Return the last line of the log, without the command's name before it."""
        try:
            with open(self.log, "rb") as file:
                file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL_BYTES))
                lines = file.read().decode("utf-8", "replace").splitlines()
        except OSError:
            return ""
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        command, _, sentence = last.partition(": ")
        return sentence if command.startswith("holoreel ") else last.removeprefix("$ ")


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def begin(
    folder: Path,
    record: JobRecord,
    python: Path,
    environment: Mapping[str, str],
    prepare: Callable[[Path], None] = lambda folder: None,
) -> Job:
    """Start a job in a new folder inside `folder`; "{job}" in its commands stands for that folder.

    `prepare` is called with the folder first, to put into it what the commands need.
    Raises `HoloreelError` where the folder cannot be written or the supervisor not be started, or `prepare` does; then
    nothing is left.
    """
    own = folder / f"{time.strftime('%Y%m%d-%H%M%S')}-{record.kind}-{secrets.token_hex(2)}"
    try:
        own.mkdir(parents=True)
    except OSError as error:
        raise HoloreelError(
            f"{own} cannot be made ({error.strerror}): choose a log folder you may write to, with room left."
        ) from error
    commands = [Command(one.title, [part.replace("{job}", str(own)) for part in one.argv]) for one in record.commands]
    job = Job(own, replace(record, commands=commands))
    try:
        prepare(own)
        job.launch(python, environment)
    except HoloreelError:
        job.remove()
        raise
    return job


def open_job(folder: Path) -> Job:
    """Take up a job that may have been started by another program; raises `HoloreelError` where there is none."""
    job = Job(folder, JobRecord.read(folder / supervise.RECORD))
    job.look()
    return job


def job_folders(folder: Path) -> list[Path]:
    """Return the folders of all jobs inside `folder`, newest first; what is no job, `open_job` refuses."""
    with suppress(OSError):
        return [folder / name for name in sorted(os.listdir(folder), reverse=True)]
    return []
