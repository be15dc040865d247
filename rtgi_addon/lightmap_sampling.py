# SPDX-License-Identifier: GPL-3.0-or-later
"""What is inside the node group "RTGI Light": from the shaded point to the light that its diffuse part sends back.

Object properties place the point in the atlas, image textures give its irradiance E (W/m²), and albedo × E / π is
emitted. Only ``lightmap_nodes`` puts the group to use.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import bpy

from .output import map_name

UV_LAYER = "RTGI"
MARK = "rtgi"  # custom property of all that is ours in a file

#: Object properties the group reads, (front, back); each is three floats: ``*_scale`` holds scale u, scale v and
#: page + 1 (0: no map on this side, which is also what an object without the property gives), ``*_offset`` u, v, 0.
SCALE_PROPERTIES = ("rtgi_front_scale", "rtgi_back_scale")
OFFSET_PROPERTIES = ("rtgi_front_offset", "rtgi_back_offset")

_RESOLUTION = "rtgi_resolution"  # on the group of a map: pixels along a side
_LAST_FRAME = 1_048_574  # Blender's MAXFRAME


@dataclass(frozen=True)
class MapFiles:
    """The light maps of a bake on disk: ``folder/<kind>.p<page>.<frame>.exr``."""

    folder: Path
    kinds: tuple[str, ...]  # "iim", "caustics"
    page_count: int
    frames: tuple[int, ...]  # ascending, evenly spaced

    def path(self, kind: str, page: int, frame: int) -> Path:
        return self.folder / map_name(kind, page, frame)


def fill_group(tree: bpy.types.ShaderNodeTree, maps: MapFiles) -> None:
    """Build the nodes of ``tree``, whose sockets are there already."""
    wiring = _Wiring(tree)
    uv, page = _place_in_atlas(wiring)
    _emit(wiring, _sample_pages(wiring, maps, uv, page))


class _Wiring:
    """Nodes added to one tree, left to right, by what they compute; inputs are sockets or constants."""

    def __init__(self, tree: bpy.types.ShaderNodeTree) -> None:
        self.tree = tree
        self._column = 0

    def node(self, kind: str, *inputs: object, **attributes: object) -> bpy.types.Node:
        node = self.tree.nodes.new(kind)
        node.location = (180.0 * (self._column // 4), -170.0 * (self._column % 4))
        self._column += 1
        for name, value in attributes.items():
            setattr(node, name, value)
        for socket, value in zip(node.inputs, inputs, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            elif value is not None:
                socket.default_value = value
        return node

    def math(self, operation: str, *inputs: object, clamp: bool = False) -> bpy.types.NodeSocket:
        return self.node("ShaderNodeMath", *inputs, operation=operation, use_clamp=clamp).outputs[0]

    def vector(self, operation: str, *inputs: object) -> bpy.types.NodeSocket:
        return self.node("ShaderNodeVectorMath", *inputs, operation=operation).outputs[0]

    def scaled(self, vector: bpy.types.NodeSocket, factor: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        node = self.node("ShaderNodeVectorMath", vector, operation="SCALE")
        self.tree.links.new(factor, node.inputs["Scale"])
        return node.outputs[0]


def _place_in_atlas(wiring: _Wiring) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """Page UV and page + 1 of the shaded point, on the side that faces the viewer.

    Blender's "backfacing" follows the object's own front, mirrored or not, as ``Atlas`` does.
    """
    back = wiring.node("ShaderNodeNewGeometry").outputs["Backfacing"]
    sides = []
    for names in (SCALE_PROPERTIES, OFFSET_PROPERTIES):
        front, behind = (
            wiring.node("ShaderNodeAttribute", attribute_type="OBJECT", attribute_name=name).outputs["Vector"]
            for name in names
        )
        difference = wiring.vector("SUBTRACT", behind, front)
        sides.append(wiring.vector("ADD", front, wiring.scaled(difference, back)))
    scale, offset = sides
    uv = wiring.node("ShaderNodeUVMap", uv_map=UV_LAYER).outputs["UV"]
    page = wiring.node("ShaderNodeSeparateXYZ", scale).outputs["Z"]
    return wiring.vector("MULTIPLY_ADD", uv, scale, offset), page


def _sample_pages(
    wiring: _Wiring, maps: MapFiles, uv: bpy.types.NodeSocket, page: bpy.types.NodeSocket
) -> bpy.types.NodeSocket:
    """Sum over kinds of the irradiance on the point's own page; black without a page.

    Bilinear by hand, from single texels: Blender's own filter reads coarser levels of the texture, where the texels
    of other islands and surfaces are mixed in.
    """
    groups = [[_map_group(maps, kind, index) for kind in maps.kinds] for index in range(maps.page_count)]
    taps = _bilinear_taps(wiring, uv, groups[0][0][_RESOLUTION])
    total = None
    for index, kinds in enumerate(groups):
        mask = wiring.math("COMPARE", page, index + 1.0, 0.5)
        for position, weight in taps:
            colors = []
            for group in kinds:
                node = wiring.node("ShaderNodeGroup", node_tree=group)
                wiring.tree.links.new(position, node.inputs[0])
                colors.append(node.outputs[0])
            light = colors[0] if len(colors) == 1 else wiring.vector("ADD", *colors)
            part = wiring.scaled(light, wiring.math("MULTIPLY", weight, mask))
            total = part if total is None else wiring.vector("ADD", total, part)
    return total


def _bilinear_taps(
    wiring: _Wiring, uv: bpy.types.NodeSocket, resolution: int
) -> list[tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]]:
    """The centres (page UV) of the four texels around ``uv``, and their weights."""
    scale, half = (float(resolution),) * 3, (-0.5,) * 3
    texel = wiring.vector("MULTIPLY_ADD", uv, scale, half)
    corner = wiring.vector("FLOOR", texel)
    part = wiring.node("ShaderNodeSeparateXYZ", wiring.vector("SUBTRACT", texel, corner)).outputs
    weights = [(wiring.math("SUBTRACT", 1.0, part[axis]), part[axis]) for axis in ("X", "Y")]
    taps = []
    for row in (0, 1):
        for column in (0, 1):
            centre = ((column + 0.5) / resolution, (row + 0.5) / resolution, 0.0)
            position = wiring.vector("MULTIPLY_ADD", corner, (1.0 / resolution,) * 3, centre)
            taps.append((position, wiring.math("MULTIPLY", weights[0][column], weights[1][row])))
    return taps


def _map_group(maps: MapFiles, kind: str, page: int) -> bpy.types.ShaderNodeTree:
    """A group from page UV to the texel there: one image texture however often it is read."""
    tree = bpy.data.node_groups.new(f"RTGI {kind}.p{page}", "ShaderNodeTree")
    tree[MARK] = True
    tree.interface.new_socket("UV", in_out="INPUT", socket_type="NodeSocketVector")
    tree.interface.new_socket("Color", in_out="OUTPUT", socket_type="NodeSocketColor")
    wiring = _Wiring(tree)
    uv = wiring.node("NodeGroupInput").outputs[0]
    texture = wiring.node("ShaderNodeTexImage", uv, extension="EXTEND", interpolation="Closest")
    tree[_RESOLUTION] = _show(texture, maps, kind, page)
    wiring.node("NodeGroupOutput", texture.outputs["Color"])
    return tree


def _show(texture: bpy.types.ShaderNodeTexImage, maps: MapFiles, kind: str, page: int) -> int:
    """Let an image texture show one map, following the scene's frame; ends hold outside the baked range.

    Returns the page's resolution.
    """
    first, last = maps.frames[0], maps.frames[-1]
    path = str(maps.path(kind, page, first))
    image = bpy.data.images.load(path, check_existing=False)
    image[MARK] = True
    image.name = f"rtgi_{kind}.p{page}"
    image.colorspace_settings.name = "Non-Color"
    image.alpha_mode = "CHANNEL_PACKED"
    image.use_half_precision = False  # half floats end at 65504 (Blender 4 clamps there all the same)
    image.filepath = stored_path(path)
    texture.image, resolution = image, int(image.size[0])
    if len(maps.frames) == 1:
        return resolution
    image.source = "SEQUENCE"
    user = texture.image_user
    user.use_auto_refresh, user.use_cyclic = True, False
    # Blender shows file number (frame - frame_start + 1, clamped to 0 .. frame_duration) + frame_offset: the offset
    # makes it the last baked frame at or before the scene's. The expression is too simple to need script rights.
    user.frame_start, user.frame_duration = 1, _LAST_FRAME
    step = maps.frames[1] - first
    held = f"min(max(frame, {first}), {last})"
    if step > 1:
        held = f"{held} - fmod({held} - {first}, {step})"
    user.driver_add("frame_offset").driver.expression = f"{held} - max(frame, 0)"
    return resolution


def stored_path(path: str | Path) -> str:
    """``path`` as a .blend keeps it: relative to the file, where it has one on the same drive.

    Saving the file elsewhere makes Blender mend it, so that scene and maps can be moved together.
    """
    own = bpy.data.filepath
    return bpy.path.relpath(str(path)) if own and Path(path).anchor == Path(own).anchor else str(path)


def _emit(wiring: _Wiring, irradiance: bpy.types.NodeSocket) -> None:
    inputs = wiring.node("NodeGroupInput").outputs
    diffuse = wiring.math("SUBTRACT", 1.0, inputs["Metallic"], clamp=True)
    opaque = wiring.math("SUBTRACT", 1.0, inputs["Transmission"], clamp=True)
    share = wiring.math("MULTIPLY", wiring.math("MULTIPLY", diffuse, opaque), inputs["Alpha"], clamp=True)
    radiosity = wiring.scaled(wiring.vector("MULTIPLY", irradiance, inputs["Albedo"]), share)
    emission = wiring.node("ShaderNodeEmission", radiosity, 1.0 / math.pi)
    wiring.node("NodeGroupOutput", emission.outputs[0])
