"""Scheduling of the batch fit: the effect of accepted bad scans on the estimate, and of
impulses on a fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import tumbling
from scipy.stats import chi2

from avsreplay.estimate import Estimator, EstimatorParams, Track
from avsreplay.estimate.batch import FitParams, Problem, fit
from avsreplay.estimate.batch_covariance import memory_s, process_noise_pass
from avsreplay.estimate.batch_schedule import bent
from avsreplay.estimate.chart import nees, to_chart, to_errors
from avsreplay.estimate.error_state import boxplus
from avsreplay.estimate.initialise import (
    PoseFix,
    batch_estimate,
    given_prior,
    joined,
    pose_count,
    poses_of,
    rough_state,
    weak_prior,
)
from avsreplay.estimate.measurement import innovation_of
from avsreplay.estimate.mixture import contradicted
from avsreplay.estimate.noise_levels import NO_LEVELS, NoiseLevels
from avsreplay.estimate.params import Constraint, Start
from avsreplay.monitor.convergence import Consistency, ConsistencyParams
from avsreplay.records import Belief, State

POS_M, ROT_RAD = 0.005, np.radians(0.3)
WHITE = EstimatorParams(correlated_share=0.0, start=Start.NEAR)
DEAF = replace(
    WHITE, audit_poses=0, robust=False, constraint=Constraint.GAIN
)  # the filter as printed
BAND_20 = chi2.ppf([0.0005, 0.9995], 20)


def fold(
    times: np.ndarray,
    states: list[State],
    params: EstimatorParams,
    seed: int,
    wrong=None,
    noise=1.0,
    wide=1.0,
) -> Iterator[Track]:
    """The track after each scan; ``wrong`` (index, pose) -> the pose that registration gives,
    all of them healthy.
    """
    rng = np.random.Generator(np.random.PCG64([seed, 7]))
    estimator = Estimator(
        params, tumbling.near(states[0], seed, wide) if params.start is Start.NEAR else None, 2.0
    )
    track = estimator.initial(0, states[0].T_ac)
    for k, (t, x) in enumerate(zip(times, states, strict=True)):
        prediction = estimator.predict(track, round(t * 1e9))
        seen = tumbling.alignment(x.T_ac, rng, noise * POS_M, noise * ROT_RAD)
        if wrong is not None:
            seen = replace(seen, T_ac=wrong(k, seen.T_ac))
        track = estimator.update(track, prediction, estimator.innovate(prediction, seen), 1)
        yield track


def last(*args) -> Track:
    for track in fold(*args):  # noqa: B007
        pass
    return track


def frozen_scanner(first: int, count: int, states: list[State]):
    """The scan before ``first`` again, ``count`` times."""
    return lambda k, pose: states[first - 1].T_ac if first <= k < first + count else pose


def test_a_pose_is_weighted_down_beyond_the_gate_only() -> None:
    P, H, R = np.zeros((20, 20)), np.zeros((6, 20)), np.eye(6)
    for size in (0.0, 1.0, 5.0, 5.27, 5.29, 20.0, 1e6):
        seen = innovation_of(P, H, np.array([size, 0, 0, 0, 0, 0]), R, robust=True)
        assert seen.nis == pytest.approx(size**2)
        assert seen.weight == pytest.approx(
            min(1.0, chi2.ppf(0.9999, 6) / max(size**2, 1e-9)), rel=1e-3
        )
        assert innovation_of(P, H, seen.alpha, R).weight == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_an_accepted_frozen_scan_leaves_the_estimate_consistent(seed: int) -> None:
    """One and the same fault, and the printed filter denies its error."""
    world = tumbling.draw(seed, seconds=100.0, sigma_max=0.85)
    wrong = frozen_scanner(120, 4, world.states)
    honest, deaf = (last(world.times, world.states, p, seed, wrong, 0.1) for p in (WHITE, DEAF))
    assert nees(honest.belief, world.states[-1]) < BAND_20[1]
    assert nees(deaf.belief, world.states[-1]) > 3.0 * BAND_20[1]


@pytest.mark.slow
def test_a_consistent_filter_is_not_changed() -> None:
    """Twenty bodies, three audits each: the fit takes the word from none, and nothing differs
    in a bit.
    """
    recalls = 0
    for seed in range(20):
        world = tumbling.draw(seed, seconds=100.0, sigma_max=0.85)
        recalls += last(world.times, world.states, WHITE, seed).reinitialised
    assert recalls <= 1


def test_poses_that_contradict_the_filter_withdraw_convergence() -> None:
    world = tumbling.draw(1, seconds=100.0, sigma_max=0.85)
    tracks = list(fold(world.times, world.states, WHITE, 1, frozen_scanner(120, 8, world.states)))
    assert not tracks[119].window.many_outliers
    assert any(track.window.many_outliers for track in tracks[120:130])
    assert not tracks[-1].window.many_outliers


def test_one_wild_pose_does_not_make_the_innovations_inconsistent() -> None:
    monitor, rng = Consistency(ConsistencyParams()), np.random.Generator(np.random.PCG64(0))
    wild, plain = monitor.initial(), monitor.initial()
    for k in range(50):
        alpha = rng.normal(size=6) * (100.0 if k == 25 else 1.0)
        for robust in (True, False):
            seen = innovation_of(np.zeros((20, 20)), np.zeros((6, 20)), alpha, np.eye(6), robust)
            if robust:
                wild = monitor.observe(wild, seen, 1)
            else:
                plain = monitor.observe(plain, seen, 1)
    assert monitor.judge(wild).consistent
    assert monitor.judge(plain).consistent is False


def test_the_start_of_the_paper_is_not_changed() -> None:
    world = tumbling.draw(2, seconds=40.0)
    track = last(
        world.times,
        world.states,
        replace(WHITE, start=Start.PAPER),
        2,
        frozen_scanner(30, 3, world.states),
    )
    assert track.reinitialised == 0
    assert track.fixes == ()
    assert {epoch.weight for epoch in track.window.epochs} == {1.0}


def fixes(seed: int, seconds: float) -> tuple[PoseFix, ...]:
    world, rng = (
        tumbling.draw(seed, seconds=seconds),
        np.random.Generator(np.random.PCG64([seed, 7])),
    )
    seen = [tumbling.alignment(x.T_ac, rng, POS_M, ROT_RAD) for x in world.states]
    return tuple(
        PoseFix(round(t * 1e9), a.T_ac, a.covariance)
        for t, a in zip(world.times, seen, strict=True)
    )


def test_process_noise_increases_the_covariance_and_zero_noise_gives_the_fit() -> None:
    found = fixes(4, 100.0)
    poses, params = poses_of(found), WHITE.resolved(2.0)
    prior = weak_prior(poses, params)
    fitted = fit(poses, to_chart(rough_state(found)), prior, FitParams())
    problem = Problem(poses, prior, fitted.effective, fitted.chart)
    curvature = problem.covariance
    y, calm = process_noise_pass(fitted.chart, None, problem, (0.0, 0.0))
    scale = np.sqrt(np.outer(np.diag(curvature), np.diag(curvature)))
    assert np.abs((calm - curvature) / scale).max() < 1e-4
    assert y @ np.linalg.solve(curvature, y) < 0.01
    for torque, force in ((1e-6, 0.0), (1e-5, 0.0), (0.0, 1e-4)):
        _, wide = process_noise_pass(fitted.chart, None, problem, (torque, force))
        least = np.linalg.eigvalsh((wide - curvature) / scale)
        assert least[0] > -1e-4
        assert least[-1] > 1e-3


def test_the_memory_is_where_pushes_have_turned_the_body_by_the_stray() -> None:
    for torque in (1e-6, 1e-4):
        assert 3.0 * torque * np.sqrt(memory_s(torque) ** 3 / 3.0) == pytest.approx(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("start", [Start.NEAR, Start.COLD])
def test_the_estimate_of_a_disturbed_body_is_consistent(start: Start) -> None:
    """Ten times the default torque noise over 100 s; mean NEES of eight bodies, the fit's
    word or the filter's.
    """
    sizes = []
    for seed in range(8):
        world = tumbling.pushed(seed, 1e-5, seconds=100.0, hz=2.0)
        track = last(
            world.times, world.states, replace(WHITE, start=start, torque_noise_radps15=1e-5), seed
        )
        sizes.append(nees(track.belief, world.states[-1]) / 20)
    assert np.median(sizes) < 1.4
    assert np.median(sizes) > 0.5


def test_a_difference_is_a_contradiction_beyond_the_larger_covariance() -> None:
    found = fixes(4, 100.0)
    cold = batch_estimate(found, WHITE.resolved(2.0), FitParams(), NO_LEVELS)
    assert not contradicted(cold.belief, cold.belief)
    sizes = np.sqrt(np.linalg.eigvalsh(cold.belief.P))
    axis = np.linalg.eigh(cold.belief.P)[1][:, -1]
    small = replace(cold.belief, P=1e-4 * cold.belief.P)
    for claimed in (0.0, 0.25, 1.0, 4.0):  # variance of the belief over that of the fit
        scale = max(1.0, claimed) ** 0.5
        for off, expected in ((6.0, False), (9.0, True)):
            there = boxplus(cold.belief.x, 0.01 * off * scale * sizes[-1] * axis)
            P = max(claimed, 1e-3) * small.P
            assert contradicted(replace(small, x=there, P=P), small) is expected


def test_the_fit_begins_where_the_belief_came_from() -> None:
    world = tumbling.draw(3, seconds=60.0)
    chart = Estimator(EstimatorParams(), None, 2.0).batch.chart_at(
        Belief(round(world.times[-1] * 1e9), world.states[-1], np.eye(20)), 0
    )
    assert np.abs(chart.minus(to_chart(world.states[0]))).max() < 1e-7


@pytest.mark.slow
def test_a_given_start_is_consistent_under_precise_poses() -> None:
    """Poses far finer than the start: what the printed filter linearises on the way it takes
    for knowledge.
    """
    sizes: dict[Constraint, list[float]] = {constraint: [] for constraint in Constraint}
    for seed in range(10):
        world = tumbling.draw(seed, seconds=30.0, sigma_max=0.6)
        for constraint, found in sizes.items():
            params = replace(WHITE, constraint=constraint, audit_poses=0)
            track = last(world.times, world.states, params, seed, None, 0.1, 3.0)
            found.append(nees(track.belief, world.states[-1]) / 20)
    low, high = chi2.ppf([0.0005, 0.9995], 20 * 10) / (20 * 10)
    assert low < np.mean(sizes[Constraint.CHART]) < high
    assert np.mean(sizes[Constraint.GAIN]) > 3.0 * high


def test_a_belief_becomes_a_prior_by_its_draws() -> None:
    """Where it is narrow the derivative says the same; where two moments are nearly equal the
    axes count for more.
    """
    world = tumbling.draw(4, seconds=1.0)
    x = replace(world.states[0], sigma=np.array([-0.5, 0.4]))
    P = np.diag(tumbling.NEAR_1S**2) * 1e-4
    back = np.linalg.inv(to_errors(to_chart(x)))
    scale = np.sqrt(np.diagonal(back @ P @ back.T))
    assert (
        np.abs((given_prior(Belief(0, x, P)).P - back @ P @ back.T) / np.outer(scale, scale)).max()
        < 0.2
    )
    near_equal = replace(x, sigma=np.array([-0.5, 0.001]))
    P = np.diag(tumbling.NEAR_1S**2)
    back = np.linalg.inv(to_errors(to_chart(near_equal)))
    drawn, straight = given_prior(Belief(0, near_equal, P)).P, back @ P @ back.T
    assert (
        np.linalg.eigvalsh(drawn[12:17, 12:17])[0]
        > 3.0 * np.linalg.eigvalsh(straight[12:17, 12:17])[0]
    )


@pytest.mark.slow
@pytest.mark.parametrize("constraint", Constraint)
def test_a_given_start_that_is_wrong_is_left_out(constraint: Constraint) -> None:
    """Ten of its own sigma off: no confident wrong number is made of it, and the row says
    that it was contradicted.
    """
    for seed in range(2):
        world = tumbling.draw(seed, seconds=100.0, sigma_max=0.6)
        false = replace(
            tumbling.near(world.states[0], seed), x=tumbling.near(world.states[0], seed, 10.0).x
        )
        estimator = Estimator(replace(WHITE, constraint=constraint), false, 2.0)
        track, rng = (
            estimator.initial(0, false.x.T_ac),
            np.random.Generator(np.random.PCG64([seed, 7])),
        )
        for t, x in zip(world.times, world.states, strict=True):
            prediction = estimator.predict(track, round(t * 1e9))
            seen = estimator.innovate(prediction, tumbling.alignment(x.T_ac, rng, POS_M, ROT_RAD))
            track = estimator.update(track, prediction, seen, 1)
        assert track.reinitialised == 1
        assert nees(track.belief, x) < BAND_20[1]


def test_a_correct_start_is_kept() -> None:
    for seed in range(6):
        world = tumbling.draw(seed, seconds=30.0, sigma_max=0.85)
        track = last(world.times, world.states, WHITE, seed)
        assert track.reinitialised == 0
        assert track.batch is not None
        assert not track.batch.prior_rejected


def fixes_of(world: tumbling.World, seed: int) -> tuple[PoseFix, ...]:
    """Noisy poses of a world: 2 mm, 0.1 deg."""
    rng = np.random.Generator(np.random.PCG64([seed, 3]))
    seen = [tumbling.alignment(x.T_ac, rng, 0.002, np.radians(0.1)) for x in world.states]
    assert all(a.covariance is not None for a in seen)
    return tuple(
        PoseFix(round(t * 1e9), a.T_ac, a.covariance)
        for t, a in zip(world.times.tolist(), seen, strict=True)
        if a.covariance is not None
    )


@pytest.mark.parametrize("seed", range(3))
def test_joined_poses_give_the_estimate_of_all_poses(seed: int) -> None:
    """The older half joined in pairs, twice over: the estimate changes by a small part of its
    standard deviation.
    """
    world = tumbling.draw(seed, seconds=80.0, hz=5.0, sigma_max=0.85)
    fixes = fixes_of(world, seed)
    reference = to_chart(world.states[0])
    fewer = joined(fixes[:200], reference, np.ones(2)) + fixes[200:]
    moved = Estimator(EstimatorParams(), None, 2.0).batch.chart_at(
        Belief(0, world.states[0], np.eye(20)), fewer[0].t_ns
    )
    fewer = joined(fewer[:200], moved, np.ones(2)) + fewer[200:]
    assert len(fewer) <= 0.51 * len(fixes)
    assert pose_count(fewer) == pose_count(fixes) == len(fixes)
    assert sorted(f.t_ns for f in fewer) == [f.t_ns for f in fewer]
    params, rules = EstimatorParams().resolved(2.0), FitParams(rescale=False)
    every, part = (
        batch_estimate(some, params, rules, NO_LEVELS, start=reference) for some in (fixes, fewer)
    )
    assert part.count == every.count == len(fixes)
    there = to_chart(every.belief.x)
    size = (
        to_errors(there)
        @ to_chart(part.belief.x).minus(there)
        / np.sqrt(np.diagonal(every.belief.P))
    )
    assert np.abs(size).max() < 0.2
    ratio = np.sqrt(np.diagonal(part.belief.P) / np.diagonal(every.belief.P))
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)


def test_a_fit_uses_a_bounded_number_of_poses() -> None:
    from avsreplay.estimate import batch_schedule

    world = tumbling.draw(1, seconds=0.1 * 1500, hz=10.0)
    spin = replace(world.states[0], w_b=np.array([0.1, 0.0, 0.0]))
    states = tumbling.follow(world.times, world.moments, spin)
    estimator = Estimator(EstimatorParams(), None, 4.0)
    fixes = fixes_of(replace(world, states=states), 1)
    track = replace(estimator.initial(0, states[0].T_ac), fixes=fixes[: batch_schedule.MOST_FIXES])
    prediction = estimator.predict(track, fixes[batch_schedule.MOST_FIXES].t_ns)
    innovation = estimator.innovate(
        prediction, tumbling.alignment(states[1024].T_ac, np.random.default_rng(0), 0.002, 0.002)
    )
    after = estimator.batch.filtered(track, prediction, innovation).fixes
    assert len(after) <= 0.76 * batch_schedule.MOST_FIXES
    assert pose_count(after) == batch_schedule.MOST_FIXES + 1


@pytest.mark.parametrize(("seed", "axis"), [(1, 0), (4, 2)])
def test_a_fit_to_a_long_unstable_spin_ends_with_a_covariance(seed: int, axis: int) -> None:
    """The spin about an unstable axis for 300 rad: its covariance grows beyond what numbers
    can hold.
    """
    world = tumbling.draw(seed, seconds=1500.0, hz=0.1, sigma_max=0.85)
    first = replace(world.states[0], w_b=0.2 * np.eye(3)[axis])
    world = replace(world, states=tumbling.follow(world.times, world.moments, first))
    rng = np.random.default_rng(seed)
    seen = [tumbling.alignment(x.T_ac, rng, 0.002, 0.002) for x in world.states]
    fixes = tuple(
        PoseFix(round(t * 1e9), a.T_ac, a.covariance)
        for t, a in zip(world.times.tolist(), seen, strict=True)
        if a.covariance is not None
    )
    params, levels = EstimatorParams().resolved(4.0), NoiseLevels(torque=1e-7, count=100)
    P = batch_estimate(
        fixes, params, FitParams(rescale=False), levels, start=to_chart(first)
    ).belief.P
    assert np.all(np.isfinite(P))
    scale = np.sqrt(np.diagonal(P))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale))[0] > -1e-9


def test_one_component_of_a_curved_likelihood_is_fitted_again_once_the_inertia_has_left_it() -> (
    None
):
    world = tumbling.draw(3, seconds=12.0)
    track = last(world.times, world.states, replace(WHITE, start=Start.COLD), 3)
    fitted = track.batch
    curved = replace(fitted, gaussian=False, components=fitted.components[:1])
    one_sigma = np.linalg.cholesky(fitted.belief.P[12:14, 12:14])
    x = fitted.belief.x
    for sigmas, due in ((0.0, False), (0.9, False), (1.1, True)):
        for angle in (0.0, 1.0, 2.5):
            moved = sigmas * one_sigma @ [np.cos(angle), np.sin(angle)]
            belief = replace(fitted.belief, x=replace(x, sigma=x.sigma + moved))
            assert bent(curved, belief) is due
            assert not bent(replace(curved, gaussian=True), belief)
            assert not bent(replace(curved, components=curved.components * 3), belief)
