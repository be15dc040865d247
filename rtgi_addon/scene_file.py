# SPDX-License-Identifier: GPL-3.0-or-later
"""Opening a .blend, and what must be right about it before anything is computed.

Answers come as problem lines for people; the first stage of ``bake``. Nothing of the scene is changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy

from .backend.errors import BakeError
from .extract.nodes import reachable, uses_nodes

#: Modifiers whose result depends on the frame though nothing has an animation curve.
TIME_MODIFIERS = {
    "BUILD", "CLOTH", "COLLISION", "DYNAMIC_PAINT", "EXPLODE", "FLUID", "MESH_CACHE", "MESH_SEQUENCE_CACHE", "OCEAN",
    "PARTICLE_SYSTEM", "SOFT_BODY", "WAVE",
}  # fmt: skip
MATERIAL_OUTPUT, WORLD_OUTPUT = "ShaderNodeOutputMaterial", "ShaderNodeOutputWorld"
#: Nodes that read the frame number, or carry state from frame to frame.
TIME_NODES = {"GeometryNodeInputSceneTime", "GeometryNodeSimulationOutput"}


def open_blend(path: Path | None) -> None:
    """Make the file at ``path`` the open one; None keeps what is open."""
    if path is None:
        return
    if bpy.data.filepath and Path(bpy.data.filepath).absolute() == path:
        return
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise BakeError(f"{path}: {what}; name an existing .blend file")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    except RuntimeError as fault:
        reason = str(fault).strip().removeprefix("Error: ").splitlines()[0]
        raise BakeError(f"{path}: not a .blend that Blender {bpy.app.version_string} can open ({reason})") from fault


def named_or_open(path: Path | None) -> Path:
    """``path``, or that of the open file. Blender runs a command though the FILE before it does not exist."""
    if path is None and not bpy.data.filepath:
        raise BakeError("no scene: no .blend is open, or the one named does not exist; name an existing .blend file")
    return Path(bpy.data.filepath).absolute() if path is None else path


def default_folder(suffix: str) -> Path:
    """``SCENE_suffix`` beside the open .blend."""
    if not bpy.data.filepath:
        raise BakeError("the scene has not been saved, so its folder is unknown; save it or give --out DIR")
    path = Path(bpy.data.filepath)
    return path.with_name(f"{path.stem}_{suffix}")


def default_frames(scene: bpy.types.Scene) -> Sequence[int]:
    """The scene's own frame range, or its current frame where nothing can change over time."""
    if not is_animated():
        return range(scene.frame_current, scene.frame_current + 1)
    return range(scene.frame_start, scene.frame_end + 1, scene.frame_step)


def is_animated() -> bool:
    """Can anything in the file differ between frames? A yes may be wrong, a no never is."""
    if any(_has_curves(block) for block in bpy.data.user_map()):
        return True
    if bpy.app.handlers.frame_change_pre or bpy.app.handlers.frame_change_post:
        return True
    if any(scene.rigidbody_world for scene in bpy.data.scenes):
        return True
    if any(modifier.type in TIME_MODIFIERS for obj in bpy.data.objects for modifier in obj.modifiers):
        return True
    if any(image.source in {"SEQUENCE", "MOVIE"} for image in bpy.data.images):
        return True
    return any(node.bl_idname in TIME_NODES for tree in bpy.data.node_groups for node in tree.nodes)


def _has_curves(block: bpy.types.ID) -> bool:
    animation = getattr(block, "animation_data", None)
    if animation is None:
        return False
    return animation.action is not None or len(animation.drivers) > 0 or len(animation.nla_tracks) > 0


def scene_problems() -> list[str]:
    """Files that the open scene needs and that are not there."""
    return [*_missing_libraries(), *_missing_images(bpy.context.scene)]


def scene_warnings() -> list[str]:
    """What about the open file makes a bake differ from what its author sees."""
    if not bpy.app.autoexec_fail:
        return []
    remedy = "if you trust the file, bake with blender --enable-autoexec -b FILE --command rtgi bake"
    return [f"the file's Python ({bpy.app.autoexec_fail_message}) was not run; {remedy}"]


def _missing_libraries() -> Iterator[str]:
    for library in bpy.data.libraries:
        path = Path(bpy.path.abspath(library.filepath))
        if not library.packed_file and not path.is_file():
            yield f"library {library.name}: {path} does not exist; restore the file or relocate the library in Blender"


def _missing_images(scene: bpy.types.Scene) -> Iterator[str]:
    remedy = "restore the file, or choose another image, or remove the node"
    for image, user in _images_in_use(scene).items():
        if len(image.packed_files):
            continue
        for path in _files_of(image):
            if not path.is_file():
                named = path if image.filepath else "its file (it names none)"
                yield f"image {image.name} of {user}: {named} does not exist; {remedy}"


def _files_of(image: bpy.types.Image) -> Iterator[Path]:
    """The files that Blender reads ``image`` from; of a sequence, the one that it names."""
    path = bpy.path.abspath(image.filepath, library=image.library)
    if image.source == "TILED":
        for tile in image.tiles:
            u, v = (tile.number - 1001) % 10 + 1, (tile.number - 1001) // 10 + 1
            yield Path(path.replace("<UDIM>", str(tile.number)).replace("<UVTILE>", f"u{u}_v{v}"))
    elif image.source in {"FILE", "SEQUENCE", "MOVIE"}:
        yield Path(path)


def _images_in_use(scene: bpy.types.Scene) -> dict[bpy.types.Image, str]:
    """Each image that what the scene shows reads, with who uses it."""
    users: dict[bpy.types.Image, str] = {}
    materials = [slot.material for obj in scene.objects for slot in obj.material_slots if slot.material is not None]
    trees = [(f"material {m.name}", m, MATERIAL_OUTPUT) for m in materials]
    if scene.world is not None:
        trees.append((f"world {scene.world.name}", scene.world, WORLD_OUTPUT))
    for user, block, output in dict.fromkeys(trees):
        for node in reachable(block.node_tree, output) if uses_nodes(block) else ():
            if isinstance(getattr(node, "image", None), bpy.types.Image) and not node.mute:
                users.setdefault(node.image, user)
    return users
