"""Whether tests fail without the code that they test: ``python tests/benchmarks/guards.py``.

The tests of docs/reliability-tests.md that are named here must pass in a copy of the checkout.
Then, for each guard, its text is replaced there, and its test must fail. Prints one line per guard;
exit code 1 if a test passes without its guard.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 60  # for one test
Edits = tuple[tuple[str, str, str], ...]
# (file, text, replacement, tests that must fail)
GUARDS: tuple[tuple[str, str, str, str], ...] = (
    (
        "log/header.py",
        "if np.abs(vertices).max() > MAX_COORDINATE_M:",
        "if False:",
        "test_log_scan_files.py::test_a_model_with_a_vertex_that_is_too_far_away_is_rejected",
    ),
    (
        "register/surface_index.py",
        "if largest > LARGEST_M:",
        "if False:",
        "test_register_surface_index.py::test_a_stray_vertex_is_named_as_too_large",
    ),
    (
        "files.py",
        "return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode) or stat.S_ISBLK(mode)",
        "return False",
        "test_files.py::test_a_fifo_receives_the_output",
    ),
    (
        "files.py",
        "    place = path.resolve()\n    try:\n        if is_stream(place)",
        "    place = path\n    try:\n        if is_stream(place)",
        "test_files.py::test_a_symbolic_link_is_followed_and_never_replaced",
    ),
    (
        "files.py",
        'if not path.name or path.name == ".." or b"\\0" in name:',
        "if False:",
        "test_files.py::test_names_that_cannot_be_written_are_refused_before_any_work",
    ),
    (
        "files.py",
        "if there is not None and stat.S_ISDIR(there) != folder:",
        "if False:",
        "test_files.py::test_folders_that_cannot_be_written_are_refused_before_any_work",
    ),
    (
        "files.py",
        "        with _part(place, folder=True) as part:\n            yield part\n"
        "            _keep_others(place, part, own)\n            _swap(part, place)\n",
        "        place.mkdir(exist_ok=True)\n        yield place\n",
        "test_cli_results.py::test_a_disk_that_is_full_during_a_run_keeps_the_old_result",
    ),
    (
        "files.py",
        "        if part.exists():\n            break",
        "        break",
        "test_files.py::test_a_part_that_another_process_takes_for_a_leftover_is_made_again",
    ),
    (
        "files.py",
        "            check_alone(part, place)\n",
        "            pass\n",
        "test_files.py::test_a_folder_that_another_process_writes_is_refused_before_any_work",
    ),
    (
        "locks.py",
        "        except BlockingIOError:\n",
        "        except ZeroDivisionError:\n",
        "test_log_writer.py::test_a_second_recorder_of_a_file_is_refused_and_the_first_one_completes",
    ),
    (
        "log/writer.py",
        "        if not 0 <= log_ns < 2**63:\n",
        "        if False:\n",
        "test_log_writer.py::test_a_time_that_a_log_cannot_hold_is_one_line",
    ),
    (
        "report/result.py",
        "not all(abs(v) < _LARGEST for v in values)",
        "not max(map(abs, values)) < _LARGEST",
        "test_report_result.py::test_a_damaged_file_is_one_line",
    ),
    (
        "cli/record.py",
        "    if not count:\n",
        "    if False:\n",
        "test_cli_results.py::test_an_export_of_nothing_keeps_the_old_file",
    ),
    (
        "binary_files.py",
        '    check_declared(count, dtype.itemsize, len(data) - start - size, "numbers")\n',
        "",
        "test_files.py::test_an_archive_that_declares_too_much_is_refused",
    ),
    (
        "binary_files.py",
        "except _ZIP_ERRORS as error:",
        "except ZeroDivisionError as error:",
        "test_files.py::test_every_damaged_archive_is_one_line",
    ),
    (
        "report/jsonl.py",
        'raise ValueError("an integer that is too large")',
        "pass",
        "test_files.py::test_json_that_this_program_cannot_use",
    ),
    (
        "report/result.py",
        "        if not same:\n",
        "        if False:\n",
        "test_cli_results.py::test_a_changed_or_missing_file_is_found",
    ),
    (
        "cli/compare.py",
        "        if run.losses:\n",
        "        if False:\n",
        "test_cli_results.py::test_a_result_of_a_damaged_log_passes_no_gate_in_silence",
    ),
    (
        "settings.py",
        "and not isinstance(number, bool) and not self._allows(number):",
        "and False:",
        "test_cli_bad_input.py::test_an_invalid_option",
    ),
    (
        "log/mcap_format.py",
        "if opcode == 0 or foreign > _MOST_FOREIGN:",
        "if False:",
        "test_log_mcap_file.py::test_millions_of_records_of_length_zero_take_little_memory",
    ),
    (
        "cli/main.py",
        "    if output and output.failure and not code:\n",
        "    if False:\n",
        "test_cli_main.py::test_a_closed_pipe_is_not_a_failed_check",
    ),
    (
        "cli/main.py",
        "    except Exception as error:\n        code = _crash(error)\n",
        "",
        "test_cli_main.py::test_no_error_exits_with_the_code_of_a_failed_check",
    ),
    (
        "sweep/journal.py",
        'and line[:9] == b"%08x " % zlib.crc32(line[9:-1])',
        "",
        "test_sweep_journal.py::test_one_changed_byte_costs_at_most_the_two_runs_that_it_touches",
    ),
    (
        "sweep/journal.py",
        "        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)",
        "        pass",
        "test_sweep_journal.py::test_two_campaigns_cannot_use_one_directory",
    ),
    (
        "sweep/execute.py",
        'return RunResult(task.id, "lossy", what, *found)',
        'return RunResult(task.id, "ok", None, *found)',
        "test_sweep_run.py::test_a_cut_log_is_lossy_and_exit_4_as_in_run",
    ),
    (
        "cli/sweep.py",
        'default="127.0.0.1:0"',
        'default="0.0.0.0:0"',
        "test_sweep_run.py::test_dask_listens_on_the_loopback_only",
    ),
    (
        "arithmetic.py",
        " and os.path.isfile(sys.argv[0])",
        "",
        "test_arithmetic.py::test_the_command_that_a_script_from_standard_input_calls_runs_once",
    ),
    (
        "log/point_cloud2.py",
        "(np.abs(points) <= MAX_COORDINATE_M).all(axis=1)",
        "np.isfinite(points).all(axis=1)",
        "test_log_point_cloud2.py::test_points_that_are_too_far_away_are_left_out_and_counted",
    ),
    (
        "report/jsonl.py",
        "if not name.isprintable() or len(name) > _MAX_NAME:",
        "if False:",
        "test_cli_results.py::test_escape_codes_in_a_golden_file_do_not_reach_the_terminal",
    ),
    (
        "report/export.py",
        '_FORMULA = ("=", "+", "-", "@", "\\t", "\\r")',
        '_FORMULA = ("\\0",)',
        "test_cli_results.py::test_cells_that_a_spreadsheet_would_evaluate_are_quoted",
    ),
    (
        "log/pose_files.py",
        "    if abs(t_ns) >= _MAX_SECONDS * 1_000_000_000:\n        raise ValueError\n",
        "",
        "test_register_poses.py::test_a_file_that_holds_no_poses_is_refused_with_file_and_line",
    ),
    (
        "config.py",
        "        check_robot(self.robot, self.plan, self.limits)\n",
        "",
        "test_cli_bad_input.py::test_an_impossible_robot_is_one_line",
    ),
    (
        "files.py",
        "        if not is_stream(path) and any(",
        "        if False and any(",
        "test_cli_results.py::test_no_output_is_another_path_of_its_command",
    ),
    (
        "files.py",
        "            _keep_others(place, part, own)\n",
        "",
        "test_cli_results.py::test_a_result_that_is_replaced_keeps_the_files_of_others",
    ),
    (
        "files.py",
        "        if _exchange(part, place):",
        "        if False:",
        "test_files.py::test_a_folder_is_replaced_in_one_step",
    ),
    (
        "cli/run.py",
        "            read_golden(self.golden)\n",
        "            pass\n",
        "test_cli_results.py::test_an_unusable_golden_file_is_refused_before_the_replay",
    ),
    (
        "log/writer.py",
        "        except ValueError:\n            self._discard()",
        "        except ZeroDivisionError:\n            self._discard()",
        "test_log_writer.py::test_a_state_that_is_not_finite_is_one_line_and_leaves_no_file",
    ),
    (
        "log/writer.py",
        "stamp_ns = min(max(at_ns, 0), MAX_NS)",
        "stamp_ns = at_ns",
        "test_log_writer.py::test_labels_at_times_that_ros_cannot_hold_are_cut",
    ),
    (
        "cli/main.py",
        "                self.failure = error\n",
        "                raise\n",
        "test_cli_main.py::test_results_are_complete_though_standard_output_is_full",
    ),
    (
        "__main__.py",
        "    except KeyboardInterrupt:",
        "    except ZeroDivisionError:",
        "test_cli_main.py::test_ctrl_c_while_the_command_is_loaded_is_one_line",
    ),
    (
        "log/growing.py",
        "if self.finished and self._broken is not None:\n                        self.source",
        "if False:\n                        self.source",
        "test_log_growing.py::test_a_stream_that_breaks_off_is_a_loss_and_never_taken_for_the_end",
    ),
    (
        "log/header.py",
        "    if np.ptp(vertices, axis=0).max() < LEAST_EXTENT_M:",
        "    if False:",
        "test_log_scan_files.py::test_a_model_that_is_too_small_is_rejected",
    ),
    (
        "arithmetic.py",
        "        os.environ.update(_variables())\n",
        "",
        "test_arithmetic.py::test_emulated_processors_give_the_same_bytes",
    ),
    (
        "checkpoint.py",
        "        _check_alike(found, self._like)\n",
        "",
        "test_checkpoint.py::test_a_checkpoint_with_another_attribute_is_one_line",
    ),
    (
        "simulate/target.py",
        "    if np.abs(found.sigma).max() > 1.0 - LEAST_THICKNESS:",
        "    if False:",
        "test_simulate_target.py::test_a_body_without_thickness_is_refused",
    ),
    (
        "simulate/scenario.py",
        "    if start.sigma_offset is not None and np.abs(truth.sigma + sigma).max() >= 1.0:",
        "    if False:",
        "test_simulate_scenario.py::test_an_offset_to_an_impossible_inertia_is_one_line",
    ),
    (
        "preflight.py",
        "    if broken:\n        text",
        "    if False:\n        text",
        "test_preflight.py::test_clouds_that_cannot_be_decoded_are_named_with_the_reason",
    ),
    (
        "log/header.py",
        "    if found is not surface:",
        "    if False:",
        "test_cli_bad_input.py::test_a_model_of_an_extreme_scale_is_one_line",
    ),
    (
        "sweep/journal.py",
        "            self._read()  # another process",
        "            # another process",
        "test_sweep_journal.py::test_what_another_process_has_written_before_the_lock_is_read",
    ),
    (
        "sweep/journal.py",
        "        if foreign and not self.path.exists():",
        "        if False:",
        "test_sweep_journal.py::test_a_folder_of_other_results_is_left_alone",
    ),
    (
        "log/result_log.py",
        "        except Exception as error:",
        "        except ZeroDivisionError as error:",
        "test_checkpoint.py::test_a_damaged_log_of_an_interrupted_run_is_one_line",
    ),
    (
        "settings.py",
        'return text.encode("utf-8", "backslashreplace").decode("utf-8")',
        "return text",
        "test_cli_results.py::test_a_result_of_a_log_whose_name_is_not_utf_8_can_be_read",
    ),
    (
        "toml_document.py",
        "data = stream.read(MAX_BYTES + 1)",
        "data = stream.read()",
        "test_cli_results.py::test_an_input_without_an_end_is_one_line",
    ),
)
# (file, text, replacement) of every place that refuses the same defect, test that must fail without
# all of them
SEVERAL: tuple[tuple[tuple[tuple[str, str, str], ...], str], ...] = (
    (
        (
            ("report/result.py", "        if not same:\n", "        if False:\n"),
            (
                "report/result.py",
                '    if not unverified and len(rows) != header.get("rows"):',
                "    if False:",
            ),
        ),
        "test_cli_results.py::test_cut_rows_cannot_pass",
    ),
    (
        (
            (
                "log/index.py",
                "column.append(max(-MAX_NS, min(value, MAX_NS)))",
                "column.append(value)",
            ),
            ("log/index.py", "log_ns = max(-MAX_NS, min(times[0], MAX_NS))", "log_ns = times[0]"),
        ),
        "test_log_source.py::test_times_that_ros_cannot_hold_are_cut_and_can_be_recorded",
    ),
)
ALL = tuple((((name, text, other),), test) for name, text, other, test in GUARDS) + SEVERAL


def passes(checkout: Path, *tests: str) -> bool:
    """Whether all tests pass in a checkout; one that does not end fails.

    Raises RuntimeError if one does not exist.
    """
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        *(f"tests/{t}" for t in tests),
    ]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    limit = LIMIT_S * (1 + len(tests))
    try:
        done = subprocess.run(
            command,
            cwd=checkout,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=limit,
        )
    except subprocess.TimeoutExpired:
        return False
    if done.returncode not in (0, 1, 2):  # 2: a KeyboardInterrupt that no guard takes
        raise RuntimeError(f"{tests}: {done.stdout[-500:]}")
    return done.returncode == 0


@contextmanager
def removed(checkout: Path, edits: Edits) -> Iterator[None]:
    """Replace the texts of one guard, then restore the files.

    Raises SystemExit if a text is not there once.
    """
    with ExitStack() as stack:
        for name, text, replacement in edits:
            path = checkout / "avsreplay" / name
            whole = path.read_text(encoding="utf-8")
            if whole.count(text) != 1:
                raise SystemExit(f"{name} contains {text!r} {whole.count(text)} times")
            stack.callback(path.write_text, whole, encoding="utf-8")
            path.write_text(whole.replace(text, replacement), encoding="utf-8")
        yield


def main() -> int:
    """Remove each guard; exit 1 if its test passes all the same."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only", default="", help="guards of files and tests that contain this text"
    )
    parser.add_argument("--first", type=int, default=0, help="begin with this guard")
    asked = parser.parse_args()
    guards = [guard for guard in ALL if asked.only in f"{guard[0][0][0]} {guard[1]}"][asked.first :]
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        checkout = Path(folder) / "checkout"
        left_out = shutil.ignore_patterns(
            ".git", "build", "dist", "__pycache__", ".*_cache", ".hypothesis"
        )
        shutil.copytree(ROOT, checkout, ignore=left_out)
        if not passes(checkout, *(test for _, test in guards)):
            raise SystemExit("a test fails with its guard")
        for edits, test in guards:
            with removed(checkout, edits):
                tested = not passes(checkout, test)
            bad += not tested
            print(f"{'ok' if tested else 'NOT TESTED':<10} {edits[0][0]}: {test}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
