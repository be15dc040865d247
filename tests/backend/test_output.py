# SPDX-License-Identifier: GPL-3.0-or-later
"""The output folder without Blender: whole files, digests, resuming, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtgi_addon.backend.errors import BakeError
from rtgi_addon.backend.scene import Instance, World
from rtgi_addon.output import (
    BakeFolder,
    digest,
    folder_problems,
    map_bytes,
    map_name,
    read_record,
    whole_file,
    write_arrays,
    write_json,
)

HEADER = {
    "format": 1,
    "settings": {
        "resolution": 64,
        "quality": "draft",
        "threads": 1,
        "target_error": None,
    },
    "versions": {"rtgi": "0.1.0", "numpy": "1.26.4"},
    "fingerprint": {"geometry": "aa", "lamps": "bb"},
}


def commit(folder: BakeFolder, frame: int, *, state: str = "s", content: bytes = b"map") -> None:
    name = map_name("iim", 0, frame)
    (folder.path / name).write_bytes(content)
    folder.commit(frame, {"state": state, "files": [name], "rays": 7})


def test_map_names_follow_the_contract() -> None:
    assert map_name("iim", 0, 1) == "iim.p0.0001.exr"
    assert map_name("caustics", 12, 123456) == "caustics.p12.123456.exr"


def test_a_whole_file_replaces_the_old_one_only_on_success(tmp_path: Path) -> None:
    target = tmp_path / "maps.bin"
    target.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), whole_file(target) as part:
        part.write_bytes(b"half")
        assert target.read_bytes() == b"old"
        raise ZeroDivisionError
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]
    with whole_file(target) as part:
        assert part.parent == target.parent  # renaming across file systems would copy
        part.write_bytes(b"new")
    assert target.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [target]


def test_arrays_come_back_and_the_bytes_repeat(tmp_path: Path) -> None:
    arrays = {
        "position": np.arange(12, dtype=np.float64).reshape(4, 3) * 1e6,
        "page": np.array([0, 0, 1, 2], np.int32),
        "names": np.array(["Cube", "Würfel", ""]),
        "empty": np.zeros((0, 3), np.float32),
    }
    for name in ("a.npz", "b.npz"):
        write_arrays(tmp_path / name, arrays.items())
    with np.load(tmp_path / "a.npz", allow_pickle=False) as loaded:
        assert set(loaded.files) == set(arrays)
        for name, array in arrays.items():
            assert loaded[name].dtype == array.dtype
            np.testing.assert_array_equal(loaded[name], array)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_json_takes_numpy_and_refuses_what_json_cannot_say(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json",
        {"n": np.int64(3), "x": np.float32(0.5), "p": tmp_path, "v": np.arange(2)},
    )
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "n": 3,
        "x": 0.5,
        "p": str(tmp_path),
        "v": [0, 1],
    }
    with pytest.raises(ValueError):
        write_json(tmp_path / "b.json", {"x": float("nan")})
    assert not (tmp_path / "b.json").exists()


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


@given(plain, plain)
def test_digests_agree_exactly_where_values_do(a: object, b: object) -> None:
    assert (digest(a) == digest(b)) == (repr(a) == repr(b))  # repr tells 1 from 1.0 from True


def test_digests_see_every_bit_shape_and_type_of_an_array() -> None:
    base = np.arange(6, dtype=np.float32).reshape(2, 3)
    nudged = base.copy()
    nudged[1, 2] = np.nextafter(nudged[1, 2], 9, dtype=np.float32)
    others = [
        nudged,
        base.reshape(3, 2),
        base.astype(np.float64),
        base.view(np.int32),
        base.tolist(),
        None,
    ]
    assert len({digest(a) for a in (base, *others)}) == len(others) + 1
    assert digest(np.asfortranarray(base)) == digest(base)


def test_digests_reach_into_dataclasses() -> None:
    chair = Instance("Chair", 0, np.eye(4))
    assert digest(chair) == digest(Instance("Chair", 0, np.eye(4)))
    assert digest(chair) != digest(replace(chair, moving=True))
    assert digest(World(np.ones((1, 1, 3), np.float32))) != digest(World(np.zeros((1, 1, 3), np.float32)))
    with pytest.raises(TypeError):
        digest(object())


def test_bake_json_lists_a_frame_once_it_is_committed(tmp_path: Path) -> None:
    folder = BakeFolder(tmp_path / "new" / "out", HEADER)
    assert read_record(folder.path)["frames"] == {}  # type: ignore[index]
    commit(folder, 10)
    commit(folder, 2)
    record = read_record(folder.path)
    assert record is not None
    assert list(record["frames"]) == ["2", "10"]
    assert record["frames"]["10"] == {
        "state": "s",
        "files": {"iim.p0.0010.exr": 3},
        "rays": 7,
    }
    assert record["status"] == "running"
    folder.close("done")
    assert read_record(folder.path) == {**record, "status": "done"}


def test_resuming_keeps_what_is_whole_and_made_from_the_same_state(
    tmp_path: Path,
) -> None:
    first = BakeFolder(tmp_path, HEADER)
    for frame in (1, 2, 3, 4):
        commit(first, frame)
    half = [tmp_path / name for name in (".iim.p0.0005.exr.part", ".bake.json.part", ".probe.7.part")]
    theirs = [tmp_path / name for name in (".notes.part", "iim.part", ".iim.p0.0001.exr")]
    for path in (*half, *theirs):
        path.write_bytes(b"half a map")
    (tmp_path / map_name("iim", 0, 2)).unlink()
    (tmp_path / map_name("iim", 0, 3)).write_bytes(b"ma")
    again = BakeFolder(tmp_path, HEADER, resume=True)
    assert not any(path.exists() for path in half)
    assert all(path.exists() for path in theirs)
    assert again.finished_or_none(1, "s") == {
        "state": "s",
        "files": {"iim.p0.0001.exr": 3},
        "rays": 7,
    }
    assert again.finished_or_none(2, "s") is None  # a file is gone
    assert again.finished_or_none(3, "s") is None  # a file was cut short
    assert again.finished_or_none(4, "moved") is None  # the scene differs in this frame
    assert again.finished_or_none(5, "s") is None  # never made


def test_a_second_interruption_loses_no_frame(tmp_path: Path) -> None:
    first = BakeFolder(tmp_path, HEADER)
    commit(first, 1)
    commit(first, 2)
    BakeFolder(tmp_path, HEADER, resume=True)  # killed before its first frame
    third = BakeFolder(tmp_path, HEADER, resume=True)
    assert third.finished_or_none(2, "s") is not None


def test_without_resume_nothing_is_kept(tmp_path: Path) -> None:
    commit(BakeFolder(tmp_path, HEADER), 1)
    again = BakeFolder(tmp_path, HEADER)
    assert again.finished_or_none(1, "s") is None
    assert read_record(tmp_path)["frames"] == {}  # type: ignore[index]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"settings": {**HEADER["settings"], "quality": "final"}},
            "quality was draft, is final now",
        ),
        (
            {"versions": {**HEADER["versions"], "numpy": "2.3.0"}},
            "numpy was 1.26.4, is 2.3.0 now",
        ),
        (
            {"fingerprint": {**HEADER["fingerprint"], "lamps": "cc"}},
            "the lamps changed",
        ),
    ],
)
def test_another_bake_is_not_resumed_and_its_record_stays(tmp_path: Path, change: dict, said: str) -> None:
    commit(BakeFolder(tmp_path, HEADER), 1)
    before = (tmp_path / "bake.json").read_bytes()
    with pytest.raises(BakeError) as refused:
        BakeFolder(tmp_path, {**HEADER, **change}, resume=True)
    assert len(refused.value.problems) == 1
    assert said in refused.value.problems[0]
    assert "--resume" in refused.value.problems[0]
    assert (tmp_path / "bake.json").read_bytes() == before


def test_threads_do_not_hinder_resuming(tmp_path: Path) -> None:
    commit(BakeFolder(tmp_path, HEADER), 1)
    other = {**HEADER, "settings": {**HEADER["settings"], "threads": 8}}
    assert BakeFolder(tmp_path, other, resume=True).finished_or_none(1, "s") is not None


@pytest.mark.parametrize("content", ["{", "[]", '{"format": 99}', '{"frames": {}}'])
def test_a_bake_json_that_is_not_ours_is_refused_with_its_name(tmp_path: Path, content: str) -> None:
    (tmp_path / "bake.json").write_text(content)
    with pytest.raises(BakeError, match=r"bake\.json"):
        BakeFolder(tmp_path, HEADER, resume=True)
    assert (tmp_path / "bake.json").read_text() == content


def test_folder_problems_are_found_without_leaving_anything(tmp_path: Path) -> None:
    assert folder_problems(tmp_path / "a" / "b", 1000) == []
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("x")
    (problem,) = folder_problems(tmp_path / "file" / "out")
    assert str(tmp_path / "file") in problem
    (problem,) = folder_problems(tmp_path, 2**62)
    assert "MiB needed" in problem
    (problem,) = folder_problems(Path("/proc/rtgi"))
    assert "cannot write here" in problem


def test_map_bytes_grow_with_all_that_multiplies_files() -> None:
    one = map_bytes(frames=1, resolution=64, pages=1, kinds=1)
    assert 0 < one <= np.zeros((64, 64, 4), np.float32).nbytes
    assert map_bytes(frames=3, resolution=128, pages=2, kinds=2) == 3 * 4 * 2 * 2 * one
