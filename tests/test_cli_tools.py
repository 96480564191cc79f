"""The small commands: export, completion, config, version."""

import csv
import json

import numpy as np
import pytest

from avsreplay.cli.main import SUMMARIES


@pytest.fixture(scope="module")
def result(cli, fixtures_folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("tools") / "result"
    assert cli("run", fixtures_folder / "tumble.mcap", "-o", out).code == 0
    return out


def test_csv_holds_every_value_of_the_rows(result, cli, tmp_path):
    target = tmp_path / "rows.csv"
    assert cli("export", result, "--to", "csv", "-o", target).code == 0
    rows = [json.loads(line) for line in (result / "rows.jsonl").read_text().splitlines()]
    with target.open(newline="") as stream:
        table = list(csv.DictReader(stream))
    assert len(table) == len(rows)
    for line, row in zip(table, rows, strict=True):
        assert line["x_m"] == repr(row["x_m"])
        assert line["fault"] == (row["fault"] or "")


def test_kitti_and_tum_hold_the_same_poses(result, cli, tmp_path):
    from scipy.spatial.transform import Rotation

    for kind in ("kitti", "tum"):
        assert (
            cli(
                "export", result, "--to", kind, "--poses", "registration", "-o", tmp_path / kind
            ).code
            == 0
        )
    kitti = np.loadtxt(tmp_path / "kitti").reshape(-1, 3, 4)
    assert 0 < len(kitti) < len((result / "rows.jsonl").read_text().splitlines())
    tum = np.loadtxt(tmp_path / "tum")
    np.testing.assert_allclose(kitti[:, :, 3], tum[:, 1:4], atol=0)
    np.testing.assert_allclose(
        kitti[:, :, :3], Rotation.from_quat(tum[:, 4:]).as_matrix(), atol=1e-14
    )


def test_an_existing_export_is_not_overwritten(result, cli, tmp_path):
    target = tmp_path / "rows.csv"
    target.write_text("precious")
    done = cli("export", result, "--to", "csv", "-o", target)
    assert done.code == 2
    assert target.read_text() == "precious"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_are_printed(shell, cli):
    done = cli("completion", shell)
    assert done.code == 0
    assert "_AVSREPLAY_COMPLETE" in done.out


def test_completion_names_the_commands(cli):
    env = {"COMP_WORDS": "avsreplay re", "COMP_CWORD": "1", "_AVSREPLAY_COMPLETE": "bash_complete"}
    done = cli(env=env)
    assert {"plain,record", "plain,report"} <= set(done.out.split())


def test_version_lists_the_libraries(cli):
    out = cli("--version").out
    assert out.startswith("avsreplay 0.1.0")
    for name in ("numpy", "mcap", "kiss-icp"):
        assert name in out


@pytest.mark.parametrize("name", SUMMARIES)
def test_every_command_has_help_with_examples(name, cli):
    done = cli(name, "--help")
    assert done.code == 0, done.err
    assert "Examples:" in done.out


def test_the_install_command_of_a_back_end_is_printed_whole(monkeypatch, capsys):
    """A bracket in a cell is text: an extra must not vanish from the command."""
    from click.testing import CliRunner

    from avsreplay.cli.backends import backends_command
    from avsreplay.register import backend

    state = backend.Availability("open3d", False, "", "about", "pip install 'avsreplay[open3d]'")
    monkeypatch.setattr(backend, "available", lambda: [state])
    assert "pip install 'avsreplay[open3d]'" in CliRunner().invoke(backends_command, []).output


@pytest.mark.parametrize(
    ("words", "first"),
    [
        (("-o", "rows.csv"), "seq"),
        (("-o", "a.tum"), "1"),
        (("-o", "a.kitti"), "0."),
        (("-o", "a.txt", "--to", "tum"), "1"),
        (("-o", "noending", "--to", "csv"), "seq"),
    ],
)
def test_the_format_of_an_export_is_that_of_its_name(words, first, result, cli, tmp_path):
    target = tmp_path / words[1]
    done = cli("export", result, "--poses", "registration", "-o", target, *words[2:])
    assert done.code == 0, done.err
    assert target.read_text(encoding="utf-8").lstrip("#\ufeff- ").startswith(first)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("rows.csv", "--to", "kitti"),
            "the format is KITTI; name a file that ends in .kitti or .txt",
        ),
        (("rows.mcap", "--to", "csv"), "the format is CSV"),
        (("a.txt",), "the name states no format; add --to, one of csv, parquet, tum, kitti"),
        (("rows",), "the name states no format"),
    ],
)
def test_an_export_whose_name_contradicts_its_format_is_refused(words, said, result, cli, tmp_path):
    done = cli("export", result, "-o", tmp_path / words[0], *words[1:])
    assert (done.code, len(done.err.strip().splitlines())) == (2, 1)
    assert said in done.err
    assert not (tmp_path / words[0]).exists()


@pytest.mark.parametrize(
    "words", [("odometry", "-o", "x.mcap"), ("model", "-o", "m.ply", "--poses", "x.csv")]
)
def test_a_trajectory_in_a_file_of_another_format_is_refused(words, cli, fixtures_folder, tmp_path):
    words = [tmp_path / word if "." in word else word for word in words]
    done = cli(words[0], fixtures_folder / "tumble.mcap", *words[1:])
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "the format is TUM; name a file that ends in .tum or .txt" in done.err
    assert not list(tmp_path.iterdir())


def test_a_fresh_result_is_a_sound_log(result, cli):
    for command in ("doctor", "info"):
        done = cli(command, result / "result.mcap")
        assert done.code == 0, done.out + done.err
        assert "checksum" not in done.err


def test_a_model_that_was_built_needs_no_option(tmp_path):
    from avsreplay.errors import UnreadableInput
    from avsreplay.log.header import read_surface

    head = "ply\nformat ascii 1.0\n{}element vertex 3\nproperty float x\nproperty float y\n"
    text = head + "property float z\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
    path = tmp_path / "built.ply"
    path.write_text(text.format("comment reconstructed by avsreplay, metres, frame {C}\n"))
    assert len(read_surface(path).vertices) == 3
    path.write_text(text.format(""))
    with pytest.raises(UnreadableInput, match="no faces"):
        read_surface(path)
