"""The journal of a campaign: damaged lines are set aside and their runs repeated; everything
else is kept.
"""

import math
import os
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from avsreplay.errors import UnreadableInput, UsageError
from avsreplay.sweep.campaign import SCAN_COLUMNS, RunResult
from avsreplay.sweep.journal import RESULTS, Journal

pytest.importorskip("pyarrow", reason="pyarrow is not installed")
SCAN = (0, None, True, 1, 0.5, 0.1, 0.9, None, 20.0, 0.01, 1.0)


def result(k, status="ok", scans=2):
    metrics = {"a.b_m": 0.1 * k, "none": None, "nan": math.inf}
    return RunResult(f"{k:024x}", status, None, metrics, (SCAN,) * scans, ((k, "empty"),))


def filled(folder, count=3, scans=2):
    with Journal(folder) as journal:
        for k in range(count):
            journal.add(result(k, scans=scans))
    return folder / "journal.txt"


def same(a, b):
    return (a.id, a.status, a.error, a.metrics, a.episodes) == (
        b.id,
        b.status,
        b.error,
        b.metrics,
        b.episodes,
    )


def test_results_are_read_back(tmp_path):
    assert len(SCAN) == len(SCAN_COLUMNS)
    with Journal(tmp_path / "d") as journal:
        for k in (3, 1, 2, 1):
            journal.add(result(k))
    again = Journal(tmp_path / "d")
    assert [run_id[-1] for run_id in again.status] == ["3", "1", "2"]
    assert same(again.result(result(2).id), result(2))
    assert again.result(result(2).id).scan_count == 2
    assert again.scans(result(2).id) == [SCAN, SCAN]
    assert result(1).id in again


def test_a_line_cut_off_anywhere_is_removed_and_its_run_made_again(tmp_path):
    path = filled(tmp_path, scans=0)
    whole = path.read_bytes()
    lines = whole.splitlines(keepends=True)
    for cut in range(len(lines[0]) + len(lines[1]), len(whole)):
        path.write_bytes(whole[:cut])
        with Journal(tmp_path) as journal:
            assert len(journal.status) == 2
            assert journal.damaged == []
            journal.add(result(2, scans=0))
        assert path.read_bytes() == whole


def test_what_another_process_has_written_before_the_lock_is_read(tmp_path):
    late = Journal(tmp_path)
    with Journal(tmp_path) as journal:
        journal.add(result(1))
        journal.add(result(2))
    with late:
        late.add(result(3))
    for found in (late, Journal(tmp_path)):
        assert all(same(found.result(result(k).id), result(k)) for k in (1, 2, 3))
    assert not late.damaged


@pytest.mark.parametrize("name", RESULTS)
def test_a_folder_of_other_results_is_left_alone(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(UsageError, match="but no journal"):
        Journal(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_one_changed_byte_costs_at_most_the_two_runs_that_it_touches(tmp_path):
    """Each fifth byte and each line end of a journal of 4 runs; a changed line end joins two
    lines.
    """
    path = filled(tmp_path, count=4, scans=0)
    whole = path.read_bytes()
    ids = [line.split(b" ")[1].decode() for line in whole.splitlines()]
    line_ends = [k for k, byte in enumerate(whole) if byte == 10]
    for place in sorted({*range(0, len(whole), 5), *line_ends}):
        data = bytearray(whole)
        data[place] ^= 1
        path.write_bytes(bytes(data))
        (tmp_path / "journal.damaged").unlink(missing_ok=True)
        touched = whole[:place].count(b"\n")
        allowed = (
            {ids[touched], ids[min(touched + 1, 3)]}
            if whole[place : place + 1] == b"\n"
            else {ids[touched]}
        )
        with Journal(tmp_path) as journal:
            lost = set(ids) - set(journal.status)
            assert lost <= allowed
            assert lost
            for k, run_id in enumerate(ids):
                if run_id in lost:
                    journal.add(result(k, scans=0))
        assert sorted(path.read_bytes().splitlines()) == sorted(whole.splitlines())
        assert all(
            same(Journal(tmp_path).result(run_id), result(k)) for k, run_id in enumerate(ids)
        )


def test_a_damaged_line_is_set_aside(tmp_path):
    path = filled(tmp_path)
    lines = path.read_bytes().splitlines(keepends=True)
    bad = lines[1].replace(b"ok", b"OK")
    path.write_bytes(lines[0] + bad + lines[2])
    with Journal(tmp_path) as journal:
        assert journal.damaged == [bad]
        assert list(journal.status) == [result(0).id, result(2).id]
        assert same(journal.result(result(2).id), result(2))
    assert (tmp_path / "journal.damaged").read_bytes() == bad
    assert path.read_bytes() == lines[0] + lines[2]


@given(st.binary(max_size=300))
def test_any_bytes_are_a_journal_without_a_traceback(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / "journal.txt").write_bytes(data)
    with Journal(folder) as journal:
        assert journal.status == {}
        journal.add(result(1, scans=0))
    assert list(Journal(folder).status) == [result(1).id]


@pytest.mark.parametrize("damage", ["missing", "cut", "flipped", "other", "name", "columns"])
def test_damaged_scans_are_found_and_their_run_is_made_again(tmp_path, damage):
    filled(tmp_path)
    part = tmp_path / "scans" / "00" / f"{result(1).id}.parquet"
    data = part.read_bytes()
    other = tmp_path / "scans" / "00" / f"{result(2).id}.parquet"
    if damage == "missing":
        part.unlink()
    elif damage == "other":
        with Journal(tmp_path / "x") as journal:
            journal.add(result(1, scans=3))
        part.write_bytes((tmp_path / "x" / "scans" / "00" / part.name).read_bytes())
    elif damage == "name":  # of a column, which is then not UTF-8
        assert b"gamma" in data
        part.write_bytes(data.replace(b"gamma", b"\xffamma"))
    elif damage == "columns":
        parquet = pytest.importorskip("pyarrow.parquet")
        table = parquet.read_table(part)
        parquet.write_table(table.rename_columns([*table.column_names[:-1], "another"]), part)
    else:
        flipped = bytes([*data[:40], data[40] ^ 1, *data[41:]])
        part.write_bytes(data[:-5] if damage == "cut" else flipped)
    with Journal(tmp_path) as journal:
        assert journal.check_scans() == 1
        assert result(1).id not in journal
        journal.add(result(1))
        assert journal.check_scans() == 0
        assert journal.scans(result(1).id) == [SCAN, SCAN]
    assert other.exists()


def test_two_campaigns_cannot_use_one_directory(tmp_path):
    with Journal(tmp_path):
        with (
            pytest.raises(UsageError, match=f"in use by process {os.getpid()} on ") as caught,
            Journal(tmp_path),
        ):
            pass
        assert "\n" not in str(caught.value)
    with Journal(tmp_path) as journal:
        journal.add(result(1))


@pytest.mark.slow
def test_the_lock_of_a_killed_process_is_free(tmp_path):
    code = "import os\nfrom pathlib import Path\nfrom avsreplay.sweep.journal import Journal\n"
    code += f"Journal(Path({str(tmp_path)!r})).__enter__()\nos.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    with Journal(tmp_path) as journal:
        journal.add(result(1))


def test_failed_runs_can_be_forgotten(tmp_path):
    with Journal(tmp_path) as journal:
        for k, status in ((1, "ok"), (2, "failed"), (3, "lossy")):
            journal.add(result(k, status))
        journal.forget(("failed",))
        assert [run_id[-1] for run_id in journal.status] == ["1", "3"]
    assert len(Journal(tmp_path).status) == 2
    assert same(Journal(tmp_path).result(result(3).id), result(3, "lossy"))


def test_a_directory_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(UnreadableInput), Journal(tmp_path / "file"):
        pass


def interrupted(folder, *finished):
    """A journal whose command is interrupted after these runs."""
    with Journal(folder) as journal:
        for each in finished:
            journal.add(each)
        raise KeyboardInterrupt


@pytest.mark.parametrize("there", [False, True])
def test_an_error_before_the_first_run_leaves_nothing(there, tmp_path):
    folder = tmp_path / "a" / "b"
    if there:
        folder.mkdir(parents=True)
        (folder / "note.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(KeyboardInterrupt):
        interrupted(folder)
    assert sorted(tmp_path.rglob("*")) == before
    for finished in ([result(1)], []):
        with pytest.raises(KeyboardInterrupt):
            interrupted(folder, *finished)
        assert list(Journal(folder).status) == [result(1).id]
