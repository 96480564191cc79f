"""Side valleys: a far guess must not leave a pose beside the truth that a better one could replace."""

import numpy as np
import pytest
from true_scans import true_scans

from avsreplay import geometry, toml_document
from avsreplay.geometry import Pose
from avsreplay.register import Registrar
from avsreplay.simulate import builtin_surface, scenario_of, simulate

SCENARIO = """
seed = 5
duration_s = 60.0
rate_hz = 0.2
[motion]
attitude_xyzw = [0.1, 0.7, -0.1, 0.7]
rate_radps = [0.06, 0.064, -0.048]
position_m = [0.1, -0.1, 4.5]
"""


@pytest.fixture(scope="module")
def scans():
    simulated = simulate(scenario_of(toml_document.parse(SCENARIO, "second look")), builtin_surface())
    return list(true_scans(simulated))


@pytest.mark.slow
def test_no_far_guess_ends_beside_the_truth(scans):
    registrar, rng = Registrar(builtin_surface()), np.random.default_rng(0)
    left = []
    for scan in scans:
        for _ in range(8):
            axis, shift = rng.normal(size=(2, 3))
            turn = geometry.exp(np.radians(4.0) * axis / np.linalg.norm(axis))
            guess = scan.truth @ Pose(turn, 0.12 * shift / np.linalg.norm(shift))
            found = registrar.register(scan.points, guess)
            error = found.T_ac.inverse() @ scan.truth
            left.append((np.degrees(geometry.angle(error.q)), np.linalg.norm(error.t)))
    assert len(left) >= 80
    assert np.max(left, axis=0)[0] < 0.5
    assert np.max(left, axis=0)[1] < 0.01


def test_a_close_guess_is_registered_once(scans, monkeypatch):
    registrar, calls = Registrar(builtin_surface()), []
    graded = registrar._graded
    monkeypatch.setattr(registrar, "_graded", lambda *args, **named: calls.append(1) or graded(*args, **named))
    for scan in scans:
        registrar.register(scan.points, scan.truth)
    assert len(calls) == len(scans)


def test_a_scan_of_scattered_points_costs_few_restarts():
    """A few stray returns are worth at most eight restarts: a result equal to the guess is not a second start."""
    registrar, rng = Registrar(builtin_surface()), np.random.default_rng(4)
    restarter = registrar._restarter
    calls, graduated = [], restarter.graduated
    restarter.graduated = lambda *args: calls.append(args[1]) or graduated(*args)
    stray = rng.uniform([-3.0, -3.0, 2.0], [3.0, 3.0, 8.0], (120, 3))
    found = registrar.register(stray, Pose.identity() @ Pose([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 5.0]))
    assert not found.measured
    assert 0 < len(calls) <= 8
    poses = {np.round(pose.matrix, 6).tobytes() for pose in calls}
    assert len(poses) >= len(calls) - 1  # the guess begins narrow and wide
