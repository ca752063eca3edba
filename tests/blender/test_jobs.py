# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs as an artist meets them: started by operators, watched by ticks, stopped, resumed, broken, and imported."""

import shlex
import stat
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import MagicMock

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import environment, jobs, preferences, previews, reels, synthesis
from holoreel.core.camera import Camera
from holoreel.core.capture import Capture, Points, write_capture, write_points
from holoreel.core.errors import HoloreelError
from holoreel.core.jobs import Command, Job, JobRecord, State
from holoreel.core.status import preview_path

ROOT = Path(holoreel.__file__).parent
PATIENCE = 120.0  # seconds: the machine may be busy
SHORT = "--iterations 600 --checkpoint-every 20 --density.prune-every 50"

# A stand-in for the core environment: it says that it runs, and Ctrl-C ends it.
SLEEPER = "import time\nprint('a' + 'wake', flush=True)\ntime.sleep(60)"


@pytest.fixture(autouse=True)
def registered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The add-on, with its logs in a folder of the test's own."""
    monkeypatch.setitem(preferences._DEFAULTS, "log_folder", str(tmp_path / "logs"))
    holoreel.register()
    yield
    for job in jobs.known():
        job.stop(at_once=True)
        settle(job)
    holoreel.unregister()


@pytest.fixture
def core(monkeypatch: pytest.MonkeyPatch) -> Path:
    """The interpreter of a real core environment."""
    python = ROOT / ".venv" / "bin" / "python"
    if not python.exists():
        pytest.skip(".venv is absent: make setup")
    monkeypatch.setenv(environment.ENVIRONMENT_VARIABLE, str(python))
    return python


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Two cameras look at a gray wall for two frames; `right` is held out."""
    random = np.random.default_rng(0)
    folder = tmp_path / "wall"
    folder.mkdir()
    image = bpy.data.images.new("gray", 32, 24)
    image.file_format = "PNG"
    cameras, images, seeds = {}, {}, {}
    for name, x in (("left", -0.2), ("right", 0.2)):
        cameras[name] = Camera.look_at((x, -3, 0), (0, 0, 0), width=32, height=24, fx=30, name=name)
        for frame in range(2):
            image.pixels[:] = np.tile([0.3, 0.5, 0.4 + 0.2 * frame, 1], 32 * 24).tolist()
            images[name, frame] = folder / f"{name}-{frame}.png"
            image.save(filepath=str(images[name, frame]))
    for frame in range(2):
        seeds[frame] = folder / f"{frame}.ply"
        write_points(seeds[frame], Points(random.uniform(-1, 1, (80, 3)), np.full((80, 3), 90, np.uint8)))
    bpy.data.images.remove(image)
    made = Capture(cameras, images, 2, {"right": "test"}, fps=24.0, frame_start=1, seeds=seeds, source=folder)
    write_capture(folder, made)
    return folder


def tick_until(ready: Callable[[], bool]) -> None:
    """Tick, as Blender's timer would, until something is so."""
    end = time.monotonic() + PATIENCE
    while not ready():
        assert time.monotonic() < end, [(job.state, job.message, job.log.read_text()) for job in jobs.known()]
        time.sleep(0.05)
        jobs.tick()


def settle(job: Job) -> State:
    """Tick until a job has ended."""
    tick_until(lambda: not job.state.alive)
    return job.state


def sleeping_job(**notes: object) -> Job:
    """Start a job that does nothing for a minute."""
    result = f"nowhere-{len(jobs.known())}.reel"
    record = JobRecord("train", "Sleep", [Command("", [sys.executable, "-c", SLEEPER])], result, notes=notes)
    return jobs.start(record, Path(sys.executable))


def awake(job: Job) -> bool:
    """Whether a job's command has said that it runs."""
    return job.log.exists() and "awake" in job.log.read_text()


def drawn(panel: type[bpy.types.Panel]) -> list[str]:
    """Draw a panel on paper; return all the texts on it."""
    layout = MagicMock()
    for part in ("box", "column", "row"):
        getattr(layout, part).return_value = layout
    panel.draw(MagicMock(layout=layout), MagicMock(**{"region.width": 300}))
    return [call.kwargs["text"] for call in layout.mock_calls if "text" in call.kwargs]


def test_a_training_shows_itself_stops_survives_a_reload_goes_on_and_imports_its_reel(
    core: Path, capture: Path, tmp_path: Path
) -> None:
    from holoreel.panels.jobs import HOLOREEL_PT_jobs

    settings = bpy.context.scene.holoreel_train
    settings.capture, settings.out, settings.options = str(capture), str(tmp_path / "wall"), SHORT
    assert bpy.ops.holoreel.train() == {"FINISHED"}
    (job,) = jobs.known()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"))
    tick_until(lambda: job.status.previews > 0)
    assert 0 < job.status.done < job.status.total == 600
    assert {"loss", "PSNR"} <= job.status.figures.keys()
    previews.icon(job.name, job.status.previews, preview_path(job.status_file))  # 0 in background mode
    assert tuple(previews._pictures[job.name].image_size) == (32, 24)
    assert any("left" in text and "%" in text for text in drawn(HOLOREEL_PT_jobs))
    assert bpy.ops.holoreel.stop_job() == {"FINISHED"}
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
    assert jobs.known() == [job]
    assert settle(job) == State.STOPPED
    assert (tmp_path / "wall.checkpoint").is_dir()
    assert not (tmp_path / "wall.reel").exists()
    assert bpy.ops.holoreel.resume_job(job=job.name) == {"FINISHED"}
    assert settle(job) == State.DONE
    assert "--resume" in job.log.read_text()
    (reel,) = [candidate for candidate in bpy.data.objects if reels.modifier_of(candidate)]
    assert reel.name == "wall"
    assert jobs.tick() is None
    assert jobs.PENDING not in bpy.context.scene or not bpy.context.scene[jobs.PENDING]


def test_a_job_that_another_blender_started_is_found_and_can_be_stopped() -> None:
    """After a restart nothing is known but the folder of logs."""
    before = sleeping_job()
    tick_until(lambda: awake(before))
    holoreel.unregister()
    holoreel.register()
    assert jobs.known() == []
    jobs._first_look()
    tick_until(lambda: bool(jobs.known()))
    (found,) = jobs.known()
    assert found is not before
    assert (found.name, found.state) == (before.name, State.RUNNING)
    with pytest.raises(RuntimeError, match="no job has ended"):
        bpy.ops.holoreel.remove_job(job=found.name)
    assert bpy.ops.holoreel.stop_job(job=found.name) == {"FINISHED"}
    assert settle(found) == State.STOPPED
    assert bpy.ops.holoreel.remove_job(job=found.name) == {"FINISHED"}
    assert jobs.known() == []
    assert not before.folder.exists()


def done_job(folder: Path, reel: Path, into: bpy.types.Scene | None) -> Job:
    """Start a job that ends at once, its result already there."""
    record = JobRecord("train", "Quick", [Command("", [sys.executable, "-c", ""])], str(reel))
    return jobs.start(record, Path(sys.executable), import_into=into)


@pytest.fixture
def reel(tmp_path: Path, random_model: Callable[..., object]) -> Path:
    """A small reel."""
    from holoreel.core.reel import save_gaussians

    save_gaussians(tmp_path / "small.reel", random_model(10), fps=24, frame_start=1, frame_count=2)
    return tmp_path / "small.reel"


def imported() -> list[str]:
    """The names of the reels in the file that is open."""
    return [candidate.name for candidate in bpy.data.objects if reels.modifier_of(candidate)]


def test_a_reel_is_imported_into_the_file_that_asked_for_it_once(reel: Path, tmp_path: Path) -> None:
    job = done_job(tmp_path, reel, bpy.context.scene)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "asked.blend"))  # it had no name when the job was started
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
    assert settle(job) == State.DONE
    jobs.tick()
    assert imported() == []
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "asked.blend"))
    for _ in range(3):
        jobs.tick()
    assert imported() == ["small"]
    assert bpy.ops.holoreel.import_result(job=job.name) == {"FINISHED"}  # who wants it twice says so
    assert imported() == ["small", "small.001"]


def test_a_reel_waits_until_object_mode(reel: Path, tmp_path: Path) -> None:
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.mode_set(mode="EDIT")
    job = done_job(tmp_path, reel, bpy.context.scene)
    assert settle(job) == State.DONE
    assert jobs.tick() == jobs.TICK_SECONDS
    assert imported() == []
    bpy.ops.object.mode_set(mode="OBJECT")
    jobs.tick()
    assert imported() == ["small"]
    assert jobs.tick() is None


def test_a_reel_that_cannot_be_read_is_said_on_its_job(tmp_path: Path) -> None:
    job = done_job(tmp_path, tmp_path / "gone.reel", bpy.context.scene)
    tick_until(lambda: bool(job.message))
    assert "gone.reel" in job.message
    assert imported() == []


def test_a_tick_opens_a_few_small_files_for_jobs_that_run_and_none_for_others(tmp_path: Path) -> None:
    """Work is counted, not time: that is the same on every machine."""
    opened: list[str] = []
    counting = False

    def hook(event: str, arguments: tuple) -> None:
        if counting and event in ("open", "os.listdir", "os.scandir", "subprocess.Popen"):
            opened.append(str(arguments[0]))

    sys.addaudithook(hook)
    ended = [done_job(tmp_path, tmp_path / f"{index}.reel", None) for index in range(5)]
    tick_until(lambda: not any(job.state.alive for job in ended))
    counting = True
    assert jobs.tick() is None
    assert opened == []
    counting = False
    running = [sleeping_job() for _ in range(2)]
    tick_until(lambda: all(map(awake, running)))
    for _ in range(3):
        counting = True
        assert jobs.tick() == jobs.TICK_SECONDS
        counting = False
    assert len(opened) <= 3 * len(running)
    holoreel.unregister()
    holoreel.register()
    jobs.scan()
    opened.clear()
    counting = True
    jobs.tick()
    counting = False
    # Jobs that another session left, a few per tick: a record, a lock, an end, a log, a status.
    assert len(opened) <= 5 * jobs.ADOPTED_PER_TICK
    tick_until(lambda: len(jobs.known()) == 7)


def test_the_timer_rests_when_nothing_runs_and_is_gone_with_the_addon() -> None:
    for timer in (jobs.tick, jobs._first_look):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    assert jobs.tick() is None
    job = sleeping_job()
    assert bpy.app.timers.is_registered(jobs.tick)
    job.stop(at_once=True)
    settle(job)
    holoreel.unregister()
    assert not bpy.app.timers.is_registered(jobs.tick)
    assert not bpy.app.timers.is_registered(jobs._first_look)
    assert not hasattr(bpy.types.Scene, "holoreel_train")
    assert not hasattr(bpy.types.Scene, "holoreel_synth")
    holoreel.register()


# --- What is refused ------------------------------------------------------------------------------------------------


def test_without_a_core_environment_the_buttons_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(environment.ENVIRONMENT_VARIABLE, "/nowhere/python")
    assert not bpy.ops.holoreel.train.poll()
    with pytest.raises(RuntimeError, match=r"/nowhere/python: there is no Python here.*HOLOREEL_PYTHON"):
        bpy.ops.holoreel.train()
    monkeypatch.delenv(environment.ENVIRONMENT_VARIABLE)
    monkeypatch.setattr(environment, "ROOT", Path("/nowhere"))
    with pytest.raises(HoloreelError, match="the core environment is missing: choose or create one in Preferences"):
        preferences.core_python()


def test_a_folder_stands_for_the_environment_in_it(core: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(environment.ENVIRONMENT_VARIABLE, str(core.parents[1]))
    assert preferences.core_python() == core


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"capture": ""}, "Capture is empty"),
        ({"capture": "/nowhere"}, "/nowhere: there is no capture here"),
        ({"capture": "//wall"}, "save the .blend first"),
        ({"out": ""}, "Reel is empty"),
        ({"out": "relative.reel"}, "give the whole path"),
        ({"out": "taken"}, r"taken\.reel is there already: choose another name, or tick Overwrite"),
        ({"out": "stopped"}, r"stopped\.checkpoint: a stopped run lies here; tick Go On"),
        ({"options": "--a 'b"}, "Options are not understood"),
    ],
)
def test_settings_that_cannot_work_are_refused_before_anything_starts(
    core: Path, tmp_path: Path, changes: dict[str, str], sentence: str
) -> None:
    (tmp_path / "taken.reel").touch()
    (tmp_path / "stopped.checkpoint").mkdir()
    settings = bpy.context.scene.holoreel_train
    for name, value in ({"capture": str(tmp_path), "out": "new"} | changes).items():
        whole = name == "out" and value and not value.startswith("relative")
        setattr(settings, name, str(tmp_path / value) if whole else value)
    with pytest.raises(RuntimeError, match=sentence):
        bpy.ops.holoreel.train()
    assert jobs.known() == []
    assert not preferences.log_folder().exists()


def test_two_jobs_do_not_make_the_same(tmp_path: Path) -> None:
    job = sleeping_job()
    with pytest.raises(HoloreelError, match="is being made by a job that runs"):
        jobs.start(job.record, Path(sys.executable))
    assert jobs.known() == [job]


def test_settings_become_flags(core: Path, tmp_path: Path) -> None:
    from holoreel.addon.training import training

    settings = bpy.context.scene.holoreel_train
    settings.capture, settings.out, settings.method = str(tmp_path), str(tmp_path / "a b.reel"), "videorf"
    settings.videorf_preset, settings.all_frames, settings.options = "fast", False, "--qps 20 30"
    (tmp_path / "a b.checkpoint").mkdir()
    settings.go_on = True
    argv = training(settings, core, "cuda").commands[-1].argv
    flags = "--preset fast --status {job}/status.json --frames 0:49 --qps 20 30 --resume"
    assert argv[4:8] == ["train", "videorf", str(tmp_path), "--out"]
    assert argv[8:] == [str(tmp_path / "a b.reel"), *flags.split()]
    settings.method = "stg"
    assert training(settings, core, "cuda").commands[-1].argv[15:17] == ["--backend", "cuda"]


def test_logs_that_cannot_be_written_are_said(
    core: Path, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setitem(preferences._DEFAULTS, "log_folder", str(tmp_path / "file"))
    settings = bpy.context.scene.holoreel_train
    settings.capture, settings.out = str(capture), str(tmp_path / "wall")
    with pytest.raises(RuntimeError, match=r"cannot be made .*: choose a log folder you may write to"):
        bpy.ops.holoreel.train()
    assert jobs.PENDING not in bpy.context.scene


def test_an_environment_without_holoreel_or_of_another_version_is_said(tmp_path: Path) -> None:
    """Blender's own Python has no Holoreel installed."""
    check = environment.version_check(Path(sys.executable))
    job = jobs.start(JobRecord("train", "Try", [check], ""), Path(sys.executable))
    assert settle(job) == State.FAILED
    assert "has no Holoreel: install it there, or choose another" in job.message
    with pytest.raises(HoloreelError, match=r"is no core environment: .* has no Holoreel"):
        environment.check(Path(sys.executable))
    pretend = "import importlib.metadata\nimportlib.metadata.version = lambda name: '0.0.9'\n"
    job = jobs.start(
        JobRecord("train", "Try", [Command("", [*check.argv[:-1], pretend + check.argv[-1]])], ""), Path(sys.executable)
    )
    assert settle(job) == State.FAILED
    assert job.message == (
        f"the core environment has Holoreel 0.0.9, the add-on is {environment.addon_version()}: install the same "
        "version there."
    )


def script(path: Path, text: str) -> Path:
    """Write a program."""
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("sleep 60", "has not answered in 0.5 seconds"),
        ("echo hello", "says 'hello': this is no Python"),
        ("exit 7", "it ended with status 7"),
        ("kill -9 $$", "it ended with status -9"),
    ],
)
def test_whatever_is_no_python_is_said(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(HoloreelError, match=sentence):
        environment.check(script(tmp_path / "python", f"exec {text}" if "sleep" in text else text), timeout=0.5)


@pytest.mark.slow
def test_a_full_disk_ends_a_training_with_a_sentence(
    core: Path, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files of this Python may have 4 KiB: the status fits, the reel's data do not."""
    small = script(tmp_path / "python", f'ulimit -f 4\nexec {shlex.quote(str(core))} "$@"')
    monkeypatch.setenv(environment.ENVIRONMENT_VARIABLE, str(small))
    settings = bpy.context.scene.holoreel_train
    settings.capture, settings.out = str(capture), str(tmp_path / "wall")
    settings.options = "--iterations 10 --checkpoint-every 100"
    assert bpy.ops.holoreel.train() == {"FINISHED"}
    (job,) = jobs.known()
    assert settle(job) == State.FAILED
    assert "cannot be written (File too large)" in job.message
    assert imported() == []


@pytest.mark.parametrize("method", ["stg", "videorf"])
def test_panels_show_what_they_ask_for(core: Path, method: str) -> None:
    from holoreel.panels.synth import HOLOREEL_PT_synth
    from holoreel.panels.train import HOLOREEL_PT_train

    settings = bpy.context.scene.holoreel_train
    settings.method, settings.all_frames, bpy.context.scene.holoreel_synth.scene_range = method, False, False
    for panel, kept in ((HOLOREEL_PT_train, settings), (HOLOREEL_PT_synth, bpy.context.scene.holoreel_synth)):
        layout = MagicMock()
        layout.column.return_value = layout
        panel.draw(MagicMock(layout=layout), bpy.context)
        shown = {call.args[1] for call in layout.prop.call_args_list}
        other = {"stg_preset", "videorf_preset"} - {f"{method}_preset"}
        assert shown == set(type(kept).__annotations__) - other


# --- Synthesis ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_capture_is_filmed_from_the_open_file_as_it_is(core: Path, tmp_path: Path) -> None:
    """The file was never saved, and its cube is moved after the start: the copy has it where it was."""
    bpy.ops.mesh.primitive_cube_add()
    bpy.context.scene.cycles.use_denoising = False
    settings = bpy.context.scene.holoreel_synth
    settings.out, settings.cameras, settings.size, settings.samples = str(tmp_path / "film"), 2, (32, 24), 1
    settings.scene_range, settings.last_frame, settings.options = False, 1, "--seed-points 50 --no-denoise"
    assert bpy.ops.holoreel.synthesize() == {"FINISHED"}
    (job,) = jobs.known()
    bpy.context.object.location.x = 1000
    assert bpy.data.filepath == ""
    assert settle(job) == State.DONE, (job.message, job.log.read_text())
    assert job.status.figures == {"views": "2 of 2"}
    assert job.status.previews > 0
    previews.icon(job.name, job.status.previews, preview_path(job.status_file))
    assert tuple(previews._pictures[job.name].image_size) == (32, 24)
    assert (tmp_path / "film" / "transforms.json").is_file()
    seeds = (tmp_path / "film" / "seeds").glob("*.ply")
    from holoreel.core.capture import read_points

    (points,) = [read_points(path) for path in seeds]
    assert 0 < len(points) <= 50
    assert np.abs(points.xyz).max() < 1.01


def test_a_range_without_frames_is_refused(core: Path, tmp_path: Path) -> None:
    settings = bpy.context.scene.holoreel_synth
    settings.out, settings.scene_range, settings.first_frame, settings.last_frame = str(tmp_path), False, 5, 4
    with pytest.raises(RuntimeError, match="frames 5 to 4 are no range"):
        bpy.ops.holoreel.synthesize()
    assert Path(synthesis.this_blender()).exists()


# --- Making an environment ------------------------------------------------------------------------------------------


def wheel(folder: Path, name: str, version: str, files: dict[str, str]) -> Path:
    """Write a wheel that needs nothing."""
    path = folder / f"{name}-{version}-py3-none-any.whl"
    info = f"{name}-{version}.dist-info"
    files = files | {
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = "".join(f"{file},,\n" for file in [*files, f"{info}/RECORD"])
    with zipfile.ZipFile(path, "w") as archive:
        for file, text in {**files, f"{info}/RECORD": record}.items():
            archive.writestr(file, text)
    return path


@pytest.mark.slow
def test_an_environment_is_made_without_the_network(tmp_path: Path) -> None:
    """Real venv, real pip, and wheels that stand in for torch and Holoreel."""
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    wheel(wheels, "torch", "2.9.0", {"torch/__init__.py": "__version__ = '2.9.0'\n"})
    backend = "import sys\ndef get_backend(name): return sys.modules['json']\n"
    ours = {"holoreel/__init__.py": "", "holoreel/core/__init__.py": "", "holoreel/core/render.py": backend}
    package = wheel(wheels, "holoreel", environment.addon_version(), ours)
    options = {"folder": str(tmp_path / "made"), "package": str(package), "wheels": str(wheels)}
    assert bpy.ops.holoreel.create_environment(**options) == {"FINISHED"}
    (job,) = jobs.known()
    assert settle(job) == State.DONE, job.log.read_text()
    said = environment.check(environment.python_in(tmp_path / "made"))
    assert said["Holoreel"] == environment.addon_version()
    assert said["torch"] == "2.9.0"
    assert "pip install" in job.log.read_text()


def test_the_commands_that_make_an_environment_are_told_apart() -> None:
    with open(ROOT / "pyproject.toml", encoding="utf-8") as file:
        assert f'"{environment.TORCH}"' in file.read()
    assert Path(environment.checkout()).samefile(ROOT)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, "Blender may not use it: allow Online Access in Preferences > System"),
        ({"package": "/nowhere"}, "/nowhere: there is nothing here"),
        ({"package": "https://example.org/holoreel.whl", "wheels": "/tmp"}, "Blender may not use it"),
        ({"wheels": "/nowhere"}, "/nowhere is no folder"),
        ({"base": "/nowhere"}, "/nowhere: there is no Python here"),
    ],
)
def test_an_environment_that_cannot_be_made_is_refused(options: dict[str, str], sentence: str) -> None:
    """Nothing goes to the network: Blender has not been allowed to."""
    assert not bpy.app.online_access
    with pytest.raises(RuntimeError, match=sentence):
        bpy.ops.holoreel.create_environment(**options)
    assert jobs.known() == []


def test_an_extension_has_no_source_to_install_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "ROOT", Path("/nowhere"))
    assert environment.checkout() == ""
    with pytest.raises(HoloreelError, match="Package is empty: give Holoreel's source checkout"):
        environment.creation(Path("/made"), Path(sys.executable), "", "", False)


def test_preferences_hold_where_the_addon_is_enabled(core: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import addon_utils

    holoreel.unregister()
    addon_utils.enable("holoreel", default_set=True)
    try:
        stored = bpy.context.preferences.addons["holoreel"].preferences
        assert preferences.device() == "auto"
        stored.device, stored.cache_mb, stored.log_folder = "cpu", 100, "/logs"
        assert (preferences.device(), preferences.cache_mb(), preferences.log_folder()) == ("cpu", 100, Path("/logs"))
        monkeypatch.setenv(environment.ENVIRONMENT_VARIABLE, "/nowhere")
        preferences.choose_environment(str(core.parents[1]))
        assert preferences.core_python() == core
    finally:
        addon_utils.disable("holoreel", default_set=True)
        holoreel.register()


def test_times_are_said_in_words() -> None:
    from holoreel.panels.jobs import time_text

    assert [time_text(seconds) for seconds in (0.4, 59.6, 61, 3600, 7323)] == [
        "0 s", "1 min 0 s", "1 min 1 s", "1 h 0 min", "2 h 2 min",
    ]  # fmt: skip
