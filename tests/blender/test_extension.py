# SPDX-License-Identifier: GPL-3.0-or-later
"""Registration, the extension's package, and the package installed into an empty profile."""

import os
import subprocess
import sys
import textwrap
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import holoreel
import pytest
from holoreel.addon import compat, reels
from holoreel.addon.nodes.reel import DISPLAY
from holoreel.core.gaussians.model import SpacetimeGaussians
from holoreel.core.gaussians.ply import write_ply
from holoreel.core.reel import save_gaussians

ROOT = Path(holoreel.__file__).parent
SIZE_LIMIT = 1_000_000  # bytes


@pytest.fixture
def registered() -> Iterator[None]:
    """Holoreel's operators and panels, for the time of one test."""
    holoreel.register()
    yield
    holoreel.unregister()


def ours() -> set[str]:
    """Return everything of ours that Blender knows: types, properties, operators, draw functions, handlers."""
    types = {name for name in dir(bpy.types) if "holoreel" in name.lower()}
    operators = {f"ops.{name}" for name in dir(bpy.ops.holoreel)} if "holoreel" in dir(bpy.ops) else set()
    found = types | operators
    for name in dir(bpy.types):
        kind = getattr(bpy.types, name)
        found |= {f"{name}.{attribute}" for attribute in dir(kind) if attribute.startswith("holoreel")}
        for function in getattr(getattr(kind, "draw", None), "_draw_funcs", ()):
            if "holoreel" in function.__module__:
                found.add(f"draw.{name}.{function.__module__}")
    for name in dir(bpy.app.handlers):
        handlers = getattr(bpy.app.handlers, name)
        if isinstance(handlers, list):
            found |= {f"handler.{name}" for handler in handlers if "holoreel" in handler.__module__}
    return found


def test_registering_twice_leaves_nothing_behind() -> None:
    assert ours() == set()
    for _ in range(2):
        holoreel.register()
        assert {
            "HOLOREEL_OT_import_reel",
            "HOLOREEL_PT_reel",
            "draw.TOPBAR_MT_file_import.holoreel.operators.import_reel",
        } <= (ours())
        holoreel.unregister()
        assert ours() == set()


def classes() -> list[type]:
    """Return all registered classes of ours."""
    return [getattr(bpy.types, name) for name in sorted(ours()) if "." not in name]


def is_well_put(text: str) -> bool:
    """Tooltips begin with a capital and end without a period, as Blender's own do."""
    return bool(text) and text == text.strip() and not text[0].islower() and not text.endswith((".", "!"))


@pytest.mark.usefixtures("registered")
def test_every_class_and_property_explains_itself() -> None:
    mute = []
    for kind in classes():
        if issubclass(kind, bpy.types.Operator) and not is_well_put(kind.bl_description):
            mute.append((kind.__name__, kind.bl_description))
        for prop in kind.bl_rna.properties:
            if prop.identifier not in getattr(kind, "__annotations__", {}) or prop.is_hidden:
                continue
            texts = [prop.description, *(item.description for item in getattr(prop, "enum_items", ()))]
            mute += [(kind.__name__, prop.identifier, text) for text in texts if not is_well_put(text)]
    assert not mute


@pytest.mark.usefixtures("registered")
def test_operators_are_named_alike_and_can_be_searched() -> None:
    operators = [kind for kind in classes() if issubclass(kind, bpy.types.Operator)]
    small = {"a", "an", "as", "by", "from", "in", "of", "on", "the", "to", "with", "and", "for"}
    for kind in operators:
        assert kind.__name__.startswith("HOLOREEL_OT_"), kind
        words = kind.bl_label.removesuffix("...").split()
        assert words, kind
        assert all(word[0].isupper() or word in small or not word[0].isalpha() for word in words), kind.bl_label
        assert "INTERNAL" not in kind.bl_options, kind
    labels = [kind.bl_label for kind in operators]
    assert len(set(labels)) == len(labels), labels


@pytest.mark.usefixtures("registered")
def test_operators_that_cannot_run_say_why(capfd: pytest.CaptureFixture[str]) -> None:
    for name in dir(bpy.ops.holoreel):
        operator = getattr(bpy.ops.holoreel, name)
        if operator.poll():
            continue
        with pytest.raises(RuntimeError) as refusal:
            operator()
        assert "context is incorrect" not in str(refusal.value), f"{name} does not say why: {refusal.value}"
    capfd.readouterr()


@pytest.mark.usefixtures("registered")
def test_inputs_of_node_groups_explain_themselves(
    random_model: Callable[..., SpacetimeGaussians], tmp_path: Path
) -> None:
    write_ply(tmp_path / "a.ply", random_model(10))
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "a.ply"))
    tree = reels.modifier_of(bpy.context.object).node_group
    sockets = [item for item in tree.interface.items_tree if item.item_type == "SOCKET"]
    assert len(sockets) > 10
    assert not [(item.name, item.description) for item in sockets if not is_well_put(item.description)]


@pytest.mark.usefixtures("registered")
def test_import_operator_takes_several_files(random_model: Callable[..., SpacetimeGaussians], tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", random_model(10))
    save_gaussians(tmp_path / "b.reel", random_model(20), fps=24, frame_start=1, frame_count=10)
    result = bpy.ops.holoreel.import_reel(
        directory=str(tmp_path), files=[{"name": "a.ply"}, {"name": "b.reel"}], up="-Y", set_scene_timing=True
    )
    assert result == {"FINISHED"}
    assert {o.name: len(o.data.points) for o in bpy.data.objects} == {"a": 10, "b": 20}
    assert bpy.context.object.name == "b"
    assert bpy.context.object.select_get()
    assert bpy.context.scene.frame_end == 10


@pytest.mark.usefixtures("registered")
def test_import_operator_refuses_in_one_sentence(
    random_model: Callable[..., SpacetimeGaussians], tmp_path: Path
) -> None:
    write_ply(tmp_path / "good.ply", random_model(10))
    whole = (tmp_path / "good.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(RuntimeError, match=r"cut\.ply"):
        bpy.ops.holoreel.import_reel(directory=str(tmp_path), files=[{"name": "good.ply"}, {"name": "cut.ply"}])
    assert not bpy.data.objects


@pytest.mark.usefixtures("registered")
def test_exact_render_operator_sets_reels_and_scene(
    random_model: Callable[..., SpacetimeGaussians], tmp_path: Path
) -> None:
    write_ply(tmp_path / "a.ply", random_model(10))
    bpy.ops.holoreel.import_reel(filepath=str(tmp_path / "a.ply"))
    assert bpy.ops.holoreel.setup_exact_render() == {"FINISHED"}
    assert compat.get_input(reels.modifier_of(bpy.context.object), "Color") == DISPLAY
    assert bpy.context.scene.view_settings.view_transform == "Raw"


def extension_tool(*arguments: str) -> None:
    """Run Blender's own validator and builder, without Blender."""
    system = Path(bpy.utils.system_resource("SCRIPTS"), "addons_core", "bl_pkg", "cli", "blender_ext.py")
    done = subprocess.run([sys.executable, system, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The extension's zip."""
    folder = tmp_path_factory.mktemp("package")
    extension_tool("validate", str(ROOT))
    extension_tool("build", "--source-dir", str(ROOT), "--output-dir", str(folder))
    (found,) = folder.glob("*.zip")
    return found


def test_package_is_valid_small_and_free_of_what_blender_lacks(package: Path) -> None:
    extension_tool("validate", str(package))
    assert package.stat().st_size < SIZE_LIMIT
    with zipfile.ZipFile(package) as archive:
        names = archive.namelist()
        imports = {name: archive.read(name).decode() for name in names if name.endswith(".py")}
    assert {"__init__.py", "blender_manifest.toml", "LICENSE", "addon/reels.py", "core/reel.py"} <= set(names)
    assert not [name for name in names if name.startswith(("tests/", "docs/", "sample_scenes/", ".", "core/render/"))]
    assert not [name for name, text in imports.items() if "\nimport torch" in text or "\nfrom torch" in text]


USE = """
    import importlib, pkgutil, sys
    import bpy
    package, reel = sys.argv[1:]
    installed = bpy.ops.extensions.package_install_files(
        filepath=package, repo="user_default", enable_on_install=True, overwrite=True
    )
    assert installed == {"FINISHED"}, installed
    module = importlib.import_module("bl_ext.user_default.holoreel")
    assert "holoreel" not in sys.modules
    for info in pkgutil.walk_packages(module.__path__, module.__name__ + "."):
        if not info.name.endswith("__main__"):
            importlib.import_module(info.name)
    assert "torch" not in sys.modules and "imageio" not in sys.modules
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    bpy.ops.preferences.addon_enable(module="bl_ext.user_default.holoreel")
    assert bpy.ops.holoreel.import_reel(filepath=reel) == {"FINISHED"}
    assert bpy.context.object.type == "POINTCLOUD"
    assert bpy.ops.holoreel.setup_exact_render() == {"FINISHED"}
    bpy.ops.preferences.addon_disable(module="bl_ext.user_default.holoreel")
    assert not [name for name in dir(bpy.types) if "HOLOREEL" in name]
    print("all is well")
"""


def test_package_works_in_an_empty_profile(
    package: Path, random_model: Callable[..., SpacetimeGaussians], tmp_path: Path
) -> None:
    reel = tmp_path / "a.reel"
    save_gaussians(reel, random_model(30), fps=24, frame_start=1, frame_count=10)
    profile = tmp_path / "profile"
    profile.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(USE), str(package), str(reel)],
        env={**os.environ, "BLENDER_USER_RESOURCES": str(profile)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "all is well" in done.stdout, done.stdout + done.stderr
