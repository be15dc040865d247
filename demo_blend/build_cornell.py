# SPDX-License-Identifier: GPL-3.0-or-later
"""cornell.blend: the Cornell box, open at the front, with a point light under the ceiling and a block that slides."""

from __future__ import annotations

from math import radians

import bpy
from kit import FRAMES, add_boxes, add_camera, add_point_light, add_quad, diffuse, new_scene, place, save

# Reflectances measured on the real box, as linear Rec.709: https://www.graphics.cornell.edu/online/box/data.html
WHITE, RED, GREEN = (0.725, 0.71, 0.68), (0.63, 0.065, 0.05), (0.14, 0.45, 0.091)


def build() -> None:
    new_scene(size=(512, 512), frame_end=FRAMES)
    white = diffuse("White", WHITE)
    walls = {
        "Floor": (white, [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]),
        "Ceiling": (white, [(-1, 1, 2), (1, 1, 2), (1, -1, 2), (-1, -1, 2)]),
        "Back": (white, [(-1, 1, 0), (1, 1, 0), (1, 1, 2), (-1, 1, 2)]),
        "Left": (diffuse("Red", RED), [(-1, -1, 0), (-1, 1, 0), (-1, 1, 2), (-1, -1, 2)]),
        "Right": (diffuse("Green", GREEN), [(1, 1, 0), (1, -1, 0), (1, -1, 2), (1, 1, 2)]),
    }
    for name, (material, corners) in walls.items():
        add_quad(name, corners, material)
    place(add_boxes("Tall block", [((-0.3, -0.3, 0), (0.3, 0.3, 1.2))], white), (-0.36, 0.36, 0), turn=17)
    slide(place(add_boxes("Short block", [((-0.3, -0.3, 0), (0.3, 0.3, 0.6))], white), (0.45, -0.45, 0), turn=-17))
    add_point_light("Light", (0.0, 0.0, 1.85), 32.0)
    add_camera((0.0, -3.8, 1.0), (0.0, 0.0, 1.0), lens=49.0)


def slide(block: bpy.types.Object) -> None:
    """Across the box in front of the tall block, turning a little; both ends at rest."""
    for frame, x, turn in ((1, 0.45, -17), (FRAMES, -0.4, 20)):
        block.location.x, block.rotation_euler.z = x, radians(turn)
        block.keyframe_insert("location", index=0, frame=frame)
        block.keyframe_insert("rotation_euler", index=2, frame=frame)


if __name__ == "__main__":
    build()
    save(__file__)
