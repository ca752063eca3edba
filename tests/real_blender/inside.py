# SPDX-License-Identifier: GPL-3.0-or-later
"""What `test_installed.py` does inside Blender: `blender -b --python inside.py -- REEL PICTURE`."""

import importlib
import sys

import addon_utils
import bpy

MODULE = "bl_ext.user_default.holoreel"


def ours() -> list[str]:
    """Return what Blender knows of us."""
    operators = dir(bpy.ops.holoreel) if "holoreel" in dir(bpy.ops) else []
    return [name for name in dir(bpy.types) if "holoreel" in name.lower()] + list(operators)


def main(reel: str, picture: str) -> None:
    """Use the extension as it was installed and enabled."""
    assert MODULE in bpy.context.preferences.addons, "the extension is not enabled"
    assert "holoreel" not in sys.modules
    for found in list(bpy.data.objects):
        bpy.data.objects.remove(found)

    assert bpy.ops.holoreel.import_reel(filepath=reel, set_scene_timing=True) == {"FINISHED"}
    played = bpy.context.object
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.rotation_euler = (3.141592653589793, 0.0, 0.0)  # along +Z, where the reel is
    scene.collection.objects.link(camera)
    scene.camera = camera
    assert bpy.ops.holoreel.setup_exact_render() == {"FINISHED"}
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = 48, 32
    scene.frame_set(7)
    cloud = played.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    assert cloud.mesh is not None, "the look Splats made no faces"
    del cloud
    scene.render.image_settings.file_format = "PNG"
    scene.render.filepath = picture
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    image = bpy.data.images.load(picture)
    assert max(image.pixels) > 0.05, "the picture is empty"

    for _ in range(2):
        addon_utils.disable(MODULE)
        assert not ours(), ours()
        assert addon_utils.enable(MODULE) is not None
        assert ours()
    importlib.import_module(f"{MODULE}.addon.reels")
    sys.stdout.write("all is well\n")


main(*sys.argv[sys.argv.index("--") + 1 :])
