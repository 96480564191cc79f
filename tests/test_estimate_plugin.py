"""Estimators as plug-ins: the laws, names, and a replay with each of them."""

import json

import numpy as np
import pytest

from avsreplay import geometry
from avsreplay.errors import UsageError
from avsreplay.estimate.contract import check, stream
from avsreplay.estimate.ekf import Ekf
from avsreplay.estimate.plugin import Context, load_method
from avsreplay.geometry import Pose
from avsreplay.parts import ESTIMATORS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["own", "paper", "ekf"])
def test_the_estimators_of_the_package_keep_all_laws(name):
    broken = [law for law in check(name) if not law.held]
    assert not broken


def test_an_unknown_estimator_is_one_line_with_the_known_names():
    with pytest.raises(UsageError, match="no estimator is called 'elk'"):
        load_method("elk")
    assert {"ekf", "own", "paper"} <= set(ESTIMATORS.names())


def test_the_plain_filter_agrees_with_a_weighted_mean_of_poses_at_rest():
    """An oracle without filters: at rest, the pose is the weighted mean of the measurements."""
    zero = np.zeros(20)
    zero[[0, 1, 2, 6, 7, 8]] = 10.0
    zero[3:6] = zero[9:12] = zero[12:] = 1e-9
    context = Context(1e-9, None, zero)
    method = Ekf(context)
    rng = np.random.Generator(np.random.PCG64(3))
    places = np.array([0.3, -0.2, 4.0]) + rng.normal(size=(6, 3)) * 0.01
    sigmas = rng.uniform(0.005, 0.02, size=6)
    state = method.start(0, Pose(geometry.IDENTITY_QUAT, np.array([0.3, -0.2, 4.0])))
    for t, s in zip(places, sigmas, strict=True):
        state = method.update(
            method.predict(state, 0),
            Pose(geometry.IDENTITY_QUAT, t),
            np.diag([1e-4] * 3 + [s**2] * 3),
        )
    weights = sigmas**-2.0
    mean = (weights[:, None] * places).sum(axis=0) / weights.sum()
    np.testing.assert_allclose(method.belief(state).x.T_ac.t, mean, atol=1e-6)
    np.testing.assert_allclose(np.diag(state.P)[6:9], 1.0 / weights.sum(), rtol=1e-4)


def test_the_streams_of_the_laws_are_noisy_poses_of_free_bodies():
    body = stream(5)
    away = [
        np.linalg.norm(a.T_ac.t - x.T_ac.t)
        for a, x in zip(body.alignments, body.truth, strict=True)
    ]
    assert 0.002 < np.sqrt(np.mean(np.square(away))) < 0.006
    rates = [geometry.matrix(x.q_ab) @ x.w_b for x in body.truth]
    assert np.linalg.norm(rates[0] - rates[-1]) > 1e-3  # it tumbles


@pytest.mark.parametrize("name", ["ekf", "paper"])
def test_a_log_is_replayed_with_the_estimator_that_is_named(cli, fixtures_folder, tmp_path, name):
    out = tmp_path / name
    log = fixtures_folder / "tumble.mcap"
    done = cli("run", log, "--n-scans", "12", "--estimator", name, "-o", out)
    assert done.code in (0, 1), done.err
    rows = [json.loads(line) for line in (out / "rows.jsonl").read_text("utf-8").splitlines()]
    assert len(rows) == 12
    assert rows[-1]["estimator"] == ("ekf" if name == "ekf" else "filter")
    assert max(row["pos_err_m"] for row in rows) < 1.0


def test_a_parameter_of_an_estimator_changes_what_it_claims(cli, fixtures_folder, tmp_path):
    claimed = []
    for k, density in enumerate(("1e-5", "0.1")):
        out, given = tmp_path / str(k), f"estimator.ekf.torque_radps15={density}"
        log = fixtures_folder / "tumble.mcap"
        done = cli("run", log, "--n-scans", "6", "--estimator", "ekf", "--set", given, "-o", out)
        assert done.code in (0, 1), done.err
        rows = [json.loads(line) for line in (out / "rows.jsonl").read_text("utf-8").splitlines()]
        claimed.append(rows[-1]["rate_c_1s_radps"])
        config = json.loads((out / "run.json").read_text("utf-8"))["config"]
        assert config["estimator"]["ekf"]["torque_radps15"] == float(density)
    assert claimed[1] > 2.0 * claimed[0]


def test_the_program_itself_has_no_table_of_an_estimator(cli, fixtures_folder):
    done = cli("run", fixtures_folder / "tumble.mcap", "--set", "estimator.own.gain=1")
    assert done.code == 2
    assert "unknown key 'estimator.own'" in done.err
