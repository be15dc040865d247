# SPDX-License-Identifier: GPL-3.0-or-later
"""What of a material goes on as a ray: mirror, glass and see-through shares, read as constants from the node tree.

Diffuse and rough reflectance and emission are not read here: Cycles evaluates them (see ``texture_bake``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import bpy
import numpy as np

from ..backend.scene import Float64
from . import nodes

OUTPUT = "ShaderNodeOutputMaterial"
#: Below this roughness a reflection counts as a mirror's; above as diffuse with the same reflectance.
MIRROR_ROUGHNESS = 0.1
ROUGH_GLASS = "the glass {} is rough; light passes it as if it were clear"
#: Shaders without any lobe that a ray could follow.
ROUGH_SHADERS = {
    "ShaderNodeBsdfDiffuse", "ShaderNodeEmission", "ShaderNodeBsdfTranslucent", "ShaderNodeSubsurfaceScattering",
    "ShaderNodeBsdfSheen", "ShaderNodeBsdfVelvet", "ShaderNodeBsdfToon", "ShaderNodeBsdfHair", "ShaderNodeHoldout",
    "ShaderNodeBackground",
}  # fmt: skip


@dataclass(frozen=True)
class Lobes:
    """Shares by colour, (3,) each; ``notes`` say what could not be followed."""

    specular: Float64 = field(default_factory=lambda: np.zeros(3))
    transmission: Float64 = field(default_factory=lambda: np.zeros(3))
    transparent: Float64 = field(default_factory=lambda: np.zeros(3))
    ior: float = 1.45
    notes: tuple[str, ...] = ()

    @property
    def any(self) -> bool:
        return bool((self.specular + self.transmission + self.transparent).max() > 0)


def read_lobes(material: bpy.types.Material) -> Lobes:
    """Of the surface that Cycles renders."""
    if not nodes.uses_nodes(material):
        return Lobes()
    tree = material.node_tree
    lobes = _lobes(nodes.output_link(tree, OUTPUT, "Surface"))
    notes = lobes.notes
    if nodes.output_link(tree, OUTPUT, "Volume") is not None:
        notes += ("its volume is not baked; only its surface scatters light",)
    moved = getattr(material, "displacement_method", "BUMP") != "BUMP"
    if moved and nodes.output_link(tree, OUTPUT, "Displacement") is not None:
        notes += ("its displacement does not move the baked surface; use a Displace modifier instead",)
    return replace(lobes, notes=notes)


def _lobes(node: bpy.types.Node | None) -> Lobes:
    if node is None or node.mute or node.bl_idname in ROUGH_SHADERS:
        return Lobes()
    reader = READERS.get(node.bl_idname)
    return Lobes(notes=(f"the node {node.name} is not followed by rays",)) if reader is None else reader(node)


def _mix(node: bpy.types.Node) -> Lobes:
    first, second = (_lobes(nodes.source_node(node.inputs[i])) for i in (1, 2))
    factor = nodes.constant_input(node, node.inputs[0].name)
    if factor is None:
        notes = first.notes + second.notes
        if first.any or second.any:
            notes += (
                f"the factor of {node.name} varies, so what is clear or a mirror there counts as rough and opaque",
            )
        return Lobes(notes=notes)
    share = min(max(factor[0], 0.0), 1.0)
    return _sum(_scaled(first, 1 - share), _scaled(second, share))


def _add(node: bpy.types.Node) -> Lobes:
    return _sum(*(_lobes(nodes.source_node(socket)) for socket in node.inputs[:2]))


def _group(node: bpy.types.Node) -> Lobes:
    """A group whose shader does not hang on what it is given from outside; else the notes say so."""
    link = node_output_socket(node)
    if link is None:
        return Lobes()
    return _lobes(nodes.source_node(link))


def node_output_socket(group: bpy.types.Node) -> bpy.types.NodeSocket | None:
    """The shader input of the output node inside ``group``."""
    if group.node_tree is None:
        return None
    for end in group.node_tree.nodes:
        if end.bl_idname == "NodeGroupOutput" and getattr(end, "is_active_output", True):
            return next((s for s in end.inputs if s.type == "SHADER"), None)
    return None


def _principled(node: bpy.types.Node) -> Lobes:
    metallic, glass, alpha = (_share(node, key) for key in ("Metallic", "Transmission Weight", "Alpha"))
    notes = tuple(
        f"the {what} of {node.name} varies; it is taken as {taken}"
        for share, what, taken in (
            (metallic, "metallic share", "not a mirror"),
            (glass, "transmission", "opaque"),
            (alpha, "alpha", "opaque"),
        )
        if share is None
    )
    opaque = 1.0 if alpha is None else alpha
    metallic, glass = metallic or 0.0, glass or 0.0
    smooth, base = _is_smooth(node), nodes.constant_input(node, "Base Color")
    specular, transmission = np.zeros(3), np.zeros(3)
    if base is not None:
        colour = np.maximum(np.array(base[:3], np.float64), 0)
        specular = colour * (metallic * opaque if smooth else 0.0)
        # Cycles tints light that passes by the root of the colour at each face, in and out.
        transmission = np.sqrt(colour) * glass * (1 - metallic) * opaque
        if glass > 0 and not smooth:
            notes += (ROUGH_GLASS.format(node.name),)
    elif glass > 0 or (metallic > 0 and smooth):
        notes += (f"the colour of {node.name} varies, so its mirror or glass counts as rough and opaque",)
    return Lobes(specular, transmission, np.full(3, 1 - opaque), _ior(node), notes)


def _glass(node: bpy.types.Node) -> Lobes:
    colour = nodes.constant_input(node, "Color")
    if colour is None:
        return Lobes(notes=(f"the colour of the glass {node.name} varies; it is taken as opaque",))
    notes = () if _is_smooth(node) else (ROUGH_GLASS.format(node.name),)
    return Lobes(transmission=np.array(colour[:3], np.float64), ior=_ior(node), notes=notes)


def _glossy(node: bpy.types.Node) -> Lobes:
    if not _is_smooth(node):
        return Lobes()
    colour = nodes.constant_input(node, "Color" if "Color" in node.inputs else "Base Color")
    if colour is None:
        return Lobes(notes=(f"the colour of the mirror {node.name} varies; it counts as diffuse",))
    return Lobes(specular=np.array(colour[:3], np.float64))


def _transparent(node: bpy.types.Node) -> Lobes:
    colour = nodes.constant_input(node, "Color")
    if colour is None:
        return Lobes(notes=(f"the colour of {node.name} varies; it is taken as opaque",))
    return Lobes(transparent=np.array(colour[:3], np.float64))


READERS = {
    "ShaderNodeMixShader": _mix,
    "ShaderNodeAddShader": _add,
    "ShaderNodeGroup": _group,
    "ShaderNodeBsdfPrincipled": _principled,
    "ShaderNodeBsdfGlass": _glass,
    "ShaderNodeBsdfRefraction": _glass,
    "ShaderNodeBsdfGlossy": _glossy,
    "ShaderNodeBsdfAnisotropic": _glossy,
    "ShaderNodeBsdfMetallic": _glossy,
    "ShaderNodeBsdfTransparent": _transparent,
}


def _share(node: bpy.types.Node, key: str) -> float | None:
    value = nodes.constant_input(node, key)
    return None if value is None else min(max(value[0], 0.0), 1.0)


def _is_smooth(node: bpy.types.Node) -> bool:
    roughness = nodes.constant_input(node, "Roughness")
    return roughness is not None and roughness[0] < MIRROR_ROUGHNESS


def _ior(node: bpy.types.Node) -> float:
    value = nodes.constant_input(node, "IOR")
    return 1.45 if value is None else max(value[0], 1e-3)


def _scaled(lobes: Lobes, share: float) -> Lobes:
    if share == 0:
        return Lobes()
    return Lobes(lobes.specular * share, lobes.transmission * share, lobes.transparent * share, lobes.ior, lobes.notes)


def _sum(a: Lobes, b: Lobes) -> Lobes:
    return Lobes(
        a.specular + b.specular,
        a.transmission + b.transmission,
        a.transparent + b.transparent,
        a.ior if a.transmission.max() >= b.transmission.max() else b.ior,
        a.notes + b.notes,
    )
