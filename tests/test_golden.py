"""Every built-in case through the real command line: the golden rows hold, and the gate can fail."""

import json
from pathlib import Path

import pytest

from avsreplay.rows import columns

CASES = sorted(p.stem for p in (Path(__file__).resolve().parents[1] / "fixtures").glob("*.toml"))


def test_there_are_cases():
    assert len(CASES) >= 2


@pytest.mark.parametrize("case", CASES)
def test_the_golden_rows_hold(case, cli, fixtures_folder):
    done = cli("run", fixtures_folder / f"{case}.mcap", "--golden", fixtures_folder / f"{case}.rows.jsonl")
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


def test_a_missing_golden_fails(cli, fixtures_folder, tmp_path):
    done = cli("run", fixtures_folder / "tumble.mcap", "--golden", tmp_path / "none.jsonl")
    assert done.code == 1
    assert "no such golden file" in done.err


def test_updating_is_a_visible_act_and_then_the_gate_passes(cli, fixtures_folder, tmp_path):
    golden = tmp_path / "new.jsonl"
    done = cli("run", fixtures_folder / "tumble.mcap", "--update-golden", golden)
    assert done.code == 0
    assert f"golden rows written: {golden}" in done.err
    assert golden.read_text() == (fixtures_folder / "tumble.rows.jsonl").read_text()
    assert set(json.loads(golden.read_text().splitlines()[0])) == {c.name for c in columns()}
