# SPDX-License-Identifier: GPL-3.0-or-later
"""Light-map light in the materials of objects, and every material given back as it was.

A material with nodes is lit in place, with the node groups inside it. What cannot be edited, having no nodes or
coming from a library, is copied; the copy stands in the object's slot and remembers what it replaced.
"""

from __future__ import annotations

from collections.abc import Iterable

import bpy
import numpy as np

from .lightmap_nodes import light_tree, nested_trees, unlight_tree
from .lightmap_sampling import MARK

ORIGINAL = "rtgi_original"  # on a copy: the datablock it replaces; absent where there was none
_DEFAULT_GREY = (0.8, 0.8, 0.8, 1.0)  # what Blender draws a face without a material in


def light_materials(objects: Iterable[bpy.types.Object], group: bpy.types.ShaderNodeTree) -> tuple[str, ...]:
    """Light every material that ``objects`` show; warnings, one for each material that stays partly dark."""
    copies: dict[bpy.types.Material | None, bpy.types.Material] = {}
    warnings: dict[str, None] = {}
    for obj in objects:
        if not obj.material_slots:
            _add_slot(obj.data)
        for slot in obj.material_slots:
            material = slot.material
            if material is None or not _is_editable(material):
                if material not in copies:
                    copies[material] = _lightable_copy(material)
                material = slot.material = copies[material]
            for kind in _light(material.node_tree, group):
                name = material.get(ORIGINAL, material).name
                warnings[f'material "{name}": its {kind} shows no light-map light in Eevee'] = None
    return tuple(warnings)


def unlight_materials() -> None:
    """Undo :func:`light_materials` throughout the file."""
    groups = [t for t in bpy.data.node_groups if t.bl_idname == "ShaderNodeTree" and not t.get(MARK)]
    trees = [t.node_tree for t in bpy.data.materials if t.node_tree and t.library is None]
    trees += [t for t in groups if t.library is None]
    for tree in trees:
        for node in nested_trees(tree):
            node.node_tree = node.node_tree.get(ORIGINAL, node.node_tree)
        unlight_tree(tree)
    for group in [g for g in groups if g.get(ORIGINAL)]:
        bpy.data.node_groups.remove(group)
    for obj in [o for o in bpy.data.objects if o.library is None]:
        for slot in obj.material_slots:
            if slot.material is not None and slot.material.get(MARK):
                slot.material = slot.material.get(ORIGINAL)
    for material in [m for m in bpy.data.materials if m.get(MARK)]:
        bpy.data.materials.remove(material)
    for mesh in [m for m in bpy.data.meshes if m.get(MARK + "_slot")]:
        _remove_slot(mesh)


def _is_editable(material: bpy.types.Material) -> bool:
    return material.library is None and _has_nodes(material)


def _has_nodes(material: bpy.types.Material) -> bool:
    # From 5.0 every material has nodes, and asking is deprecated.
    return material.node_tree is not None and (bpy.app.version >= (5, 0) or material.use_nodes)


def _lightable_copy(material: bpy.types.Material | None) -> bpy.types.Material:
    if material is not None and _has_nodes(material):
        copy = material.copy()
        copy.name = f"{material.name} RTGI"
    else:  # Blender draws it as a diffuse surface in its viewport colour
        copy = bpy.data.materials.new(f"{material.name if material else 'Default'} RTGI")
        if bpy.app.version < (5, 0):
            copy.use_nodes = True
        tree = copy.node_tree
        tree.nodes.clear()
        diffuse, output = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
        diffuse.inputs["Color"].default_value = material.diffuse_color if material else _DEFAULT_GREY
        tree.links.new(diffuse.outputs[0], output.inputs["Surface"])
    copy[MARK] = True
    if material is not None:
        copy[ORIGINAL] = material
    return copy


def _light(tree: bpy.types.NodeTree, group: bpy.types.ShaderNodeTree) -> list[str]:
    """Light ``tree`` and the groups in it; names of closures left dark."""
    dark = []
    for node in nested_trees(tree):
        if node.node_tree.library is not None:
            original = node.node_tree
            node.node_tree = original.copy()
            node.node_tree[ORIGINAL] = original
        dark += _light(node.node_tree, group)
    return dark + light_tree(tree, group)


def _add_slot(mesh: bpy.types.Mesh) -> None:
    mesh.materials.append(None)
    mesh[MARK + "_slot"] = True


def _remove_slot(mesh: bpy.types.Mesh) -> None:
    """Take the slot away again without Blender's renumbering of the faces' material indices."""
    del mesh[MARK + "_slot"]
    attribute = mesh.attributes.get("material_index")
    indices = np.zeros(len(mesh.polygons), np.int32)
    if attribute is not None:
        attribute.data.foreach_get("value", indices)
    mesh.materials.pop()
    for obj in [o for o in bpy.data.objects if o.data == mesh]:
        obj.data = mesh  # Blender counts an object's slots again only when its mesh is set
    attribute = mesh.attributes.get("material_index")
    if attribute is not None:
        attribute.data.foreach_set("value", indices)
