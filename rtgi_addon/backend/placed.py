# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene as it stands in one frame, ready to be lit: the stage "place". It follows from frame to frame.

Only what moved is placed anew; what is told of it (:class:`~.selection.changes.Change`) is all that the later stages
need to find what still holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .lamps.sky import Sky, make_sky, sky_layout
from .parallel import Workers
from .scene import Atlas, Bool, Float32, FrameState, Material, Scene
from .selection.changes import Change
from .selection.sweep import Sweep
from .surface.geometry import Geometry
from .surface.scatter import Surfaces, diffuse_shares, make_surfaces
from .surface.texels import TexelFrame, follow_texels, make_texels, place_texels, texel_colours
from .surface.tracing import EmbreeTracer, FollowingTracer

#: Makes a tracer of a scene in the frame that its geometry and state stand in.
MakeTracer = Callable[[Scene, Geometry, FrameState], FollowingTracer]


class PlacedScene:
    """n texels and m targets (texels and sky patches) in the frame last given to :meth:`follow`."""

    state: FrameState
    materials: tuple[Material, ...]
    surfaces: Surfaces
    sky: Sky | None
    albedo: Float32  # (n, 3) share of the light arriving that leaves diffusely: albedo × opacity
    emitted: Float32  # (m, 3) radiosity that targets send of themselves, W/m²
    frame: TexelFrame

    def __init__(
        self, scene: Scene, atlas: Atlas, state: FrameState, guide: Sequence[FrameState], workers: Workers,
        make_tracer: MakeTracer | None = None,
    ) -> None:  # fmt: skip
        """``state`` is the first frame; ``guide`` others of the same bake, whose skies it is ready for.

        ``make_tracer``: what traces rays; None: Embree.
        """
        self.scene, self.state, self.workers = scene, state, workers
        self.geometry = Geometry(scene, state)
        self.trace_with(make_tracer)
        self.texels = make_texels(scene, atlas, self.geometry)
        self.frame = place_texels(self.texels, self.geometry)
        self._layout = sky_layout(s.world for s in (state, *guide))
        self._colour(state)
        self._shine(state)

    def trace_with(self, make_tracer: MakeTracer | None) -> None:
        """Another tracer from now on: rays that are kept must be forgotten."""
        of_frame = self.scene, self.geometry, self.state
        self.tracer: FollowingTracer = make_tracer(*of_frame) if make_tracer else EmbreeTracer(*of_frame, self.workers)

    def follow(self, state: FrameState) -> Change:
        """Bring everything to ``state``; what differs from the frame before."""
        before, sky, emitted = self.state, self.sky, self.emitted
        instances = self.geometry.update(state)
        movement = self.tracer.update(state, instances)
        moved = state.visible != before.visible
        moved[instances] = True
        texels: Bool = moved[self.texels.instance]
        follow_texels(self.frame, self.texels, self.geometry, np.nonzero(texels)[0])
        surfaces, albedo = self.surfaces, self.albedo
        materials = state.materials or self.scene.materials
        self.state = state
        if materials != self.materials:
            self._colour(state)
        if self.surfaces is not surfaces or state.world is not before.world:
            self._shine(state)
        return Change(
            sweep=Sweep(movement.left, movement.taken, moved, self.workers),
            texels=texels,
            scattering=np.any(self.albedo != albedo, axis=1) if self.albedo is not albedo else None,
            passing=not _pass_alike(surfaces, self.surfaces),
            emitted=not np.array_equal(emitted, self.emitted),
            everything=movement.rebuilt or _layout_of(sky) != _layout_of(self.sky),
        )

    def place_again(self) -> None:
        """Place all texels, after a frame that was cut short."""
        follow_texels(self.frame, self.texels, self.geometry, np.arange(self.texels.count))

    def _colour(self, state: FrameState) -> None:
        """Reflection, from materials and maps."""
        self.materials = state.materials or self.scene.materials
        albedo, glow = texel_colours(self.texels, self.scene, self.geometry, self.materials)
        self.surfaces = make_surfaces(self.geometry, self.texels, albedo, self.materials)
        self.albedo = diffuse_shares(self.surfaces, self.texels.triangle)
        self._glow = glow * np.float32(np.pi)

    def _shine(self, state: FrameState) -> None:
        """What surfaces and sky send of themselves."""
        self.sky = make_sky(state.world, self._layout)
        self.emitted = self._glow
        if self.sky is not None:
            self.emitted = np.concatenate([self._glow, self.sky.radiance * np.float32(np.pi)])


def _pass_alike(a: Surfaces, b: Surfaces) -> bool:
    """Do all materials mirror, refract and let through as before?"""
    if a is b:
        return True
    tables = ("specular", "transmission", "ior", "opacity", "passes")
    if not all(np.array_equal(getattr(a, name), getattr(b, name)) for name in tables):
        return False
    # On a surface that passes rays, which ray goes on hangs on its albedo, too.
    return not b.passes.any() or np.array_equal(a.albedo, b.albedo)


def _layout_of(sky: Sky | None) -> tuple[int, int] | None:
    return None if sky is None else (sky.rows, sky.columns)
