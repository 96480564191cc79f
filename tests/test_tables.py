"""Tables hold what was put into them, in any number of blocks, and take the memory of one block."""

from __future__ import annotations

import dataclasses
import random
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avsreplay import spool
from avsreplay.geometry import Pose
from avsreplay.report.jsonl import dump_row
from avsreplay.report.view import CloudTable, CloudView
from avsreplay.result_dir import BeliefTable, read_beliefs
from avsreplay.rows import Row, field_types
from avsreplay.spool import Spool, write_npz
from avsreplay.tables import PoseTable, RowTable, chosen, column_of, numbers

VALUES = {
    float: st.floats(allow_infinity=False, allow_nan=False),
    int: st.integers(-(2**63), 2**63 - 1),
    str: st.text(max_size=5),
    bool: st.booleans(),
}


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of about three rows, so that a few rows fill several of them."""
    monkeypatch.setattr(spool, "SPOOL_BLOCK_BYTES", 4000)


def random_row(rng: random.Random) -> Row:
    def value(kind: type, nullable: bool):
        if nullable and rng.random() < 0.4:
            return None
        return {
            float: rng.choice([0.0, -0.0, 1e-300, rng.gauss(0.0, 1e6)]),
            int: rng.choice([0, -(2**63), 2**63 - 1, 7]),
            str: rng.choice(["", "ok", "a longer text", "ß"]),
            bool: rng.random() < 0.5,
        }[kind]

    return Row(**{name: value(*kind) for name, kind in field_types().items()})


def test_rows_come_back_with_the_same_bytes(small_blocks):
    rng = random.Random(1)
    rows = [random_row(rng) for _ in range(20)]
    table = RowTable(rows)
    assert list(map(dump_row, table)) == list(map(dump_row, rows))
    assert [table[k] for k in range(-20, 20)] == [rows[k] for k in range(-20, 20)]
    assert table == rows
    assert table[3:15:4] == rows[3:15:4]
    table[2] = table[19] = rows[5]
    assert (table[2], table[19], table[18]) == (rows[5], rows[5], rows[18])
    with pytest.raises(IndexError):
        table[20]


def test_columns_are_those_of_the_rows(small_blocks):
    rng = random.Random(2)
    rows = [random_row(rng) for _ in range(20)]
    table = RowTable(rows)
    flags = np.array([rng.random() < 0.5 for _ in rows])
    some = [row for row, flag in zip(rows, flags, strict=True) if flag]
    for name, (kind, _) in field_types().items():
        for found, expected in ((table, rows), (chosen(table, flags), some)):
            assert column_of(found, name) == column_of(expected, name)
            if kind is not str:
                assert np.array_equal(numbers(found, name), numbers(expected, name), equal_nan=True)


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_a_row_of_any_values_survives(data):
    row = Row(
        **{
            name: data.draw(VALUES[kind] | st.none() if nullable else VALUES[kind])
            for name, (kind, nullable) in list(field_types().items())
        }
    )
    assert RowTable([row])[0] == row


def test_an_archive_has_the_bytes_of_numpy(tmp_path, small_blocks):
    rng = np.random.default_rng(3)
    arrays = {"a": rng.random((700, 2, 3)), "b": rng.integers(0, 9, 5), "c": np.zeros((0, 3), "f4")}
    spools = {}
    for name, array in arrays.items():
        spools[name] = Spool(array.dtype, array.shape[1:])
        for part in np.array_split(array, 7):
            spools[name].extend(part)
    write_npz(tmp_path / "own.npz", spools)
    np.savez(tmp_path / "numpy.npz", **arrays)
    assert (tmp_path / "own.npz").read_bytes() == (tmp_path / "numpy.npz").read_bytes()


def test_a_spool_is_an_array(small_blocks):
    rng, own, array = np.random.default_rng(4), Spool("f8", (7,)), np.zeros((0, 7))
    for _ in range(60):
        if len(array) and rng.random() < 0.3:
            at, record = int(rng.integers(len(array))), rng.random(7)
            own[at] = array[at] = record
        else:
            more = rng.random((int(rng.integers(40)), 7))
            own.extend(more)
            array = np.concatenate([array, more])
        first, last = sorted(rng.integers(0, len(array) + 1, 2).tolist())
        assert np.array_equal(own.read(first, last), array[first:last])
    assert np.array_equal(np.concatenate(list(own.blocks())), array)


def test_the_memory_of_a_table_is_that_of_a_block():
    row = dataclasses.replace(random_row(random.Random(5)), status="ok")
    table, peaks = RowTable(), []
    tracemalloc.start()
    try:
        for _ in range(2):
            table.extend(row for _ in range(2000))
            tracemalloc.reset_peak()
            assert numbers(table, "seq").sum() == row.seq * len(table)
            peaks.append(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()
    assert peaks[0] < 4 * spool.SPOOL_BLOCK_BYTES
    assert peaks[1] - peaks[0] < spool.SPOOL_BLOCK_BYTES / 4


def test_poses_and_clouds_come_back(small_blocks):
    rng = np.random.default_rng(6)
    poses = [(int(k), Pose(rng.normal(size=4), rng.normal(size=3))) for k in range(200)]
    table, again = PoseTable(), PoseTable()
    for t_ns, pose in poses:
        table.append(t_ns, pose)
    again.extend(*table.arrays())
    for (t_ns, pose), (found_ns, found) in zip(poses, again, strict=True):
        assert t_ns == found_ns
        assert pose.q.tobytes() + pose.t.tobytes() == found.q.tobytes() + found.t.tobytes()
    sizes = [3, 0, 500, 1]
    clouds = [
        CloudView(k, rng.random((n, 3)).astype("f4"), None if k == 2 else rng.random(n, "f4"))
        for k, n in enumerate(sizes)
    ]
    for cloud, found in zip(clouds, CloudTable(clouds), strict=True):
        assert (cloud.seq, len(cloud.points)) == (found.seq, len(found.points))
        assert np.array_equal(cloud.points, found.points)
        assert found.intensity is None
        assert (found.residual_m is None) == (cloud.seq in (1, 2))


def test_a_full_temporary_folder_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setattr(spool.tempfile, "tempdir", str(tmp_path / "missing"))
    table = Spool("f8", (1000,))
    with pytest.raises(spool.UnreadableInput, match="TMPDIR"):
        table.extend(np.zeros((1000, 1000)))


def test_beliefs_of_a_file_are_those_written(tmp_path, small_blocks):
    table = BeliefTable()
    table.write(tmp_path / "beliefs.npz")
    assert len(read_beliefs(tmp_path / "beliefs.npz")) == 0
