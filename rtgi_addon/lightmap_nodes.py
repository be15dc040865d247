# SPDX-License-Identifier: GPL-3.0-or-later
"""The shared node group "RTGI Light" and how it gets into a node tree and out of it again.

The group samples the light maps where the shaded point lies in the atlas and emits albedo × E / π (E in W/m²), the
radiance a diffuse surface sends back. Each diffuse closure of a material gets one group node, added right behind it,
so that the material's own mixing weighs the light as it weighs the closure. All nodes of ours carry the custom
property ``rtgi``: removal needs no other record and works on a file saved long ago.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import bpy

from .lightmap_sampling import MARK, MapFiles, fill_group

GROUP_NAME = "RTGI Light"
FRAMES = "rtgi_frames"  # on the group: first and last frame of its maps

#: Diffuse closures: which of the closure's inputs feed which of the group's.
_GROUP_INPUTS_OF_CLOSURE = {
    "ShaderNodeBsdfPrincipled": {
        "Base Color": "Albedo",
        "Metallic": "Metallic",
        "Transmission Weight": "Transmission",
        "Alpha": "Alpha",
    },
    "ShaderNodeBsdfDiffuse": {"Color": "Albedo"},
    "ShaderNodeBsdfToon": {"Color": "Albedo"},
    "ShaderNodeSubsurfaceScattering": {"Color": "Albedo"},
    "ShaderNodeEeveeSpecular": {"Base Color": "Albedo", "Transparency": "Transmission"},
}
#: Closures that scatter widely but have no albedo socket to read.
_UNREAD_CLOSURES = ("ShaderNodeBsdfTranslucent", "ShaderNodeBsdfSheen", "ShaderNodeBsdfHairPrincipled")


def make_group(maps: MapFiles) -> bpy.types.ShaderNodeTree:
    """The node group over ``maps``, in place of an older one of ours."""
    remove_group()
    tree = bpy.data.node_groups.new(GROUP_NAME, "ShaderNodeTree")
    tree[MARK] = True
    tree[FRAMES] = (maps.frames[0], maps.frames[-1])
    tree.interface.new_socket("Light", in_out="OUTPUT", socket_type="NodeSocketShader")
    tree.interface.new_socket("Albedo", in_out="INPUT", socket_type="NodeSocketColor")
    for name, default in (("Metallic", 0.0), ("Transmission", 0.0), ("Alpha", 1.0)):
        socket = tree.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
        socket.default_value, socket.min_value, socket.max_value = default, 0.0, 1.0
    fill_group(tree, maps)
    return tree


def remove_group() -> None:
    """Remove the group and the images that only it shows."""
    for tree in [t for t in bpy.data.node_groups if t.get(MARK) and t.bl_idname == "ShaderNodeTree"]:
        bpy.data.node_groups.remove(tree)
    for image in [i for i in bpy.data.images if i.get(MARK)]:
        bpy.data.images.remove(image)


def light_tree(tree: bpy.types.NodeTree, group: bpy.types.ShaderNodeTree) -> list[str]:
    """Add ``group`` behind each diffuse closure of ``tree``; the names of closures that had to be left dark.

    A tree that is lit already stays as it is.
    """
    if any(node.get(MARK) for node in tree.nodes):
        return []
    active, dark = tree.nodes.active, []
    for closure in list(tree.nodes):
        if closure.mute or not _targets(closure):
            continue
        if closure.bl_idname in _GROUP_INPUTS_OF_CLOSURE:
            _light_closure(tree, closure, group)
        elif closure.bl_idname in _UNREAD_CLOSURES:
            dark.append(closure.bl_label)
    tree.nodes.active = active
    return dark


def unlight_tree(tree: bpy.types.NodeTree) -> None:
    """Take out what :func:`light_tree` added; every link goes back to where it was."""
    for add in [n for n in tree.nodes if n.get(MARK) and n.bl_idname == "ShaderNodeAddShader"]:
        closure = next((link.from_socket for link in add.inputs[0].links), None)
        if closure is not None:  # the user may have deleted it since
            for socket in _targets(add):
                tree.links.new(closure, socket)
    for node in [n for n in tree.nodes if n.get(MARK)]:
        for socket in node.inputs:
            if hasattr(socket, "default_value"):
                socket.driver_remove("default_value")
        tree.nodes.remove(node)


def nested_trees(tree: bpy.types.NodeTree) -> Iterator[bpy.types.ShaderNodeGroup]:
    """The group nodes of ``tree`` itself whose groups hold shaders."""
    for node in tree.nodes:
        if node.bl_idname == "ShaderNodeGroup" and node.node_tree and not node.node_tree.get(MARK) and not node.mute:
            if any(socket.type == "SHADER" for socket in node.outputs):
                yield node


def _targets(node: bpy.types.Node) -> list[bpy.types.NodeSocket]:
    links = node.outputs[0].links if node.outputs else ()
    return [link.to_socket for link in links if not link.is_muted]


def _light_closure(tree: bpy.types.NodeTree, closure: bpy.types.Node, group: bpy.types.ShaderNodeTree) -> None:
    targets = _targets(closure)
    add, lit = tree.nodes.new("ShaderNodeAddShader"), tree.nodes.new("ShaderNodeGroup")
    lit.node_tree = group
    for node, shift in ((lit, (0.0, 180.0)), (add, (190.0, 90.0))):
        node[MARK] = True
        node.select = False
        node.label = GROUP_NAME
        node.parent = closure.parent
        node.location = (closure.location.x + closure.width + 40 + shift[0], closure.location.y + shift[1])
    for source, target in _GROUP_INPUTS_OF_CLOSURE[closure.bl_idname].items():
        _follow(tree, group[FRAMES], closure.inputs[source], lit.inputs[target])
    tree.links.new(closure.outputs[0], add.inputs[0])
    tree.links.new(lit.outputs[0], add.inputs[1])
    for socket in targets:
        tree.links.new(add.outputs[0], socket)


def _follow(
    tree: bpy.types.NodeTree, frames: Sequence[int], source: bpy.types.NodeSocket, target: bpy.types.NodeSocket
) -> None:
    """Make input ``target`` always have the value of input ``source``: its link, its constant or its animation."""
    link = next((link for link in source.links if not link.is_muted), None)
    if link is not None:
        tree.links.new(link.from_socket, target)
        return
    target.default_value = source.default_value
    path, animation = source.path_from_id("default_value"), tree.animation_data
    if animation is None:
        return
    for curve in [c for c in animation.drivers if c.data_path == path]:
        copy = animation.drivers.from_existing(src_driver=curve)
        copy.data_path = target.path_from_id("default_value")
    for curve in [c for c in animation_curves(animation) if c.data_path == path]:
        _copy_curve(curve, target, frames)


def _copy_curve(curve: bpy.types.FCurve, target: bpy.types.NodeSocket, frames: Sequence[int]) -> None:
    """Give ``target`` the values of ``curve`` over its keys and over ``frames`` (first, last).

    As a driver, a curve over "frame", so that the user's action stays as it is. A driver that read the other socket
    would make Blender see a loop, both being of one tree.
    """
    is_vector = hasattr(target.default_value, "__len__")
    copy = target.driver_add("default_value", curve.array_index) if is_vector else target.driver_add("default_value")
    copy.driver.type, copy.driver.expression = "SCRIPTED", "frame"  # too simple to need script rights
    for modifier in list(copy.modifiers):
        copy.modifiers.remove(modifier)
    copy.keyframe_points.clear()
    first, last = curve.range()
    for frame in range(min(frames[0], math.floor(first)), max(frames[1], math.ceil(last)) + 1):
        copy.keyframe_points.insert(frame, curve.evaluate(frame)).interpolation = "LINEAR"
    copy.extrapolation = "CONSTANT"


def animation_curves(animation: bpy.types.AnimData) -> list[bpy.types.FCurve]:
    """The F-curves of the action in use, whether it has slots (4.4 and later) or not."""
    action = animation.action
    if action is None:
        return []
    if not hasattr(action, "layers"):
        return list(action.fcurves)
    slot = animation.action_slot
    bags = [strip.channelbag(slot) for layer in action.layers for strip in layer.strips] if slot else []
    return [curve for bag in bags if bag is not None for curve in bag.fcurves]
