# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading node trees: which nodes count, what is constant, where an input really comes from.

Follows Cycles: its output node, muted nodes, reroutes and groups. Nothing is evaluated here but unlinked sockets.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy

#: Nodes whose outputs depend on their inputs alone: a tree of these has one value everywhere.
PLAIN_NODES = {
    "NodeGroupInput", "NodeGroupOutput", "NodeReroute", "NodeFrame", "ShaderNodeGroup",
    "ShaderNodeAddShader", "ShaderNodeMixShader", "ShaderNodeBackground", "ShaderNodeEmission",
    "ShaderNodeBsdfDiffuse", "ShaderNodeBsdfPrincipled", "ShaderNodeBsdfGlossy", "ShaderNodeBsdfAnisotropic",
    "ShaderNodeBsdfGlass", "ShaderNodeBsdfRefraction", "ShaderNodeBsdfTransparent", "ShaderNodeBsdfTranslucent",
    "ShaderNodeBsdfSheen", "ShaderNodeBsdfVelvet", "ShaderNodeBsdfMetallic", "ShaderNodeBsdfToon",
    "ShaderNodeBsdfHair", "ShaderNodeBsdfRayPortal", "ShaderNodeSubsurfaceScattering", "ShaderNodeHoldout",
    "ShaderNodeOutputMaterial", "ShaderNodeOutputWorld", "ShaderNodeOutputLight",
    "ShaderNodeRGB", "ShaderNodeValue", "ShaderNodeMath", "ShaderNodeVectorMath", "ShaderNodeMix",
    "ShaderNodeMixRGB", "ShaderNodeValToRGB", "ShaderNodeBlackbody", "ShaderNodeWavelength",
    "ShaderNodeCombineColor", "ShaderNodeSeparateColor", "ShaderNodeCombineXYZ", "ShaderNodeSeparateXYZ",
    "ShaderNodeGamma", "ShaderNodeHueSaturation", "ShaderNodeInvert", "ShaderNodeBrightContrast",
    "ShaderNodeRGBCurve", "ShaderNodeFloatCurve", "ShaderNodeVectorCurve", "ShaderNodeMapRange", "ShaderNodeClamp",
    "ShaderNodeRGBToBW", "ShaderNodeFresnel", "ShaderNodeLayerWeight", "ShaderNodeLightPath", "ShaderNodeBump",
    "ShaderNodeNormalMap",
}  # fmt: skip


def uses_nodes(block: bpy.types.ID) -> bool:
    """Does a material's, world's or lamp's node tree count? Always since Blender 5.0, for lamps since 5.2."""
    always = (5, 2, 0) if isinstance(block, bpy.types.Light) else (5, 0, 0)
    return block.node_tree is not None and (bpy.app.version >= always or block.use_nodes)


def output_link(tree: bpy.types.NodeTree, kind: str, socket: str) -> bpy.types.Node | None:
    """The node linked to ``socket`` of the output that Cycles uses."""
    output = active_output(tree, kind)
    return source_node(output.inputs[socket]) if output is not None else None


def active_output(tree: bpy.types.NodeTree, kind: str) -> bpy.types.Node | None:
    """Cycles' own active output before one for all engines; an Eevee output never."""
    outputs = [n for n in tree.nodes if n.bl_idname == kind and not n.mute]
    for target in ("CYCLES", "ALL"):
        fitting = [n for n in outputs if getattr(n, "target", "ALL") == target]
        for node in fitting:
            if getattr(node, "is_active_output", True):
                return node
        if fitting:
            return fitting[0]
    return None


def source_node(socket: bpy.types.NodeSocket) -> bpy.types.Node | None:
    """The node that feeds ``socket``, past reroutes; None where nothing does."""
    while socket.is_linked and socket.links[0].is_valid and not socket.links[0].is_muted:
        node = socket.links[0].from_node
        if node.bl_idname != "NodeReroute":
            return node
        socket = node.inputs[0]
    return None


def constant_input(node: bpy.types.Node, key: str) -> tuple[float, ...] | None:
    """The value of input ``key`` where nothing is linked (or a plain Value or RGB node is); None where it varies."""
    socket = node.inputs[key]
    feeder = source_node(socket)
    if feeder is not None:
        if feeder.mute or feeder.bl_idname not in {"ShaderNodeValue", "ShaderNodeRGB"}:
            return None
        socket = feeder.outputs[0]
    value = socket.default_value
    return (float(value),) if isinstance(value, float | int) else tuple(float(v) for v in value)


def reachable(tree: bpy.types.NodeTree, kind: str) -> Iterator[bpy.types.Node]:
    """Every node that can reach the surface output, also inside groups; each once."""
    output = active_output(tree, kind)
    waiting = [] if output is None else [output.inputs["Surface"]]
    seen: set[int] = set()
    while waiting:
        socket = waiting.pop()
        for link in socket.links:
            node = link.from_node
            if node.as_pointer() in seen or link.is_muted:
                continue
            seen.add(node.as_pointer())
            yield node
            waiting.extend(node.inputs)
            inner = getattr(node, "node_tree", None)
            if inner is not None and inner.as_pointer() not in seen:
                seen.add(inner.as_pointer())
                for end in inner.nodes:
                    if end.bl_idname == "NodeGroupOutput":
                        waiting.extend(end.inputs)


def missing_images(tree: bpy.types.NodeTree, kind: str) -> list[str]:
    """Paths of image files that reachable nodes need and that are not there."""
    paths = []
    for node in reachable(tree, kind):
        image = getattr(node, "image", None)
        if isinstance(image, bpy.types.Image) and image.source == "FILE" and image.packed_file is None:
            path = Path(bpy.path.abspath(image.filepath, library=image.library))
            if not path.is_file():
                paths.append(image.filepath or image.name)
    return paths


def is_time_dependent(block: bpy.types.ID | None) -> bool:
    """Can what ``block``'s node tree (and its groups) says differ between frames?"""
    if block is None:
        return False
    trees = [block.node_tree] if getattr(block, "node_tree", None) is not None else []
    if _has_animation(block):
        return True
    seen: set[int] = set()
    while trees:
        tree = trees.pop()
        if tree.as_pointer() in seen:
            continue
        seen.add(tree.as_pointer())
        if _has_animation(tree):
            return True
        for node in tree.nodes:
            image = getattr(node, "image", None)
            if isinstance(image, bpy.types.Image) and (image.source in {"SEQUENCE", "MOVIE"} or _has_animation(image)):
                return True
            if getattr(node, "node_tree", None) is not None:
                trees.append(node.node_tree)
    return False


def _has_animation(block: bpy.types.ID) -> bool:
    data = getattr(block, "animation_data", None)
    return data is not None and (data.action is not None or len(data.drivers) > 0 or len(data.nla_tracks) > 0)
