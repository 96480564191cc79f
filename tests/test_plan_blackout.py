"""The table of docs/planning.md about blackouts is what its command prints."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


@pytest.mark.slow
def test_the_blackout_table_is_current():
    """Actions and times as printed; errors to a millimetre, because they depend on the processor's rounding."""
    made = runpy.run_path(str(ROOT / "tests" / "benchmarks" / "plan_blackout.py"))["table"]()
    page = (ROOT / "docs" / "planning.md").read_text(encoding="utf-8").splitlines()
    first = page.index("| occlusion from | actions | closed at | miss | relative speed | angle |") + 2
    for line, printed in zip(made, page[first : first + len(made)], strict=True):
        got, expected = cells(line), cells(printed)
        assert got[:3] == expected[:3]
        assert float(got[3].split()[0]) == pytest.approx(float(expected[3].split()[0]), abs=1.0)
