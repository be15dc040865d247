# SPDX-License-Identifier: GPL-3.0-or-later
"""Eevee with no light but that of lamps and of the light maps, so that nothing is counted twice.

The maps hold bounced, sky and emissive light. For pictures, and for the copy that is saved; put back afterwards. In a
saved copy it stays, so the world's stand-in says whose place it takes, for :func:`restore_world`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import bpy

from .lightmap_sampling import MARK

#: Custom property of a marked world: the world that it stands for.
_ORIGINAL = MARK + "_original"


@contextmanager
def direct_light_only(scene: bpy.types.Scene) -> Iterator[None]:
    """No light in Eevee but that of lamps and of the maps; the sky still shows behind."""
    probes = [o for o in scene.objects if o.type == "LIGHT_PROBE" and o.data.type == "VOLUME"]
    with ExitStack() as stack:
        # The threshold cuts far lamps off; no screen-space or fast global illumination.
        stack.enter_context(kept(scene.eevee, use_raytracing=False, light_threshold=1e-4))
        for probe in probes:  # baked irradiance
            stack.enter_context(kept(probe, hide_render=True))
        if scene.world is not None:
            stack.enter_context(_backdrop_only(scene))
        yield


@contextmanager
def _backdrop_only(scene: bpy.types.Scene) -> Iterator[None]:
    """A copy of the scene's world that the camera sees and that lights nothing."""
    original = scene.world
    copy = original.copy()
    copy[MARK], copy[_ORIGINAL] = True, original
    try:
        if not (copy.node_tree is not None and (bpy.app.version >= (5, 0) or copy.use_nodes)):
            _make_plain_nodes(copy)
        tree = copy.node_tree
        for output in [n for n in tree.nodes if n.bl_idname == "ShaderNodeOutputWorld"]:
            for link in list(output.inputs["Surface"].links):
                mix, path = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeLightPath")
                tree.links.new(path.outputs["Is Camera Ray"], mix.inputs["Fac"])
                tree.links.new(link.from_socket, mix.inputs[2])  # the first stays black
                tree.links.new(mix.outputs[0], output.inputs["Surface"])
        scene.world = copy
        yield
    finally:
        scene.world = original
        bpy.data.worlds.remove(copy)


def _make_plain_nodes(world: bpy.types.World) -> None:
    """Nodes for a world that has none and shows its colour."""
    if bpy.app.version < (5, 0):
        world.use_nodes = True
    nodes = world.node_tree.nodes
    nodes.clear()
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value = (*world.color, 1.0)
    world.node_tree.links.new(background.outputs[0], output.inputs["Surface"])


@contextmanager
def kept(block: bpy.types.bpy_struct, **values: object) -> Iterator[None]:
    """``values`` on ``block`` for a while."""
    before = {name: getattr(block, name) for name in values}
    try:
        for name, value in values.items():
            setattr(block, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(block, name, value)


def restore_world(scene: bpy.types.Scene) -> None:
    """Give ``scene``, opened from a saved copy, its own world back."""
    if scene.world is None or not scene.world.get(MARK):
        return
    backdrop = scene.world
    scene.world = backdrop.get(_ORIGINAL)
    bpy.data.worlds.remove(backdrop)
