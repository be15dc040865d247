# SPDX-License-Identifier: GPL-3.0-or-later
"""All that a file holds of what light maps touch, as values to compare before and after."""

from __future__ import annotations

import bpy

#: Not content. Who brought a library's data in changes with any local user until the file is saved.
_NOT_CONTENT = {"rna_type", "users", "is_evaluated", "session_uid", "warning_propagation", "is_library_indirect"}
if bpy.app.version >= (5, 0):
    _NOT_CONTENT.add("use_nodes")  # always true there, and asking is deprecated


def dump_file() -> dict[str, object]:
    """All that the file holds of materials, node trees, slots, meshes and images, as comparable values."""
    trees = {f"material {m.name_full}": m.node_tree for m in bpy.data.materials if m.node_tree}
    trees |= {f"group {t.name_full}": t for t in bpy.data.node_groups}
    return {
        "materials": sorted((m.name_full, m.users, dump(m), keys(m)) for m in bpy.data.materials),
        "trees": {name: dump_tree(tree) for name, tree in trees.items()},
        "slots": sorted(
            (o.name, [(s.link, s.material and s.material.name_full) for s in o.material_slots])
            for o in bpy.data.objects
        ),
        "meshes": sorted(
            (
                m.name,
                [x and x.name_full for x in m.materials],
                [p.material_index for p in m.polygons],
                [u.name for u in m.uv_layers],
                keys(m),
            )
            for m in bpy.data.meshes
        ),
        "images": sorted(i.name for i in bpy.data.images if i.type != "RENDER_RESULT"),
    }


def keys(block: bpy.types.bpy_struct) -> list[str]:
    return sorted(block.keys())


def dump_tree(tree: bpy.types.NodeTree) -> tuple[object, ...]:
    nodes = {
        n.name: (
            dump(n),
            keys(n),
            [dump(s) for s in n.inputs],
            [dump(s) for s in n.outputs],
            n.parent and n.parent.name,
        )
        for n in tree.nodes
    }
    links = sorted(
        (k.from_node.name, k.from_socket.identifier, k.to_node.name, k.to_socket.identifier, k.is_muted)
        for k in tree.links
    )
    animation = tree.animation_data
    drivers = [] if animation is None else sorted(d.data_path for d in animation.drivers)
    return [n.name for n in tree.nodes], nodes, links, tree.nodes.active and tree.nodes.active.name, drivers


def dump(block: bpy.types.bpy_struct) -> dict[str, object]:
    """Every plain property of ``block``."""
    values = {}
    for prop in block.bl_rna.properties:
        if prop.identifier in _NOT_CONTENT:
            continue
        if prop.type in ("BOOLEAN", "INT", "FLOAT", "STRING", "ENUM"):
            value = getattr(block, prop.identifier)
            plain = isinstance(value, int | float | str | bool)
            values[prop.identifier] = (
                value if plain else sorted(value) if isinstance(value, set) else tuple(map(repr, value))
            )
        elif prop.type == "POINTER":
            value = getattr(block, prop.identifier)
            values[prop.identifier] = getattr(value, "name_full", None)
    return values
