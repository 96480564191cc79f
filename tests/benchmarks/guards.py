"""Whether the tests of docs/reliability.md fail without the code that they test: ``python tests/benchmarks/guards.py``.

The tests named here must pass in a copy of the checkout. Then, for each guard, its text is replaced there, and its test
must fail. Prints one line per guard; exit code 1 if a test passes without its guard.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 60  # for one test
# (file, text, replacement, tests that must fail)
GUARDS: tuple[tuple[str, str, str, str], ...] = (
    ("log/header.py", "if np.abs(vertices).max() > MAX_COORDINATE_M:", "if False:",
     "test_log_scan_files.py::test_a_model_with_a_vertex_that_is_too_far_away_is_rejected"),
    ("register/surface_index.py", "if largest > LARGEST_M:", "if False:",
     "test_register_surface_index.py::test_a_stray_vertex_is_named_as_too_large"),
    ("files.py", "return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode) or stat.S_ISBLK(mode)", "return False",
     "test_files.py::test_a_fifo_receives_the_output"),
    ("files.py", "    place = path.resolve()\n    try:\n        if is_stream(place)",
     "    place = path\n    try:\n        if is_stream(place)",
     "test_files.py::test_a_symbolic_link_is_followed_and_never_replaced"),
    ("files.py", 'if not path.name or path.name == ".." or b"\\0" in name:', "if False:",
     "test_files.py::test_names_that_cannot_be_written_are_refused_before_any_work"),
    ("files.py", "if there is not None and stat.S_ISDIR(there) != folder:", "if False:",
     "test_files.py::test_folders_that_cannot_be_written_are_refused_before_any_work"),
    ("files.py",
     "        with _part(place, folder=True) as part:\n            yield part\n            _swap(part, place)\n",
     "        place.mkdir(exist_ok=True)\n        yield place\n",
     "test_cli_results.py::test_a_disk_that_is_full_during_a_run_keeps_the_old_result"),
    ("files.py", "        if part.exists():\n            break", "        break",
     "test_files.py::test_a_part_that_another_process_takes_for_a_leftover_is_made_again"),
    ("files.py", "        except BlockingIOError:\n", "        except ZeroDivisionError:\n",
     "test_log_writer.py::test_a_second_recorder_of_a_file_is_refused_and_the_first_one_completes"),
    ("log/writer.py", "        if not 0 <= log_ns < 2**63:\n", "        if False:\n",
     "test_log_writer.py::test_a_time_that_a_log_cannot_hold_is_one_line"),
    ("report/result.py", "not all(abs(v) < _LARGEST for v in values)", "not max(map(abs, values)) < _LARGEST",
     "test_report_result.py::test_a_damaged_file_is_one_line"),
    ("cli/record.py", "    if not count:\n", "    if False:\n",
     "test_cli_results.py::test_an_export_of_nothing_keeps_the_old_file"),
    ("binary_files.py", "if count * dtype.itemsize > len(data) - start - size:", "if False:",
     "test_files.py::test_an_archive_that_declares_too_much_is_refused"),
    ("binary_files.py", "except _ZIP_ERRORS as error:", "except ZeroDivisionError as error:",
     "test_files.py::test_every_damaged_archive_is_one_line"),
    ("report/jsonl.py", 'raise ValueError("an integer that is too large")', "pass",
     "test_files.py::test_json_that_this_program_cannot_use"),
    ("report/result.py", "        if not same:\n", "        if False:\n",
     "test_cli_results.py::test_a_changed_or_missing_file_is_found"),
    ("cli/compare.py", "        if run.losses:\n", "        if False:\n",
     "test_cli_results.py::test_a_result_of_a_damaged_log_passes_no_gate_in_silence"),
    ("settings.py", "and not isinstance(number, bool) and not self._allows(number):", "and False:",
     "test_cli_bad_input.py::test_an_invalid_option"),
    ("log/mcap_format.py", "if opcode == 0 or foreign > _MOST_FOREIGN:", "if False:",
     "test_log_mcap_file.py::test_millions_of_records_of_length_zero_take_little_memory"),
    ("cli/__init__.py", "        except BrokenPipeError:\n            raise StdoutClosed from None\n",
     "        except ZeroDivisionError:\n            pass\n",
     "test_cli_main.py::test_a_closed_pipe_is_not_a_failed_check"),
    ("cli/__init__.py", "    except Exception as error:\n        code = _crash(error)\n", "",
     "test_cli_main.py::test_no_error_exits_with_the_code_of_a_failed_check"),
    ("sweep/journal.py", 'and line[:9] == b"%08x " % zlib.crc32(line[9:-1])', "",
     "test_sweep_journal.py::test_one_changed_byte_costs_at_most_the_two_runs_that_it_touches"),
    ("sweep/journal.py", "        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)", "        pass",
     "test_sweep_journal.py::test_two_campaigns_cannot_use_one_directory"),
    ("sweep/execute.py", 'return RunResult(task.id, "lossy", what, *found)',
     'return RunResult(task.id, "ok", None, *found)',
     "test_sweep_run.py::test_a_cut_log_is_lossy_and_exit_4_as_in_run"),
    ("cli/sweep.py", 'default="127.0.0.1:0"', 'default="0.0.0.0:0"',
     "test_sweep_run.py::test_dask_listens_on_the_loopback_only"),
    ("arithmetic.py", "    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])", "    return",
     "test_arithmetic.py::test_the_process_starts_once_more_and_keeps_other_tunables"),
    ("log/point_cloud2.py", "(np.abs(points) <= MAX_COORDINATE_M).all(axis=1)", "np.isfinite(points).all(axis=1)",
     "test_log_point_cloud2.py::test_points_that_are_too_far_away_are_left_out_and_counted"),
    ("report/jsonl.py", "if not name.isprintable() or len(name) > _MAX_NAME:", "if False:",
     "test_report_golden.py::test_an_invalid_golden_file_is_one_line"),
    ("report/export.py", '_FORMULA = ("=", "+", "-", "@", "\\t", "\\r")', '_FORMULA = ("\\0",)',
     "test_cli_results.py::test_cells_that_a_spreadsheet_would_evaluate_are_quoted"),
    ("log/pose_files.py", "    if abs(t_ns) >= _MAX_SECONDS * 1_000_000_000:\n        raise ValueError\n", "",
     "test_register_poses.py::test_a_file_that_holds_no_poses_is_refused_with_file_and_line"),
    ("config.py", "        check_robot(self.robot, self.plan, self.limits)\n", "",
     "test_cli_bad_input.py::test_an_impossible_robot_is_one_line"),
)  # fmt: skip


def passes(checkout: Path, *tests: str) -> bool:
    """Whether all tests pass in a checkout; one that does not end fails. Raises RuntimeError if one does not exist."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *(f"tests/{t}" for t in tests)]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    limit = LIMIT_S * (1 + len(tests))
    try:
        done = subprocess.run(
            command, cwd=checkout, env=environment, capture_output=True, text=True, check=False, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return False
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{tests}: {done.stdout[-500:]}")
    return done.returncode == 0


def main() -> int:
    """Remove each guard; exit 1 if its test passes all the same."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="guards of files and tests that contain this text")
    parser.add_argument("--first", type=int, default=0, help="begin with this guard")
    asked = parser.parse_args()
    guards = [guard for guard in GUARDS if asked.only in f"{guard[0]} {guard[3]}"][asked.first :]
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        checkout = Path(folder) / "checkout"
        left_out = shutil.ignore_patterns(".git", "build", "dist", "__pycache__", ".*_cache", ".hypothesis")
        shutil.copytree(ROOT, checkout, ignore=left_out)
        if not passes(checkout, *(test for *_, test in guards)):
            raise SystemExit("a test fails with its guard")
        for name, text, replacement, test in guards:
            path = checkout / "avsreplay" / name
            whole = path.read_text(encoding="utf-8")
            if whole.count(text) != 1:
                raise SystemExit(f"{name} contains {text!r} {whole.count(text)} times")
            path.write_text(whole.replace(text, replacement), encoding="utf-8")
            tested = not passes(checkout, test)
            path.write_text(whole, encoding="utf-8")
            bad += not tested
            print(f"{'ok' if tested else 'NOT TESTED':<10} {name}: {test}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
