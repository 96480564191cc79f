"""The Gramian's recursion against its sum, ranks with known values, and the names of unobservable
directions.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tumbling
from click.testing import CliRunner

from avsreplay.cli.observability import observability_command
from avsreplay.estimate.chart import to_chart, to_state
from avsreplay.estimate.initialise import BatchResult
from avsreplay.estimate.reference import FittedMotion
from avsreplay.estimate.relative_orbit import RelativeOrbit
from avsreplay.geometry import Array
from avsreplay.log import SourceOptions
from avsreplay.monitor import _root
from avsreplay.monitor.gramian import (
    Gramian,
    from_trajectory,
    gramian,
    measure,
    observe,
    unobserved,
    weakest,
)
from avsreplay.records import Belief
from avsreplay.rows import Row
from avsreplay.run import Job, Run


def exact(size: int) -> np.ndarray:
    """Noise so small that every direction that is seen at all is determined."""
    return 1e-26 * np.eye(size)


def chain(seed: int, n: int = 6, steps: int = 9):
    rng = np.random.Generator(np.random.PCG64(seed))
    return [
        (np.eye(n) + 0.3 * rng.normal(size=(n, n)), rng.normal(size=(2, n))) for _ in range(steps)
    ]


def test_the_fold_is_the_sum() -> None:
    """W = sum Phi_j0' H' H Phi_j0 with the newest factor on the left."""
    state, Phi_k0, W = gramian(np.ones(6)), np.eye(6), np.zeros((6, 6))
    for Phi, H in chain(0):
        state = observe(state, Phi, H, exact(2))
        Phi_k0 = Phi @ Phi_k0
        W += Phi_k0.T @ H.T @ H @ Phi_k0
    assert np.abs(state.root.T @ state.root - W).max() < 1e-10 * np.abs(W).max()
    assert measure(state).log10_cond == pytest.approx(np.log10(np.linalg.cond(W)), abs=1e-6)
    D = np.diag(np.geomspace(1.0, 1e-3, 6))
    scaled = measure(replace(state, scale=np.diag(D)))
    assert scaled.log10_cond_scaled == pytest.approx(np.log10(np.linalg.cond(D @ W @ D)), abs=1e-5)


def test_the_roots_are_those_of_the_rows_and_of_the_rows_weighted_by_their_noise() -> None:
    rng = np.random.default_rng(4)
    for n, m, scans in ((20, 6, 1), (20, 6, 9), (12, 6, 40), (3, 1, 2)):
        state, rows, noise = gramian(np.ones(n)), np.zeros((0, n)), np.zeros((0, m, m))
        for _ in range(3):
            more = rng.normal(size=(scans, m, n)) * 10.0 ** rng.uniform(-3, 3, n)
            R = np.array([a @ a.T + 0.1 * np.eye(m) for a in rng.normal(size=(scans, m, m))])
            found = _root.extended(state.root, state.white, more, R)
            state = replace(state, root=found[0], white=found[1])
            rows, noise = np.vstack([rows, more.reshape(-1, n)]), np.concatenate([noise, R])
            blocks = rows.reshape(-1, m, n)
            W, weighted = (
                rows.T @ rows,
                np.einsum("kma,kmp,kpb->ab", blocks, np.linalg.inv(noise), blocks),
            )
            scale = np.sqrt(np.outer(W.diagonal(), W.diagonal()))
            for root, expected in ((state.root, W), (state.white, weighted)):
                assert np.array_equal(root, np.triu(root))
                np.testing.assert_allclose(
                    root.T @ root / scale,
                    expected / scale,
                    atol=1e-9 * np.abs(expected / scale).max(),
                )
    assert np.array_equal(
        _root.extended(state.root, state.white, 0.0 * more, R), [state.root, state.white]
    )
    assert np.isnan(
        _root.extended(np.zeros((3, 3)), np.zeros((3, 3)), np.full((1, 1, 3), np.nan), R[:1])
    ).any()
    C = R[0] + np.diag([1.0] * len(R[0]))
    white = _root.whitened(C, np.arange(1.0, len(C) + 1.0))
    assert white @ white == pytest.approx(
        np.arange(1.0, len(C) + 1.0) @ np.linalg.inv(C) @ np.arange(1.0, len(C) + 1.0)
    )
    with pytest.raises(ValueError, match="positive definite"):
        _root.whitened(-C, np.ones(len(C)))
    with pytest.raises(ValueError, match="positive definite"):
        _root.extended(state.root, state.white, more, -R)
    with pytest.raises(ValueError, match="differ"):
        _root.extended(state.root, state.white, more, R[:1])


def test_scaling_makes_the_rank_independent_of_units() -> None:
    """Millimetres instead of metres in half of the states change the raw condition and not the
    scaled one.
    """
    units = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])
    plain, scaled = gramian(np.ones(6)), gramian(units)
    for Phi, H in chain(1):
        plain = observe(plain, Phi, H, exact(2))
        scaled = observe(scaled, Phi * units[:, None] / units, H / units, exact(2))
    assert measure(scaled).log10_cond_scaled == pytest.approx(
        measure(plain).log10_cond_scaled, abs=1e-8
    )
    assert measure(scaled).log10_cond > measure(plain).log10_cond + 3


def test_rank_grows_scan_by_scan_and_the_condition_needs_full_rank() -> None:
    state, ranks = gramian(np.ones(6)), []
    for Phi, H in chain(2)[:4]:
        state = observe(state, Phi, H, exact(2))
        found = measure(state)
        ranks.append(found.rank)
        assert (found.log10_cond is None) == (found.rank < 6)
        assert (found.log10_cond_scaled is None) == (found.rank < 6)
    assert ranks == [2, 4, 6, 6]
    assert measure(gramian(np.ones(6))).rank == 0


def test_a_faulty_scan_moves_time_but_adds_nothing() -> None:
    (Phi, H), (Phi2, H2) = chain(3)[:2]
    state = observe(observe(gramian(np.ones(6)), Phi, H, None), Phi2, H2, exact(2))
    W = (H2 @ Phi2 @ Phi).T @ (H2 @ Phi2 @ Phi)
    assert np.abs(state.root.T @ state.root - W).max() < 1e-12


def test_a_condition_beyond_double_precision_is_computed() -> None:
    """10^24 in W: its root holds it, a summed W would not."""
    H = np.diag([1.0, 1e-6])
    state = observe(gramian(np.ones(2)), np.eye(2), H, exact(2))
    state = observe(state, np.eye(2), np.array([[1.0, 1e-6]]), exact(1))
    assert measure(state).log10_cond == pytest.approx(12.0, abs=0.3)
    deep = observe(gramian(np.array([1.0, 1.0])), np.eye(2), np.diag([1.0, 1e-10]), exact(2))
    assert measure(deep).log10_cond == pytest.approx(20.0, abs=1e-6)


def seen(H: Array, noise: float = 1e-3) -> Gramian:
    return observe(gramian(np.ones(20)), np.eye(20), H, noise**2 * np.eye(len(H)))


def test_weakest_direction_in_words() -> None:
    H = np.eye(20)
    H[14, 14] = 1e-2  # one direction of varrho
    assert weakest(seen(H), 1) == ("fixture position in the body x",)
    assert unobserved(seen(H)) == ()


def test_directions_that_are_not_observed_are_named_once_with_their_axes() -> None:
    """Where a whole block is not observed, the axes of the singular vectors within it are
    arbitrary.
    """
    both = (
        np.eye(20)[0] + 2.0 * np.eye(20)[17]
    )  # of these two states only this combination is observed
    H = np.vstack([np.delete(np.eye(20), [0, 6, 7, 8, 13, 17], axis=0), both])
    found = seen(
        np.linalg.qr(np.random.default_rng(3).normal(size=(15, 15)))[0] @ H
    )  # the Gramian is that of H
    assert unobserved(found) == (
        "attitude of the principal axes x (80%) with misalignment of the fixture x (20%)",
        "centre of mass x",
        "centre of mass y",
        "centre of mass z",
        "inertia ratios 2",
    )
    assert len(unobserved(found)) == 20 - measure(found).rank
    assert not set(weakest(found, 20)) & set(unobserved(found))
    assert len(set(weakest(found, 20))) == 15


def test_prior_must_be_positive() -> None:
    with pytest.raises(ValueError, match="positive"):
        gramian(np.zeros(3))


def test_the_rank_is_relative_to_the_noise() -> None:
    """A direction counts once the poses tell it better than the prior: 1 / noise > 1 / prior."""
    H = np.eye(3)[:2]
    for noise, rank in ((0.5, 2), (2.0, 0)):
        assert (
            measure(observe(gramian(np.ones(3)), np.eye(3), H, noise**2 * np.eye(2))).rank == rank
        )
    state = gramian(np.ones(3))
    for _ in range(5):
        state = observe(state, np.eye(3), H, 4.0 * np.eye(2))
    assert measure(state).rank == 2


def test_a_trajectory_in_one_call_equals_the_recursion() -> None:
    steps = chain(4)
    state, Phi_k0, rows = gramian(np.ones(6)), np.eye(6), []
    R = np.diag([0.1, 0.3])
    for Phi, H in steps:
        state, Phi_k0 = observe(state, Phi, H, R), Phi @ Phi_k0
        rows.append(H @ Phi_k0)
    once = from_trajectory(np.ones(6), np.array(rows), np.array([R] * len(rows)), Phi_k0)
    for a, b in ((once.root, state.root), (once.white, state.white)):
        assert np.abs(a.T @ a - b.T @ b).max() < 1e-9 * np.abs(b.T @ b).max()
    assert measure(once).rank == measure(state).rank


POSES = ("register.backend=poses",)


@pytest.mark.parametrize("orbit", [None, RelativeOrbit(0.02, np.eye(3), 5)], ids=["free", "orbit"])
def test_a_fitted_motion_followed_from_scan_to_scan_is_the_one_from_its_epoch(orbit) -> None:
    """State and transition over 60 s in 100 steps, within rounding of those in one step."""
    chart = to_chart(tumbling.draw(5, seconds=1.0, hz=2.0, rate=0.4, sigma_max=0.85).states[0])
    fitted = BatchResult(
        0, chart, 1, np.ones(2), np.ones(2), Belief(0, to_state(chart), np.eye(20)), False
    )
    there, direct = FittedMotion.of(fitted).at(60 * 10**9, orbit)
    motion, Phi = FittedMotion.of(fitted), np.eye(20)
    for k in range(1, 101):
        motion, step = motion.at(k * 6 * 10**8, orbit)
        Phi = step @ Phi
    assert motion.is_of(fitted)
    assert not motion.is_of(replace(fitted, chart=chart.moved(np.full(20, 1e-12))))
    assert motion.t_ns == there.t_ns
    assert np.abs(motion.x.flat - there.x.flat).max() < 1e-11
    assert np.abs(Phi - direct).max() < 1e-11 * np.abs(direct).max()


def _pose_log(path: Path, rate: float, seconds: float) -> Path:
    """Noisy poses of a body, in the format of a trajectory file."""
    world, rng = (
        tumbling.draw(5, seconds=seconds, hz=3.0, rate=rate, sigma_max=0.85),
        np.random.default_rng(1),
    )
    lines = []
    for t, x in zip(world.times, world.states, strict=True):
        T = tumbling.alignment(x.T_ac, rng, 0.002, 0.003).T_ac
        lines.append(" ".join(map(repr, [1.0 + float(t), *T.t.tolist(), *T.q.tolist()])))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _compared(log: Path, *assignments: str) -> list[tuple[Row, dict]]:
    """Rows of a run, each with the line of ``observability`` at its instant."""
    options = [part for one in assignments for part in ("--set", one)]
    done = CliRunner().invoke(
        observability_command, [str(log), "--json", "--marks", "200", *options]
    )
    assert done.exit_code == 0, done.output
    lines = {line["t_s"]: line["two"] for line in json.loads(done.stdout)["lines"]}
    posed = assignments[:1] == POSES
    with Run(
        Job(source=log, assignments=assignments, options=SourceOptions(poses=posed), prefetch=0)
    ) as run:
        return [(row, lines[row.t_s]) for row in run.rows()]


def test_rows_agree_with_the_motion_fitted_to_the_whole_log(tmp_path) -> None:
    """Before the inertia is known, the motion fitted so far differs from it, and with it the rank
    by one or two.
    """
    pairs = _compared(_pose_log(tmp_path / "tumbling.tum", 0.3, 50.0), *POSES)
    ranks = [(row.ogm_rank, line["rank_fitted_motion"]) for row, line in pairs]
    assert all(abs(a - b) <= 2 for a, b in ranks)
    assert all(abs(a - b) <= 1 for a, b in ranks[len(ranks) // 3 :])
    assert all(a == b for a, b in ranks[3 * len(ranks) // 5 :])
    full = [(row, line) for row, line in pairs[len(pairs) // 2 :] if row.ogm_log10_cond is not None]
    assert len(full) > 30
    for row, line in full:
        assert row.ogm_log10_cond == pytest.approx(line["log10_cond_fitted_motion"], abs=0.1)
        assert row.ogm_log10_cond_scaled == pytest.approx(
            line["log10_cond_scaled_fitted_motion"], abs=0.1
        )


def test_rows_of_a_body_at_rest_do_not_claim_more_than_pose_and_velocity(tmp_path) -> None:
    """Twelve directions: without rotation neither inertia nor centre of mass nor axes have an
    effect.
    """
    pairs = _compared(_pose_log(tmp_path / "rest.tum", 1e-9, 20.0), *POSES)
    assert {line["rank_fitted_motion"] for _, line in pairs[2:]} == {12}
    assert {row.ogm_rank for row, _ in pairs[2:]} == {12}


def test_rows_of_a_cold_start_do_not_claim_more_than_the_motion_allows(fixtures_folder) -> None:
    """Between two fits the mean of a mixture is no trajectory; along it the rank was 20 where it is
    16.

    A direction counts where its information exceeds that of the prior. After the gap at 7 s the fit
    of a row has fewer poses and other noise levels than that of the whole log. Along these two
    motions the ratios of the three weakest directions differ by factors of up to 2.6 about one, so
    that the rank differs by up to two.
    """
    pairs = _compared(fixtures_folder / "tumble.mcap", "estimator.start=cold")
    assert all(
        row.ogm_rank == line["rank_fitted_motion"] for row, line in pairs if 3.0 < row.t_s < 8.5
    )
    assert all(abs(row.ogm_rank - line["rank_fitted_motion"]) <= 2 for row, line in pairs)
    assert max(row.ogm_rank for row, _ in pairs) < 20
