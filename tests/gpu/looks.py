# SPDX-License-Identifier: GPL-3.0-or-later
"""Views drawn, and the same traced by Embree: what the tests of the views' passes share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtgi_addon.backend.final_gather.views.coarse import CoarseMesh
from rtgi_addon.backend.final_gather.views.entries import make_entries
from rtgi_addon.backend.final_gather.views.raster import ViewRaster
from rtgi_addon.backend.final_gather.views.target import Eyes, Target
from rtgi_addon.backend.final_gather.views.view import Face, View, make_view
from rtgi_addon.backend.gpu.context import Gpu
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.placed import PlacedScene
from rtgi_addon.backend.sampling import frames
from rtgi_addon.backend.scene import Atlas, FrameState, Instance, Mesh, Scene
from rtgi_addon.backend.settings import Gather
from tests.backend import scenes

#: Where a pixel shows something else than a ray through its middle sees, it is what a ray sees that passes so near to
#: the middle, in pixels. OpenGL puts corners on a grid of 1/16 of a pixel or finer; float32 on both sides adds to that.
NEAR_PX = 1 / 8
#: ... but for this share of all pixels. Just beyond a silhouette, as far as corners were moved, the planes of an
#: object's front and back have changed places: there its back is drawn. Corners of texels are seen by no ray of a few.
STRANGE = 3e-4
ANGLES = np.linspace(0, 2 * np.pi, 16, endpoint=False)


class Look:
    """A scene, ready to be drawn from any of its texels."""

    def __init__(
        self, gpu: Gpu, scene: Scene, atlas: Atlas, kind: Gather = Gather.HEMICUBE, size: int = 16,
        *, state: FrameState | None = None, coarse: dict[int, CoarseMesh] | None = None,
    ) -> None:  # fmt: skip
        self.gpu, self.view = gpu, make_view(kind, size)
        self.state = state or scene.first_frame()
        self.placed = PlacedScene(scene, atlas, self.state, (), Workers(1))
        self.texels, self.geometry = self.placed.texels, self.placed.geometry
        self.entries = make_entries(self.texels, self.placed.sky)
        self.raster = ViewRaster(gpu, self.view, self.geometry, self.texels, self.state, self.entries, coarse or {})

    def follow(self, **changes) -> None:
        """To the frame that differs by ``changes`` of the state."""
        self.state = replace(self.state, **changes)
        change = self.placed.follow(self.state)
        self.raster.follow(np.flatnonzero(change.sweep.moved), self.state)

    def eyes(self, texel) -> Eyes:
        """At a point of each of ``texel`` (m,), lifted off it as rays are; turned, each by another angle."""
        frame, texel = self.placed.frame, np.asarray(texel, np.int32)
        tangent, bitangent = frames(frame.normal[texel])
        cosine, sine = (f(0.7 * texel[:, None]).astype(np.float32) for f in (np.cos, np.sin))
        points = frame.points[texel]
        return Eyes(
            points[:, 0], tangent * cosine + bitangent * sine, frame.normal[texel], frame.geometric_normal[texel],
            self.texels.instance[texel], points, np.ones(points.shape[:2], np.bool_),
            np.zeros((len(texel), 2), np.float32), np.zeros(len(texel), np.bool_),
        )  # fmt: skip

    def drawn(self, eyes: Eyes) -> np.ndarray:
        """(m, H, W) what each pixel of the views from ``eyes`` (m,) shows, see :meth:`shown`."""
        count = len(eyes.eye)
        target = Target(self.gpu, self.view, min(8, count), -(-count // 8))
        self.raster.draw(target, np.arange(count, dtype=np.int32), eyes)
        images = tiles(target)[:count]
        target.release()
        return self.shown(images)

    def shown(self, entry: np.ndarray) -> np.ndarray:
        """What the pixels of ``entry`` stand for: a texel or patch of sky; else less than zero, ``none`` and
        ``escaped`` told apart."""
        target = self.entries.target[entry].astype(np.int64)
        return np.where(target < 0, -1 - entry, target)

    def owner(self, shown: np.ndarray) -> np.ndarray:
        """The instance of each texel ``shown``; -1 where it is none."""
        inside = (shown >= 0) & (shown < self.texels.count)
        return np.where(inside, self.texels.instance.take(shown, mode="clip"), -1)

    def traced(self, eyes: Eyes) -> np.ndarray:
        """(m, H, W) what rays through the middles of pixels see, as :meth:`shown`."""
        ways = self.view.directions.astype(np.float64)
        rows = np.repeat(np.arange(len(eyes.eye)), ways[..., 0].size)
        found = self.seen(eyes.take(rows), np.tile(ways.reshape(-1, 3), (len(eyes.eye), 1)))
        return found.reshape(len(eyes.eye), *ways.shape[:-1])

    def seen(self, eyes: Eyes, ways: np.ndarray) -> np.ndarray:
        """(k,) what rays from ``eyes`` (k,) along ``ways`` (k, 3), tangent space, see."""
        x, y, z = ways.T[:, :, None]
        normal, tangent = eyes.normal.astype(np.float64), eyes.tangent.astype(np.float64)
        directions = (x * tangent + y * np.cross(normal, tangent) + z * normal).astype(np.float32)
        hits = self.placed.tracer.intersect(eyes.eye, directions)
        texels, escaped = self.texels, hits.triangle < 0
        target = texels.of_hits(hits.triangle, hits.u, hits.v, hits.back).astype(np.int64)
        found = np.where(target < 0, -1 - self.entries.none, target)
        found[escaped] = -1 - self.entries.escaped
        if self.placed.sky is not None:
            found[escaped] = texels.count + self.placed.sky.of_directions(directions[escaped])
        return found

    def apart(self, eyes: Eyes) -> tuple[float, float]:
        """Of the pixels of the views from ``eyes`` the share that do not show what a ray through their middle sees; and
        the share that show nothing that a ray within NEAR_PX of it sees."""
        drawn, rays = self.drawn(eyes), self.traced(eyes)
        eye, row, col = np.nonzero(drawn != rays)
        strange = np.ones(len(eye), np.bool_)
        for near in (NEAR_PX, NEAR_PX / 8):
            for angle in ANGLES:
                way = shifted(self.view, near * np.cos(angle), near * np.sin(angle))[row, col]
                strange &= self.seen(eyes.take(eye), way) != drawn[eye, row, col]
        return len(eye) / drawn.size, float(strange.sum()) / drawn.size

    def assert_as_rays(self, texel, *, least: float = 0.995) -> np.ndarray:
        """Pixels show what rays see on a share of ``least``, elsewhere what they see within NEAR_PX; the images."""
        eyes = self.eyes(texel)
        differ, strange = self.apart(eyes)
        assert differ <= 1 - least and strange <= STRANGE, f"{differ:.3%} differ, {strange:.3%} are like nothing near"
        return self.drawn(eyes)


def tiles(target: Target) -> np.ndarray:
    """(t, H, W) the entries of all tiles of ``target``."""
    with target._gpu.current():
        image = np.frombuffer(target.texture.read(), np.uint32).astype(np.int64)
    h, w = target.view.height, target.view.width
    return image.reshape(target.down, h, target.across, w).swapaxes(1, 2).reshape(-1, h, w)


def shifted(view: View, dx: float, dy: float) -> np.ndarray:
    """(H, W, 3) tangent space: through points (dx, dy) pixels from the middles of the ``view``'s pixels."""
    return np.concatenate([_through(face, dx, dy) for face in view.faces])


def _through(face: Face, dx: float, dy: float) -> np.ndarray:
    _, _, width, height = face.rectangle
    x = (np.arange(width) + 0.5 + dx) / width * 2 - 1
    y = face.low + (np.arange(height) + 0.5 + dy) / height * (1 - face.low)
    drawn = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((height, width))], axis=-1)
    points = drawn @ np.linalg.inv(face.axes).T
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def lifted_box(texels: int = 12, *, moving: bool = False) -> tuple[Scene, Atlas]:
    """Cornell's box with its blocks a hand's breadth above the floor, so that no two surfaces coincide."""
    scene, atlas = scenes.cornell(texels, moving=moving)
    lift = [scenes.translation(0, 0, 0.1 if i >= 5 else 0.0) for i in range(7)]
    return changed(scene, lift), atlas


def changed(scene: Scene, matrices) -> Scene:
    """``scene`` with one of ``matrices`` (4, 4) after each instance's own."""
    pairs = zip(scene.instances, matrices, strict=True)
    return replace(scene, instances=tuple(replace(i, matrix_world=m @ i.matrix_world) for i, m in pairs))


def scene_of(*meshes: Mesh, size: int = 8, back: tuple[int, ...] = (), **options) -> tuple[Scene, Atlas]:
    """``meshes`` where they are, each with ``size``² pixels."""
    instances = tuple(Instance(m.name, i, np.eye(4), **options) for i, m in enumerate(meshes))
    scene = Scene(meshes, instances, (scenes.WHITE,))
    return scene, scenes.grid_atlas(scene, [(size, size)] * len(meshes), back=back)
