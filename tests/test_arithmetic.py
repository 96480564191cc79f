"""The variants of arithmetic that libraries choose by the processor are pinned before they are
loaded.
"""

import json
import os
import subprocess
import sys

import pytest

from avsreplay import arithmetic

needs_variants = pytest.mark.skipif(
    not arithmetic.has_variants(), reason="only glibc on x86-64 has these variants"
)
OTHER = {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4", "GLIBC_TUNABLES": ""}


@needs_variants
def test_emulated_processors_give_the_same_bytes(cli, fixtures_folder, tmp_path):
    """Without the pin, more than 2,000 cells of these rows differ between two kernels of
    OpenBLAS.
    """
    log, rows = fixtures_folder / "spin-raster.mcap", []
    for number, variables in enumerate(({"OPENBLAS_CORETYPE": "Prescott"}, OTHER)):
        assert (
            cli("run", log, "-o", tmp_path / f"{number}", "--n-scans", "12", env=variables).code
            == 0
        )
        rows.append((tmp_path / f"{number}" / "rows.jsonl").read_bytes())
        assert (
            json.loads((tmp_path / f"{number}" / "run.json").read_bytes())["arithmetic"] == "pinned"
        )
    assert rows[0] == rows[1]


def test_the_record_of_a_run_states_that_the_arithmetic_is_native(cli, fixtures_folder, tmp_path):
    log, env = fixtures_folder / "spin-raster.mcap", {arithmetic.VARIABLE: "native"}
    assert cli("run", log, "-o", tmp_path / "r", "--n-scans", "2", env=env).code == 0
    assert json.loads((tmp_path / "r" / "run.json").read_bytes())["arithmetic"] == "native"


def test_an_unknown_choice_is_one_line(cli):
    done = cli("backends", env={arithmetic.VARIABLE: "fast"})
    assert done.code == 2
    assert (
        done.err
        == f"avsreplay: environment {arithmetic.VARIABLE}: 'fast' is unknown; use pinned or"
        " native\n"
    )


SCRIPT = """
import os, sys
print("start", flush=True)
{before}
from avsreplay import arithmetic
arithmetic.pin()
import numpy
print(arithmetic.state(), os.environ.get("GLIBC_TUNABLES", ""))
"""


def pinned_script(before: str, **variables: str) -> list[str]:
    """Lines printed by a script that pins the arithmetic."""
    env = {k: v for k, v in os.environ.items() if k not in arithmetic.PINS} | variables
    script = [sys.executable, "-c", SCRIPT.format(before=before)]
    return subprocess.run(
        script, env=env, capture_output=True, text=True, check=True, timeout=60
    ).stdout.splitlines()


@needs_variants
def test_a_script_is_not_started_again_and_states_what_holds():
    tunables = "glibc.malloc.check=0:glibc.cpu.hwcaps=-AVX512F"
    lines = pinned_script("", GLIBC_TUNABLES=tunables)
    assert lines[0] == "start"
    assert lines[1] == f"native glibc.malloc.check=0:{arithmetic.PINS['GLIBC_TUNABLES']}"
    started = pinned_script("", **arithmetic.PINS)
    assert started == ["start", f"pinned {arithmetic.PINS['GLIBC_TUNABLES']}"]


def test_numpy_that_has_been_imported_keeps_its_variants():
    assert pinned_script("import numpy") == ["start", "native "]


@pytest.mark.parametrize("start", ["-", "/dev/stdin"])
def test_a_script_from_standard_input_runs_once(start):
    script = "import avsreplay; avsreplay.arithmetic.pin(); print('hello')"
    done = subprocess.run(
        [sys.executable, "-W", "error", start], input=script, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "hello\n", "")


def test_the_command_that_a_script_from_standard_input_calls_runs_once():
    script = (
        "import sys; from avsreplay.__main__ import main; sys.argv = ['-', '--version']; main()"
    )
    done = subprocess.run([sys.executable, "-"], input=script, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("avsreplay ")


API = """
import sys
import avsreplay
avsreplay.arithmetic.pin()
from avsreplay.report.jsonl import dump_row
for row in avsreplay.replay(sys.argv[1], n_scans=12):
    print(dump_row(row))
"""


@needs_variants
def test_a_script_that_pins_its_arithmetic_has_the_rows_of_the_command_on_any_processor(
    cli, fixtures_folder, tmp_path
):
    log, script = fixtures_folder / "spin-raster.mcap", tmp_path / "script.py"
    script.write_text(API)
    assert cli("run", log, "-o", tmp_path / "r", "--n-scans", "12").code == 0
    rows = (tmp_path / "r" / "rows.jsonl").read_text(encoding="utf-8")
    for variables in ({"OPENBLAS_CORETYPE": "Prescott"}, OTHER):
        env = {**os.environ, **variables, "GLIBC_TUNABLES": arithmetic.PINS["GLIBC_TUNABLES"]}
        done = subprocess.run(
            [sys.executable, script, log], env=env, capture_output=True, text=True, check=True
        )
        assert done.stdout == rows
