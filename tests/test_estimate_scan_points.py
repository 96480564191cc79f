"""Older scans combined into points: ``estimate/scan_points.py`` and the windows and decisions
that use them.
"""

from __future__ import annotations

from dataclasses import replace

import estimate_surprises as surprises
import numpy as np
import pytest
import tumbling

from avsreplay.estimate import noise, scan_window
from avsreplay.estimate.dynamics import propagate, propagate_state
from avsreplay.estimate.error_state import VEL, W
from avsreplay.estimate.measurement import innovation_vector
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.scan_points import FEWEST_KEPT, latest, scan_points
from avsreplay.estimate.track import Epoch, Prediction, Track
from avsreplay.records import Belief, Innovation


def noises(n: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    halves = 1e-3 * (np.eye(6) + 0.3 * rng.normal(size=(n, 6, 6)))
    return tuple(half @ half.T for half in halves)


def scans(n: int, hz: float = 10.0) -> tuple[Belief, list[Epoch]]:
    """Accepted scans of a tumbling body with poses of any error, after a start of any
    covariance.
    """
    rng = np.random.default_rng(n)
    world = tumbling.draw(3, seconds=2.0, hz=1.0, rate=0.3)
    half = rng.normal(size=(20, 20)) * 1e-3
    start = Belief(0, world.states[0], half @ half.T)
    epochs, belief = [], start
    for k, R in enumerate(noises(n, rng)):
        belief = propagate(belief, round((k + 1) * 1e9 / hz), 1e-3, 2e-3)[0]
        prediction = Prediction(belief, np.eye(20), np.zeros((6, 20)), noise.NoiseWindow.empty())
        alpha = np.linalg.cholesky(R) @ rng.normal(size=6)
        seen = Innovation(alpha, R, R, 0.0, 0.0, 0.0, 0.0, share=rng.uniform(0.0, 0.3))
        epochs.append(Epoch(Track(start, "filter"), prediction, seen, False))
    return start, epochs


def averaging(R: tuple[np.ndarray, ...], first: np.ndarray) -> np.ndarray:
    """Matrix (6p, 6n) of the means weighted by information, written out."""
    ends, out = [*first[1:], len(R)], np.zeros((6 * len(first), 6 * len(R)))
    for p, (begin, end) in enumerate(zip(first, ends, strict=True)):
        total = sum(np.linalg.inv(R[k]) for k in range(begin, end))
        for k in range(begin, end):
            out[6 * p : 6 * p + 6, 6 * k : 6 * k + 6] = np.linalg.inv(total) @ np.linalg.inv(R[k])
    return out


@pytest.mark.parametrize(
    ("accepted", "doubtful"), [(1, 3), (FEWEST_KEPT, 5), (13, 0), (40, 5), (64, 2)]
)
def test_the_last_scans_stay_single_and_every_scan_is_in_one_point(
    accepted: int, doubtful: int
) -> None:
    points = scan_points(noises(accepted + doubtful, np.random.default_rng(1)), accepted)
    sizes = np.diff(points.first, append=accepted + doubtful)
    assert points.first[0] == 0
    assert sizes.sum() == len(points.point) == accepted + doubtful
    assert list(points.point) == [p for p, size in enumerate(sizes) for _ in range(size)]
    assert (sizes[len(sizes) - doubtful - min(accepted, 4) :] == 1).all()
    assert points.single == (accepted <= FEWEST_KEPT)
    assert len(sizes) <= FEWEST_KEPT + doubtful
    assert points.before(accepted) == len(sizes) - doubtful


def test_a_window_of_points_is_that_of_the_scans_after_the_means_are_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start, epochs = scans(40)
    found = scan_window.window_of(epochs, 38, start, 1e-3, 2e-3)
    with monkeypatch.context() as one_by_one:
        one_by_one.setattr(scan_window, "scan_points", lambda R, _: scan_points(R, 0))
        plain = scan_window.window_of(epochs, 38, start, 1e-3, 2e-3)
    assert plain.points.single
    assert not found.points.single
    B = averaging(found.R, found.points.first)
    np.testing.assert_allclose(found.y, B @ plain.y, atol=1e-15)
    np.testing.assert_allclose(found.C, B @ plain.C @ B.T, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(
        found.whiten @ found.C @ found.whiten.T, np.eye(len(found.y)), atol=1e-8
    )
    np.testing.assert_array_equal(
        found.edges_s[1:], plain.times_s[np.append(found.points.first[1:], 40) - 1]
    )


def test_a_change_between_two_scans_of_a_point_has_its_exact_effect() -> None:
    """Finite differences of the motion after a change of rate and velocity at an instant within an
    older point.
    """
    start, epochs = scans(40)
    window = scan_window.window_of(epochs, 40, start, 0.0, 0.0)
    at_s, size = 1.03, 1e-6
    inside = int(np.searchsorted(window.times_s, at_s))
    assert window.points.point[inside - 1] == window.points.point[inside]
    from avsreplay.estimate.hypotheses import after_changes

    columns = after_changes(window, start, np.array([at_s]))[0]
    x, B = propagate_state(start.x, at_s)[0], averaging(window.R, window.points.first)
    for unknown, part in enumerate([*range(W.start, W.stop), *range(VEL.start, VEL.stop)]):
        y = np.zeros((40, 6))
        for sign in (1.0, -1.0):
            w, v = x.w_b.copy(), x.v_a.copy()
            (w if unknown < 3 else v)[part - (W if unknown < 3 else VEL).start] += sign * size
            for k in range(inside, 40):
                after = window.times_s[k] - at_s
                free = propagate_state(start.x, window.times_s[k])[0]
                moved = propagate_state(replace(x, w_b=w, v_a=v), after)[0]
                y[k] += sign * innovation_vector(free, moved.T_ac) / (2.0 * size)
        np.testing.assert_allclose(
            columns[:, unknown], window.whiten @ B @ y.reshape(-1), rtol=1e-5, atol=1e-3
        )


def test_scans_within_some_seconds_are_kept_or_the_last_ones() -> None:
    _, slow = scans(30, hz=2.0)
    _, fast = scans(60, hz=10.0)
    _, fastest = scans(70, hz=30.0)
    assert latest(tuple(slow)) == tuple(slow[-FEWEST_KEPT:])
    assert latest(tuple(fast)) == tuple(fast[-51:])
    assert latest(tuple(fastest)) == tuple(fastest[-64:])
    assert latest(tuple(fast[:5])) == tuple(fast[:5])


@pytest.mark.parametrize("hz", [0.0, 2.0, 10.0, 100.0])
def test_small_changes_are_compared_however_large_changes_are_expected(hz: float) -> None:
    """The smallest width is at most that of a run of scans, and the largest that of the
    settings.
    """
    params = (EstimatorParams().at_interval(1.0 / hz, 4.0) if hz else EstimatorParams()).resolved(
        4.0
    )
    usual = EstimatorParams().resolved(4.0).change_1s
    priors = scan_window.ChangePriors.of(params, 4.0)
    assert priors.scales[0] == 1.0
    assert priors.velocity_mps * priors.scales[-1] <= 0.0101 * usual[1]
    assert priors.rate_radps * priors.scales[-1] <= 0.0101 * usual[0]
    assert all(
        a == pytest.approx(10.0 * b) for a, b in zip(priors.scales, priors.scales[1:], strict=False)
    )
    assert hz or priors.scales == scan_window.SCALES


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "step", "within_s"),
    [(719, {"velocity": 0.01}, 2.0), (719, {"rate": 0.01}, 2.0), (2, {"velocity": 0.004}, 4.0)],
)
def test_a_step_at_a_high_scan_rate_is_found_with_its_instant(
    monkeypatch: pytest.MonkeyPatch, seed: int, step: dict[str, float], within_s: float
) -> None:
    """Poses of a tracker at 10 Hz: a step of 1 cm/s moves the target by the error of a pose
    in 0.2 s.
    """
    monkeypatch.setattr(surprises, "NEES_S", ())
    case = surprises.Case(
        "push", hz=10.0, speed=0.2, seconds=55.0, tracker=True, correlated=0.0, **step
    )
    result = surprises.run(case, seed)
    assert result.track is not None
    (found,) = result.track.manoeuvres
    assert found.detected_ns * 1e-9 - result.step_s < within_s
    assert abs(found.t_ns * 1e-9 - result.step_s) < 3.3 * found.t_1s_s
    assert (
        6.0 * surprises.size_error(result, found) ** 2 < 22.5
    )  # 99.9 % of chi-square with 6 degrees of freedom
    assert max(result.pose[-60:]) < surprises.LIMIT
    assert result.reason.count("sensor_bias") < 10
