"""The start of a run and its reference: global search, cold start, deskewing, a fitted
reference.
"""

import json

import numpy as np
import pytest


def rows(cli, *args):
    done = cli("run", *args, "--json")
    assert done.code == 0, done.err
    return json.loads(done.out)["rows"]


def rms(found, name):
    values = [row[name] for row in found if row["gamma"] and row[name] is not None]
    assert values
    return float(np.sqrt(np.mean(np.square(values))))


def test_a_log_begins_without_any_guess(cli, fixtures_folder):
    found = rows(cli, fixtures_folder / "tumble.mcap", "--init", "auto", "--n-scans", 12)
    assert found[0]["guess"] == "acquired"
    assert found[0]["gamma"] == 1
    assert found[0]["reg_rot_err_deg"] < 1.0
    assert {row["estimator"] for row in found} <= {"start", "fit", "filter"}
    assert not found[0]["converged"]


@pytest.mark.parametrize("mode", ["near", "cold", "paper"])
def test_each_start_tracks_the_pose(mode, cli, fixtures_folder):
    found = rows(cli, fixtures_folder / "tumble.mcap", "--start-mode", mode, "--n-scans", 15)
    assert found[0]["estimator"] == {"near": "near", "cold": "start", "paper": "filter"}[mode]
    assert rms(found[5:], "pos_err_m") < 0.01


def test_near_without_a_belief_in_the_log_is_refused(cli, shared_data, tmp_path):
    folder = shared_data / "stanford-dragon"
    out = tmp_path / "d.mcap"
    model = folder / "dragon_vrip_res3.ply"
    assert cli("record", folder, "-o", out, "--model", model, "--n-scans", 2).code == 0
    done = cli("run", out, "--start-mode", "near")
    assert done.code == 2
    assert "near start" in done.err


def test_points_with_times_are_carried_to_one_instant(cli, fixtures_folder):
    log = fixtures_folder / "spin-raster.mcap"
    with_it, without = rows(cli, log), rows(cli, log, "--no-deskew")
    assert rms(with_it, "reg_rot_err_deg") < 0.2 * rms(without, "reg_rot_err_deg")
    assert rms(with_it, "reg_pos_err_m") < 0.3 * rms(without, "reg_pos_err_m")
    assert [row["seq"] for row in with_it if row["gamma"] == 0] == [
        22
    ]  # the scan with the injected clock fault


@pytest.mark.parametrize(
    ("hz", "scan_s", "pattern"),
    [(2.0, 0.3, "raster"), (1.0, 0.9, "raster"), (5.0, 0.15, "lissajous")],
)
def test_a_cold_start_from_scans_that_last_is_consistent(cli, tmp_path, hz, scan_s, pattern):
    """The points are moved to the stamp by a motion that is hardly known; the pose has this
    error too.
    """
    scenario, log = tmp_path / "raster.toml", tmp_path / "raster.mcap"
    text = (
        f"duration_s = {16.0 / hz}\nrate_hz = {hz}\n[scanner]\npattern = '{pattern}'\nscan_s ="
        f" {scan_s}\n"
    )
    scenario.write_text(text + "rays = [60, 60]\n", encoding="utf-8")
    assert cli("record", scenario, "-o", log).code == 0
    found = rows(cli, log, "--start-mode", "cold")
    assert {"fit"} <= {row["estimator"] for row in found}
    assert found[-1]["violations"] == 0


def test_a_reference_is_called_a_fit_and_never_truth(cli, fixtures_folder):
    log = fixtures_folder / "tumble.mcap"
    fitted, true = rows(cli, log, "--reference", "fit"), rows(cli, log)
    assert {row["reference"] for row in fitted} == {"fit"}
    assert {row["reference"] for row in true} == {"truth"}
    assert all(
        row["nees"] is None for row in fitted
    )  # a fit to the same scans judges no covariance
    assert rms(fitted, "pos_err_m") < 0.003
    printed = cli("run", log, "--reference", "fit", "--tables", "errors").out
    assert "from fit" in printed
    assert "Errors against the fitted motion" in printed


def test_consistency_is_reported_by_block(cli, fixtures_folder):
    document = json.loads(cli("run", fixtures_folder / "tumble.mcap", "--json").out)
    blocks = document["summary"]["nees_blocks"]
    assert set(blocks) == {"attitude", "rate", "position", "velocity", "sigma", "varrho", "mu"}
    for share in blocks.values():
        assert share["low"] < share["high"]
        assert 0.0 <= share["inside"] <= 1.0
    last = document["rows"][-1]
    assert last["covariance_converged"] is not None
    assert last["predictive_converged"] is not None
