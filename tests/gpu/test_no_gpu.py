# SPDX-License-Identifier: GPL-3.0-or-later
"""Without a GPU, or with one that fails, at any time: one line says so, and the maps are, to the last bit, those of
links. The first half runs without any OpenGL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bench import sequences
from rtgi_addon.backend.final_gather import gathers
from rtgi_addon.backend.final_gather.gathers import Gathers
from rtgi_addon.backend.final_gather.views import view_gather
from rtgi_addon.backend.final_gather.views.raster import ViewRaster
from rtgi_addon.backend.final_gather.views.sums import ViewSums
from rtgi_addon.backend.gpu import programs
from rtgi_addon.backend.gpu.compute_tracer import ComputeTracer
from rtgi_addon.backend.gpu.context import Gpu, GpuFailed, GpuUnavailable, open_gpu
from rtgi_addon.backend.live import LiveSession
from rtgi_addon.backend.parallel import Workers
from rtgi_addon.backend.scene import LightMaps
from rtgi_addon.backend.session import FrameResult, Session
from rtgi_addon.backend.settings import GPU_GATHERS, BakeSettings, Budget, Device, Gather, LiveSettings
from tests.backend import scenes, stories

STORY = sequences.rigid_mover(5, frames=4)
LINKS = stories.settings_of(STORY, replace(stories.BARE, gather=Gather.LINKS))
ASKED = {
    **{str(gather): replace(LINKS, gather=gather) for gather in GPU_GATHERS},
    "gpu": replace(LINKS, device=Device.GPU),
}
FAULT = "Some Card: out of memory"


@pytest.fixture(scope="module")
def by_links() -> list[FrameResult]:
    return stories.play(STORY, LINKS, range(4))


def without(monkeypatch: pytest.MonkeyPatch, why: str = "no OpenGL 3.3: no display") -> None:
    def none(**_: int) -> Gpu:
        raise GpuUnavailable(why)

    monkeypatch.setattr(gathers, "open_gpu", none)


def told(result: FrameResult) -> list[str]:
    return [line for line in result.stats.warnings if "by links" in line]


def assert_by_links(result: FrameResult, wanted: FrameResult, fault: str) -> None:
    """The maps of links to the last bit, and one line that says why."""
    assert not (found := stories.differences(result.maps, wanted.maps)), found
    lines = told(result)
    assert len(lines) == 1 and fault in lines[0] and "\n" not in lines[0]
    assert result.stats.gather == Gather.LINKS and fault in result.stats.gather_reason
    assert result.stats.views_drawn == 0 and result.stats.device == "cpu"


# --- without OpenGL ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("asked", ASKED)
def test_without_a_gpu_it_is_done_by_links(monkeypatch, by_links, asked: str) -> None:
    without(monkeypatch)
    for result, wanted in zip(stories.play(STORY, ASKED[asked], range(4)), by_links, strict=True):
        assert_by_links(result, wanted, "no display")


def test_who_asks_for_links_is_told_nothing(monkeypatch, by_links) -> None:
    monkeypatch.setattr(gathers, "open_gpu", lambda **_: pytest.fail("a context was opened"))
    for settings in (LINKS, replace(LINKS, gather=Gather.AUTO), replace(LINKS, device=Device.CPU)):
        result = stories.play(STORY, settings, [0])[0]
        assert not stories.differences(result.maps, by_links[0].maps) and not told(result)


@pytest.mark.parametrize("gather", GPU_GATHERS)
def test_a_gather_by_the_gpu_on_the_cpu_is_refused(gather: Gather) -> None:
    with pytest.raises(ValueError, match=f"gather = {gather}"):
        BakeSettings(gather=gather, device=Device.CPU)


def test_without_moderngl_its_fault_is_named(monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "moderngl", None)
    with pytest.raises(GpuUnavailable, match="ModernGL is not installed"):
        open_gpu()


def test_a_driver_s_fault_becomes_one_line(monkeypatch) -> None:
    moderngl = pytest.importorskip("moderngl")

    def refuse(**_: object) -> None:
        raise RuntimeError("cannot open display\n  (0x3000)")

    monkeypatch.setattr(moderngl, "create_context", refuse)
    with pytest.raises(GpuUnavailable) as fault:
        open_gpu()
    assert str(fault.value) == "no OpenGL 3.3: cannot open display (0x3000)"


def test_a_live_session_without_a_gpu(monkeypatch) -> None:
    without(monkeypatch)
    live = LiveSettings(Budget(texels=40))
    results: list[list[LightMaps]] = []
    for settings in (LINKS, ASKED["plane"]):
        with LiveSession(STORY.scene, STORY.atlas, settings, live, STORY.states[0]) as session:
            results.append([session.advance(s, float(n)).maps for n, s in enumerate(STORY.states)])
    for a, b in zip(*results, strict=True):
        assert not stories.differences(a, b)


# --- a GPU that fails -------------------------------------------------------------------------------------------------


def failing(method: Callable, after: Callable[[], bool]) -> Callable:
    """``method``, which fails once ``after()``."""

    def call(*args, **kwargs):
        if after():
            raise GpuFailed(FAULT)
        return method(*args, **kwargs)

    return call


#: Where the GPU fails: whose method, and the settings under which it is called.
FAULTS = {
    "views are drawn": (ViewRaster, "draw", "hemicube"),
    "views follow": (ViewRaster, "follow", "hemicube"),
    "sums": (ViewSums, "sums", "plane"),
    "light is sent": (ViewSums, "send", "plane"),
    "rays of the gather": (ComputeTracer, "intersect", "rays"),
    "all rays": (ComputeTracer, "intersect", "gpu"),
    "shadow rays": (ComputeTracer, "occluded", "gpu"),
    "rays follow": (ComputeTracer, "update", "gpu"),
}


@pytest.mark.parametrize("where", FAULTS)
def test_a_gpu_that_fails_in_a_frame_leaves_it_to_links(request, monkeypatch, by_links, where: str) -> None:
    """The second frame and all later ones are as if there had never been a GPU."""
    owner, name, asked = FAULTS[where]
    request.getfixturevalue("compute_gpu" if owner is ComputeTracer else "gpu")
    number = 0
    monkeypatch.setattr(owner, name, failing(getattr(owner, name), lambda: number == 1))
    with Session(STORY.scene, STORY.atlas, ASKED[asked], STORY.states[0], guide=STORY.guide[::4]) as session:
        for number, state in enumerate(STORY.states):
            result = session.advance(state)
            if number == 0:
                assert not told(result) and result.stats.device != "cpu"
            else:
                assert_by_links(result, by_links[number], FAULT)


@pytest.mark.parametrize("where", FAULTS)
def test_a_gpu_that_fails_from_the_start(request, monkeypatch, by_links, where: str) -> None:
    owner, name, asked = FAULTS[where]
    request.getfixturevalue("compute_gpu" if owner is ComputeTracer else "gpu")
    monkeypatch.setattr(owner, name, failing(getattr(owner, name), lambda: True))
    for result, wanted in zip(stories.play(STORY, ASKED[asked], range(3)), by_links[:3], strict=True):
        if told(result) or wanted.maps.frame > 1:  # what follows is not asked for in the first frame
            assert_by_links(result, wanted, FAULT)


def test_what_a_failed_gpu_told_is_forgotten(compute_gpu, monkeypatch, by_links) -> None:
    """Whatever it was: also where gather rays are aimed, which was settled before the first frame."""
    number = 0
    monkeypatch.setattr(ComputeTracer, "blocked", lambda _, origins, *rest: np.zeros(len(origins), np.uint8))
    monkeypatch.setattr(ComputeTracer, "update", failing(ComputeTracer.update, lambda: number == 1))
    with Session(STORY.scene, STORY.atlas, ASKED["gpu"], STORY.states[0], guide=STORY.guide[::4]) as session:
        assert stories.differences(session.advance(STORY.states[0]).maps, by_links[0].maps)
        for number in (1, 2):
            assert_by_links(session.advance(STORY.states[number]), by_links[number], FAULT)


def test_a_gpu_that_failed_is_not_asked_again(compute_gpu, monkeypatch, by_links) -> None:
    """Not to measure which gather is the fastest, either."""
    opened = []

    def counted(**asked: int) -> Gpu:
        opened.append(asked)
        return open_gpu(**asked)

    monkeypatch.setattr(gathers, "open_gpu", counted)
    monkeypatch.setattr(ComputeTracer, "__init__", failing(ComputeTracer.__init__, lambda: True))
    choice = replace(LINKS, gather=Gather.AUTO, device=Device.GPU)
    for result, wanted in zip(stories.play(STORY, choice, range(2)), by_links[:2], strict=True):
        assert_by_links(result, wanted, FAULT)
    assert len(opened) == 1


@pytest.mark.parametrize("asked", ASKED)
def test_a_context_that_is_lost(request, by_links, asked: str) -> None:
    request.getfixturevalue("compute_gpu" if asked in ("rays", "gpu") else "gpu")
    with Session(STORY.scene, STORY.atlas, ASKED[asked], STORY.states[0], guide=STORY.guide[::4]) as session:
        session.advance(STORY.states[0])
        gpu = session._gathers._gpu
        assert gpu is not None
        gpu.close()
        for number in (1, 2):
            assert_by_links(session.advance(STORY.states[number]), by_links[number], "its context is closed")


def small(monkeypatch: pytest.MonkeyPatch, **limits: int) -> None:
    """Contexts are opened on a device of such ``limits``."""

    def opened(**asked: int) -> Gpu:
        gpu = open_gpu(**asked)
        return replace(gpu, info=replace(gpu.info, **limits))

    monkeypatch.setattr(gathers, "open_gpu", opened)


def test_a_scene_that_does_not_fit_the_device(gpu, monkeypatch) -> None:
    """Its table of entries has more rows than a texture."""
    small(monkeypatch, max_texture=1)
    scene, atlas = scenes.cornell(30)
    assert atlas.resolution**2 > 4096
    settings = replace(LINKS, resolution=atlas.resolution)
    results = []
    for choice in (settings, replace(settings, gather=Gather.PLANE)):
        with Session(scene, atlas, choice, scene.first_frame()) as session:
            results.append(session.advance(scene.first_frame()))
    assert_by_links(results[1], results[0], "do not fit a texture")


def test_rays_that_do_not_fit_the_device(compute_gpu, monkeypatch, by_links) -> None:
    small(monkeypatch, max_storage=1024)
    result = stories.play(STORY, ASKED["gpu"], [0])[0]
    assert_by_links(result, by_links[0], "")


def test_memory_that_runs_out_for_a_target(gpu, monkeypatch, by_links) -> None:
    """Every target is larger than the driver makes textures."""
    monkeypatch.setattr(view_gather.ViewGather, "_fitting", lambda self, _: view_gather._Shape(self._view, 10**5, 1))
    result = stories.play(STORY, ASKED["plane"], [0])[0]
    assert_by_links(result, by_links[0], "")


def test_a_driver_that_refuses_a_shader_names_its_file(gpu, monkeypatch, tmp_path, by_links) -> None:
    for file in programs.SHADERS.rglob("*.glsl"):
        copy = tmp_path / file.relative_to(programs.SHADERS)
        copy.parent.mkdir(exist_ok=True)
        text = file.read_text(encoding="utf-8")
        copy.write_text(text.replace("void main()", "void main(", 1) if file.stem == "view" else text, encoding="utf-8")
    monkeypatch.setattr(programs, "SHADERS", tmp_path)
    assert_by_links(stories.play(STORY, ASKED["plane"], [0])[0], by_links[0], "shaders/view.glsl")


def test_what_was_made_on_a_gpu_can_be_given_back_after_it_is_gone(gpu) -> None:
    """Sessions are closed in any order, also after a failure."""
    workers = Workers(1)
    made = Gathers(ASKED["plane"], workers)
    assert made._gpu is not None
    with made._gpu.current() as ctx:
        buffer = ctx.buffer(reserve=16)
    own = made._gpu
    made.close()
    own.release(buffer, None)
    made.close()
    workers.close()


def test_an_error_of_opengl_is_told_and_does_not_stay(gpu) -> None:
    """Whatever raises it: the next use finds a clean context."""
    with pytest.raises(GpuFailed, match="GL_INVALID_ENUM"), gpu.current() as ctx:
        ctx.enable_direct(0xFFFF)
    with gpu.current() as ctx:
        assert ctx.error == "GL_NO_ERROR"


def test_threads_take_their_turns(gpu) -> None:
    """A context is current on one thread at a time; values come back whole."""
    with gpu.current() as ctx:
        buffers = [ctx.buffer(np.full(1 << 14, n, np.int32).tobytes()) for n in range(8)]

    def read(rows: slice) -> bool:
        number = rows.start
        with gpu.current():
            values = np.frombuffer(buffers[number].read(), np.int32)
        return bool((values == number).all())

    workers = Workers(4)
    assert all(workers.map_slices(read, 8, 1))
    workers.close()
    gpu.release(*buffers)
