# SPDX-License-Identifier: GPL-3.0-or-later
"""One OpenGL context for all tests here; without any, they skip and say why."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rtgi_addon.backend.gpu.context import Gpu, GpuUnavailable, open_gpu


@pytest.fixture(scope="session")
def shared_gpu() -> Iterator[Gpu]:
    try:
        gpu = open_gpu()
    except GpuUnavailable as fault:
        pytest.skip(str(fault))
    yield gpu
    gpu.close()


@pytest.fixture
def gpu(shared_gpu: Gpu) -> Iterator[Gpu]:
    """The context; a test that leaves an OpenGL error behind fails."""
    yield shared_gpu
    with shared_gpu.current() as ctx:
        assert ctx.error == "GL_NO_ERROR"


@pytest.fixture
def compute_gpu(gpu: Gpu) -> Gpu:
    """The same where it has compute shaders."""
    if not gpu.info.computes:
        pytest.skip(f"{gpu.info.renderer}: OpenGL {gpu.info.version} has no compute shaders")
    return gpu
