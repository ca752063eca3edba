# SPDX-License-Identifier: GPL-3.0-or-later
"""Random sequences of what a user does: no exception, no data-block and no process left behind."""

import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import holoreel
import numpy as np
import pytest
from holoreel.addon import compat, reels
from holoreel.core.camera import Camera
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.gaussians.splatv import write_splatv
from holoreel.core.reel import save_gaussians

CORE_PYTHON = Path(holoreel.__file__).parent / ".venv" / "bin" / "python"
FIELD = Path(__file__).parents[1] / "data" / "field"
CAMERA = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0, world_to_camera=np.eye(4))
BLENDERS_OWN = ("Render Result", "Viewer Node")
STEPS = 12
QUICK, ALL = 15, 200

# Deeds that only make sense with a person, a network or a long time before them.
_LEFT_OUT = ("environment", "train", "synth", "job", "log", "cancel", "resume", "preferences", "open")


class Session:
    """One user who does this and that, decided by chance."""

    def __init__(self, seed: int, files: list[Path], folder: Path) -> None:
        self.chance = random.Random(seed)
        self.files = files
        self.folder = folder
        self.saved: Path | None = None
        self.done: list[str] = []
        self.deeds: list[Callable[[], None]] = [
            self.import_one, self.import_one, self.change_mapping, self.change_mapping, self.change_look,
            self.go_to_a_frame, self.duplicate, self.delete, self.undo, self.redo, self.save, self.reload,
            self.render, self.another_operator,
        ]  # fmt: skip
        if seed % 5 == 0 and CORE_PYTHON.is_file():
            self.deeds.append(self.render_exactly)

    def run(self) -> None:
        """Do a number of things, looking at every reel after each."""
        self.import_one()
        bpy.ops.ed.undo_push(message="Begin")
        for _ in range(STEPS):
            deed = self.chance.choice(self.deeds)
            self.done.append(deed.__name__)
            deed()
            if deed not in (self.undo, self.redo, self.reload):
                bpy.ops.ed.undo_push(message=deed.__name__)
            self.look()

    def reels(self) -> list[bpy.types.Object]:
        """Return the reels of the scene, in the order of their names."""
        return [thing for thing in bpy.context.scene.objects if reels.modifier_of(thing) is not None]

    def any_reel(self) -> bpy.types.Object | None:
        """Choose one and make it active."""
        found = self.reels()
        if not found:
            return None
        chosen = self.chance.choice(found)
        for thing in bpy.context.view_layer.objects:
            thing.select_set(thing == chosen)
        bpy.context.view_layer.objects.active = chosen
        return chosen

    def look(self) -> None:
        """Evaluate everything: what is shown is finite."""
        depsgraph = bpy.context.evaluated_depsgraph_get()
        for played in self.reels():
            shown = played.evaluated_get(depsgraph).evaluated_geometry()
            for part in (shown.pointcloud, shown.mesh):
                if part is not None and "position" in part.attributes:
                    data = part.attributes["position"].data
                    values = np.empty(3 * len(data), np.float32)
                    data.foreach_get("vector", values)
                    assert np.isfinite(values).all(), self.done

    def import_one(self) -> None:
        """Import a file."""
        assert bpy.ops.holoreel.import_reel(filepath=str(self.chance.choice(self.files))) == {"FINISHED"}

    def change_mapping(self) -> None:
        """Turn one knob of the timeline."""
        if (played := self.any_reel()) is None:
            return
        name, values = self.chance.choice([
            ("Start Frame", (-20, 1, 3.5, 1000)), ("Speed", (0.0, 0.5, 1.0, -2.0)), ("Offset", (-3.0, 0.25, 1e6)),
            ("First Frame", (0, 2, 50)), ("Last Frame", (0, 5, 50)), ("Repeat", ("Hold", "Loop", "Ping-Pong")),
        ])  # fmt: skip
        compat.set_input(reels.modifier_of(played), name, self.chance.choice(values))

    def change_look(self) -> None:
        """Show a reel in another way."""
        if (played := self.any_reel()) is not None:
            modifier = reels.modifier_of(played)
            looks = modifier.node_group.interface.items_tree["Look"]
            names = ["Points"] if compat.get_input(modifier, "Look") == "Splats" else ["Splats", "Points"]
            if looks is not None and reels_of_gaussians(played):
                compat.set_input(modifier, "Look", self.chance.choice(names))

    def go_to_a_frame(self) -> None:
        """Move the playhead."""
        frame = self.chance.uniform(-5, 20)
        bpy.context.scene.frame_set(int(frame), subframe=frame % 1.0)

    def duplicate(self) -> None:
        """Duplicate a reel, its points as well or not."""
        if self.any_reel() is not None:
            assert bpy.ops.object.duplicate(linked=self.chance.random() < 0.5) == {"FINISHED"}

    def delete(self) -> None:
        """Delete a reel."""
        if self.any_reel() is not None:
            assert bpy.ops.object.delete() == {"FINISHED"}

    def undo(self) -> None:
        """Undo, where there is something to undo."""
        if bpy.ops.ed.undo.poll():
            bpy.ops.ed.undo()

    def redo(self) -> None:
        """Redo, where there is something to redo."""
        if bpy.ops.ed.redo.poll():
            bpy.ops.ed.redo()

    def save(self) -> None:
        """Save the file."""
        self.saved = self.folder / "session.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(self.saved), check_existing=False)

    def reload(self) -> None:
        """Open what was saved last."""
        if self.saved is not None:
            bpy.ops.wm.open_mainfile(filepath=str(self.saved))
            bpy.ops.ed.undo_push(message="Open")

    def render_exactly(self) -> None:
        """Render a tiny picture by our own engine, whose worker stays for the next."""
        if self.reels():
            self.render("HOLOREEL")

    def render(self, engine: str = "CYCLES") -> None:
        """Render a tiny picture."""
        scene = bpy.context.scene
        if scene.camera is None:
            scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
            scene.collection.objects.link(scene.camera)
            scene.camera.rotation_euler = (np.pi, 0.0, 0.0)
        scene.render.engine = engine
        scene.cycles.samples = 1
        scene.render.resolution_x, scene.render.resolution_y = 16, 12
        scene.render.filepath = str(self.folder / "render.png")
        assert bpy.ops.render.render(write_still=True) == {"FINISHED"}

    def another_operator(self) -> None:
        """Run another operator of ours, if it can be."""
        names = [name for name in dir(bpy.ops.holoreel) if not any(word in name for word in _LEFT_OUT)]
        name = self.chance.choice(sorted(set(names) - {"import_reel"}))
        self.any_reel()
        operator = getattr(bpy.ops.holoreel, name)
        self.done[-1] += f" {name}"
        if operator.poll():
            try:
                operator()
            except RuntimeError as refusal:
                if "Traceback" in str(refusal):  # otherwise refused in a sentence
                    raise


def reels_of_gaussians(played: bpy.types.Object) -> bool:
    """Return whether a reel has the look Splats."""
    return played.get(reels.INFO, {}).get("kind") != "videorf"


def children() -> set[int]:
    """Return the processes that this one has started and that still run."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = entry.read_text().rpartition(")")[2].split()[:2]
        except OSError:  # it ended
            continue
        if int(parent) == os.getpid() and state != "Z":
            found.add(int(entry.parent.name))
    return found


def leftovers() -> dict[str, list[str]]:
    """Return the data-blocks that are in the file, but for what every file has."""
    found = {}
    # Blender keeps the libraries of what was linked until the file is opened anew.
    files_own = ("all_ids", "scenes", "screens", "workspaces", "window_managers", "libraries")
    for prop in bpy.data.bl_rna.properties:
        if prop.type == "COLLECTION" and prop.identifier not in files_own:
            names = [block.name for block in getattr(bpy.data, prop.identifier) if block.name not in BLENDERS_OWN]
            if names:
                found[prop.identifier] = names
    return found


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, random_model: Callable[..., SpacetimeGaussians]) -> list[Path]:
    """One small file of each kind."""
    folder = tmp_path_factory.mktemp("files")
    write_ply(folder / "a.ply", random_model(20))
    write_splatv(folder / "b.splatv", random_model(20, seed=1), CAMERA)
    save_gaussians(folder / "c.reel", random_model(30, seed=2), fps=24, frame_start=1, frame_count=10)
    shutil.copytree(FIELD, folder / "field")
    return [folder / "a.ply", folder / "b.splatv", folder / "c.reel", folder / "field" / "ball.reel"]


@pytest.fixture
def registered() -> Iterator[None]:
    """Holoreel's operators, for the time of one test; no process of ours outlives them."""
    before = children()
    holoreel.register()
    yield
    holoreel.unregister()
    assert children() <= before


def run_one(seed: int, files: list[Path], folder: Path) -> None:
    """Run one sequence; delete all at its end, and look at what is left."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    empty = leftovers()
    session = Session(seed, files, folder)
    try:
        session.run()
    except Exception as error:
        raise AssertionError(f"sequence {seed}: {session.done}") from error
    for scene in list(bpy.data.scenes)[1:]:
        bpy.data.scenes.remove(scene)
    if hasattr(bpy.context.scene, "compositing_node_group"):  # a part of the scene, elsewhere a data-block that it uses
        bpy.context.scene.compositing_node_group = None
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    for collection in list(bpy.data.collections):
        bpy.data.collections.remove(collection)
    bpy.data.orphans_purge(do_recursive=True)
    left = {kind: names for kind, names in leftovers().items() if names != empty.get(kind)}
    assert not left, f"sequence {seed}: {session.done}"


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("seed", range(QUICK))
def test_random_sequences(seed: int, files: list[Path], tmp_path: Path) -> None:
    run_one(seed, files, tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("seed", range(QUICK, ALL))
def test_more_random_sequences(seed: int, files: list[Path], tmp_path: Path) -> None:
    run_one(seed, files, tmp_path)
