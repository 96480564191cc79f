"""Every built-in case through the command line: the golden rows are reproduced, and the
comparison can fail.
"""

import json
from pathlib import Path

import pytest

from avsreplay.report.golden import compare_golden
from avsreplay.report.jsonl import read_rows
from avsreplay.rows import columns

CASES = sorted(p.stem for p in (Path(__file__).resolve().parents[1] / "fixtures").glob("*.toml"))


def test_there_are_cases():
    assert len(CASES) >= 2


@pytest.mark.parametrize("case", CASES)
def test_the_golden_rows_hold(case, cli, fixtures_folder):
    done = cli(
        "run", fixtures_folder / f"{case}.mcap", "--golden", fixtures_folder / f"{case}.rows.jsonl"
    )
    assert done.code == 0, done.out + done.err
    assert "golden rows agree" in done.err


def tampered(path, target, change):
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    rows = change(rows) or rows
    target.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return target


def grow_pose_error(rows):
    rows[5]["pos_err_m"] *= 1.1


def flip_gamma(rows):
    rows[7]["gamma"] = 1 - rows[7]["gamma"]


def lose_a_row(rows):
    return rows[:-1]


def lose_a_column(rows):
    for row in rows:
        del row["nis"]


def add_a_row(rows):
    return [*rows, {**rows[-1], "seq": rows[-1]["seq"] + 1}]


@pytest.mark.parametrize(
    ("change", "column"),
    [
        (grow_pose_error, "pos_err_m"),
        (flip_gamma, "gamma"),
        (lose_a_row, "row"),
        (lose_a_column, "nis"),
        (add_a_row, "row"),
    ],
)
def test_a_difference_fails_and_is_shown(change, column, cli, fixtures_folder, tmp_path):
    golden = tampered(fixtures_folder / "tumble.rows.jsonl", tmp_path / "g.jsonl", change)
    done = cli("run", fixtures_folder / "tumble.mcap", "--golden", golden)
    assert done.code == 1
    assert column in done.out
    assert "differences from the golden rows" in done.err
    assert "Traceback" not in done.err


def test_a_missing_golden_is_named_before_the_replay(cli, fixtures_folder, tmp_path):
    done = cli("run", fixtures_folder / "tumble.mcap", "--golden", tmp_path / "none.jsonl")
    assert (done.code, done.out) == (3, "")
    assert "no such golden file" in done.err


def test_an_update_writes_the_rows_of_this_machine_and_the_committed_rows_hold_for_them(
    cli, fixtures_folder, tmp_path
):
    """Bytes are compared with a second run on the same machine; with the committed file, the golden
    tolerances hold.

    Another processor or BLAS build may change the last digits (relative differences of 2e-11 were
    measured).
    """
    log, golden = fixtures_folder / "tumble.mcap", tmp_path / "new.jsonl"
    done = cli("run", log, "--update-golden", golden)
    assert done.code == 0
    assert f"golden rows written: {golden}" in done.err
    assert cli("run", log, "-o", tmp_path / "again").code == 0
    assert golden.read_bytes() == (tmp_path / "again" / "rows.jsonl").read_bytes()
    found = compare_golden(fixtures_folder / "tumble.rows.jsonl", read_rows(golden))
    assert found.count == 0, found.differences
    assert set(json.loads(golden.read_text().splitlines()[0])) == {c.name for c in columns()}
