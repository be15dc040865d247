# SPDX-License-Identifier: GPL-3.0-or-later
"""EXR pages: bit-exact, deterministic, whole or not at all."""

from __future__ import annotations

import resource
import signal
import time

import bpy
import numpy as np
import pytest

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.exr import read_page, write_page


def page(height: int = 24, width: int = 40, seed: int = 1):
    rng = np.random.default_rng(seed)
    rgb = (rng.random((height, width, 3)) * 10 ** rng.uniform(-8, 8, (height, width, 3))).astype(np.float32)
    rgb[0, 0] = [1e6, 1e-30, 1e-42]  # large, tiny, subnormal
    rgb[0, 1] = [3e38, 0.0, 70000.0]  # beyond half floats
    rgb[0, 2] = [0.5, 1.0, 1.5]  # an sRGB curve would move the first and last
    return rgb, rng.random((height, width)) < 0.5


def test_round_trip_is_bit_exact(tmp_path):
    rgb, valid = page()
    write_page(tmp_path / "iim.p0.0001.exr", rgb, valid)
    rgb_read, valid_read = read_page(tmp_path / "iim.p0.0001.exr")
    np.testing.assert_array_equal(rgb_read.view(np.uint32), rgb.view(np.uint32))
    np.testing.assert_array_equal(valid_read, valid)
    assert [p.name for p in tmp_path.iterdir()] == ["iim.p0.0001.exr"]


def test_same_pixels_give_the_same_bytes(tmp_path):
    rgb, valid = page()
    write_page(tmp_path / "a.exr", rgb, valid)
    time.sleep(1.1)  # a date in the header would have the resolution of a second
    write_page(tmp_path / "b.exr", rgb, valid)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_header_says_float_rgba_and_row_0_is_the_bottom(tmp_path):
    rgb = np.zeros((4, 6, 3), np.float32)
    rgb[0] = 2.0  # the bottom row
    write_page(tmp_path / "a.exr", rgb, np.ones((4, 6), np.bool_))
    data = (tmp_path / "a.exr").read_bytes()
    assert data[:4] == bytes.fromhex("762f3101")  # the magic number of OpenEXR
    channels = data[data.index(b"chlist\0") + 11 :]  # after the type name and the size
    for name in b"ABGR":  # name, zero, pixel type 2 = 32-bit float
        assert channels[:6] == bytes([name, 0, 2, 0, 0, 0])
        channels = channels[18:]
    image = bpy.data.images.load(str(tmp_path / "a.exr"))
    image.colorspace_settings.name = "Non-Color"
    assert tuple(image.size) == (6, 4)
    assert np.array(image.pixels[:]).reshape(4, 6, 4)[:, :, 0].tolist() == [[2.0] * 6] + [[0.0] * 6] * 3


def test_nothing_is_left_in_the_file(tmp_path):
    before = [len(getattr(bpy.data, kind)) for kind in ("images", "scenes", "worlds", "collections")]
    rgb, valid = page()
    write_page(tmp_path / "a.exr", rgb, valid)
    read_page(tmp_path / "a.exr")
    assert [len(getattr(bpy.data, kind)) for kind in ("images", "scenes", "worlds", "collections")] == before


def test_full_disk_keeps_the_old_file_and_leaves_no_part(tmp_path):
    rgb, valid = page()
    path = tmp_path / "iim.p0.0001.exr"
    write_page(path, rgb, valid)
    old = path.read_bytes()
    limit, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, limit[1]))  # a disk with room for 500 bytes
    try:
        with pytest.raises(BakeError, match=r"iim\.p0\.0001\.exr: cannot be written"):
            write_page(path, *page(seed=2))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_folder_that_is_not_there_is_named_and_not_made(tmp_path):
    with pytest.raises(BakeError, match="folder does not exist"):
        write_page(tmp_path / "no" / "a.exr", *page())
    assert not (tmp_path / "no").exists()


def test_a_broken_file_is_an_error_of_the_user(tmp_path):
    rgb, valid = page()
    write_page(tmp_path / "a.exr", rgb, valid)
    (tmp_path / "a.exr").write_bytes(b"no picture")
    with pytest.raises(BakeError, match=r"a\.exr"):
        read_page(tmp_path / "a.exr")
    with pytest.raises(BakeError, match=r"b\.exr"):
        read_page(tmp_path / "b.exr")


def test_shapes_are_checked(tmp_path):
    with pytest.raises(ValueError, match=r"\(4, 4, 3\)"):
        write_page(tmp_path / "a.exr", np.zeros((4, 4, 3), np.float32), np.zeros((4, 5), np.bool_))
