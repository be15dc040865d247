# SPDX-License-Identifier: GPL-3.0-or-later
"""The one place where an OpenGL context is made: headless, of our own, never Blender's.

Everything that uses it does so inside ``with gpu.current():``, which gives the thread back the context it had and turns
every way in which OpenGL fails into :class:`GpuFailed`; whoever asked then goes on without a GPU.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

#: OpenGL 3.3 core: the least that rasters need, and all that macOS draws with.
LEAST_VERSION = 330
#: OpenGL 4.3: compute shaders and storage buffers.
COMPUTE_VERSION = 430
#: What names of renderers that draw on the CPU hold.
SOFTWARE_NAMES = ("llvmpipe", "softpipe", "swr", "swiftshader", "software", "gdi generic", "basic render")


class GpuUnavailable(Exception):
    """There is no OpenGL that serves here. Its text is one line: why."""


class GpuFailed(Exception):
    """OpenGL was there and failed: out of memory, a lost context, a driver's refusal. Its text is one line."""


@dataclass(frozen=True)
class GpuInfo:
    """What the device says of itself."""

    renderer: str
    version: str  # OpenGL's, as the driver words it
    version_code: int  # 330 for 3.3
    software: bool  # draws on the CPU
    max_texture: int  # longest side of a texture, pixels
    max_layers: int  # of an array texture
    max_uniform_block: int  # bytes
    max_storage: int  # bytes of one storage buffer, 0 without compute

    @property
    def computes(self) -> bool:
        """Are there compute shaders?"""
        return self.version_code >= COMPUTE_VERSION


@dataclass
class Gpu:
    """An open context. Close it to give its memory back; what was made with it goes with it."""

    ctx: Any  # moderngl.Context
    info: GpuInfo
    nowhere: Any  # a framebuffer of one pixel: without a window OpenGL runs nothing until one is in use
    programs: dict[Any, Any] = field(default_factory=dict, repr=False)  # compiled, see ``programs``
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False)  # one thread at a time
    _depth: int = 0

    @contextmanager
    def current(self) -> Iterator[Any]:
        """The context, this thread's alone and current on it meanwhile; may be used inside itself.

        Raises GpuFailed when OpenGL fails inside, however it does.
        """
        import moderngl

        with self._lock:
            if self.ctx is None:
                raise GpuFailed(f"{self.info.renderer}: its context is closed")
            if self._depth:  # entered again it would forget which context the thread had
                yield self.ctx
                return
            self._depth += 1
            try:
                with self.ctx:
                    yield self.ctx
                    fault = self.ctx.error
            except moderngl.Error as error:
                raise GpuFailed(f"{self.info.renderer}: {_one_line(error)}") from error
            finally:
                self._depth -= 1
        if fault != "GL_NO_ERROR":
            raise GpuFailed(f"{self.info.renderer}: OpenGL reports {fault}")

    def release(self, *things: Any) -> None:
        """Give the memory of ``things`` (None: nothing) back; after a failure that may fail, too, and is let be."""
        if self.ctx is None:
            return
        with suppress(GpuFailed), self.current():
            self.nowhere.use()  # ModernGL goes back to the framebuffer used last, and must not find it gone
            for thing in things:
                if thing is not None:
                    thing.release()

    def close(self) -> None:
        """Give everything back. A second call does nothing."""
        ctx, self.ctx = self.ctx, None
        self.programs.clear()
        if ctx is not None:
            with suppress(Exception):  # a lost context cannot be told from one that is
                ctx.release()


def open_gpu(*, least: int = LEAST_VERSION) -> Gpu:
    """A headless context of OpenGL ``least`` (330 for 3.3 core) or later.

    Raises GpuUnavailable where there is no ModernGL, no driver, or too old a one.
    """
    try:
        import moderngl
    except ImportError as fault:
        raise GpuUnavailable(f"ModernGL is not installed ({_one_line(fault)})") from fault
    backend: dict[str, Any] = {"backend": "egl"} if sys.platform.startswith("linux") else {}
    try:
        ctx: Any = moderngl.create_context(standalone=True, require=least, **backend)
    except Exception as fault:  # glcontext raises whatever the driver's loader does
        raise GpuUnavailable(f"no OpenGL {least // 100}.{least // 10 % 10}: {_one_line(fault)}") from fault
    with ctx:
        return Gpu(ctx, _info(ctx), ctx.simple_framebuffer((1, 1)))


def _info(ctx: Any) -> GpuInfo:
    info = ctx.info
    renderer = str(info["GL_RENDERER"])
    return GpuInfo(
        renderer=renderer,
        version=str(info["GL_VERSION"]),
        version_code=int(ctx.version_code),
        software=any(name in renderer.lower() for name in SOFTWARE_NAMES),
        max_texture=int(info["GL_MAX_TEXTURE_SIZE"]),
        max_layers=int(info["GL_MAX_ARRAY_TEXTURE_LAYERS"]),
        max_uniform_block=int(info["GL_MAX_UNIFORM_BLOCK_SIZE"]),
        max_storage=int(info.get("GL_MAX_SHADER_STORAGE_BLOCK_SIZE", 0)) if ctx.version_code >= COMPUTE_VERSION else 0,
    )


def _one_line(fault: BaseException) -> str:
    return " ".join(str(fault).split()) or type(fault).__name__
