"""Certainty about the grasp point of a body that spins about a principal axis.

``python tests/benchmarks/estimate_spin.py [--bodies 18] [--first 600] [--seconds 150] [--exact]``

Each body of ``estimate_surprises.py`` spins about each of its principal axes, 2 Hz, cold start.
From 15 s on, the predicted 1 sigma of the grasp point's position after each scan is compared with
that after the scan before: at the same instant, which the scan before predicted 1 s and 30 s ahead,
and as many seconds ahead of each scan. Printed are the share of the scans that raise it by more
than 2 %, with the event at which the rises occur, and the claim over the true error, over all scans
and at some instants.

``--exact``: instead, the exact posterior for independent errors of the same size. Given the inertia
the motion about a spin is linear, so that Kalman filters of 128 inertias drawn from the prior give
it. No code of the estimator is used.
"""

from __future__ import annotations

import argparse
from collections import Counter

import estimate_surprises as surprises
import numpy as np
import tumbling
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import norm, qmc

from avsreplay.estimate import Estimator, EstimatorParams
from avsreplay.geometry import Array
from avsreplay.monitor.fault_detection import FaultDetector, FaultParams
from avsreplay.records import ScanStatus

AHEAD_S, HZ, RATE, FROM_S, RISE = (1.0, 30.0), 2.0, 0.1, 15.0, 1.02
STATES, MEASURED = (
    17,
    6,
)  # attitude, rate, position, velocity, arm, and the spin axis in {C}, for a known inertia


def claims_of(seed: int, axis: int, seconds: float) -> tuple[Array, Array, list[str]]:
    """Variances (n, 2, 2) ahead and at the instants of the scan before, squared errors (n, 2) and
    events of a run.
    """
    case = surprises.Case("spin", spin=axis, seconds=seconds)
    times, states, *_ = surprises.world_of(case, seed)
    moments = tumbling.draw(seed, seconds=1.0, hz=HZ, sigma_max=0.85).moments
    later = tumbling.follow(np.arange(0.0, seconds + 31.0, 1.0 / HZ), moments, states[0])
    estimator = Estimator(EstimatorParams(correlated_share=case.correlated), None, surprises.EXTENT)
    detector, alignments = (
        FaultDetector(FaultParams(), surprises.EXTENT),
        surprises.measured(case, times, states, seed),
    )
    track, variances, errors, events = estimator.initial(0, alignments[0].T_ac), [], [], []
    for k, (t, alignment) in enumerate(zip(times, alignments, strict=True)):
        prediction = estimator.predict(track, round(t * 1e9))
        innovation, before = estimator.innovate(prediction, alignment), track
        examined = detector.examine(ScanStatus.OK, alignment, innovation, prediction.belief)
        track, _ = estimator.step(track, prediction, innovation, examined.admission, False)
        fitted = track.since == 0 and track.batch is not before.batch
        events.append(
            "fit" if fitted else "noise levels" if track.levels is not before.levels else "pose"
        )
        ahead = np.sort([h - part for h in AHEAD_S for part in (0.0, 1.0 / HZ)])
        found = estimator.track_forecast(track, ahead).pos_1s_m.reshape(-1, 2)[:, ::-1] ** 2
        positions, _ = estimator.motion(estimator.published(track))(np.array(AHEAD_S))
        true = np.array([later[k + round(h * HZ)].T_ac.t for h in AHEAD_S])
        variances.append(found)
        errors.append(((positions - true) ** 2).sum(axis=1))
    return np.array(variances), np.array(errors), events


def inertias(count: int) -> tuple[Array, Array]:
    """(n, 2, 2) derivative of the rates across the spin by themselves, over the spin rate, and
    weights (n,).

    The logarithm of the mass moments has a standard normal prior, and the spin is along one of its
    eigenvectors. The weight is the Jacobian from its other components to the direction of that
    eigenvector.
    """
    found, weights = [], []
    for a, b, c in norm.ppf(qmc.Sobol(3, seed=0).random(count)):
        along, across = (
            -2.0 * b / np.sqrt(6.0),
            np.array([[a, c], [c, -a]]) / np.sqrt(2.0) + b / np.sqrt(6.0) * np.eye(2),
        )
        (x, y), R = np.linalg.eigh(across)
        R = R * np.array([1.0, np.sign(np.linalg.det(R))])
        ratios = np.tanh((along - y) / 2.0), np.tanh((x - along) / 2.0)
        found.append(R @ np.array([[0.0, ratios[0]], [ratios[1], 0.0]]) @ R.T)
        weights.append(abs(x - along) * abs(y - along))
    return np.array(found), np.array(weights)


def exact_claims(seed: int, seconds: float, count: int = 128) -> tuple[Array, Array, list[str]]:
    """As ``claims_of``, of the exact posterior of a spin with independent errors of the poses."""
    rng, dt, spin = (
        np.random.Generator(np.random.PCG64([seed, 7])),
        1.0 / HZ,
        np.array([0.0, 0.0, RATE]),
    )
    arm = rng.normal(size=3)
    arm *= 0.3 * rng.uniform() ** (1.0 / 3.0) / np.linalg.norm(arm)
    derivatives, weights = inertias(count)
    step = [
        _transitions(derivatives, h)
        for h in (dt, *(h - part for h in AHEAD_S for part in (0.0, dt)))
    ]
    widths = np.repeat([2.0, 0.5, 1.2, 0.5, 0.3, 1.0], [3, 3, 3, 3, 3, 2])
    P, x, log = (
        np.tile(np.diag(widths**2), (count, 1, 1)),
        np.zeros((count, STATES)),
        np.log(weights),
    )
    sizes = np.repeat([surprises.ROT_RAD, surprises.POS_M], 3)
    R, variances, errors = np.diag(sizes**2), [], []
    for k in range(round(seconds * HZ) + 1):
        if k:
            x, P = np.einsum("nij,nj->ni", step[0], x), step[0] @ P @ np.swapaxes(step[0], 1, 2)
        H = np.zeros((MEASURED, STATES))
        H[:3, :3], H[:2, 15:], H[3:] = np.eye(3), np.eye(2), _position(spin * k * dt, arm)
        S, e = H @ P @ H.T + R, sizes * rng.normal(size=6) - x @ H.T
        solved = np.linalg.solve(S, np.concatenate([H @ P, e[:, :, None]], axis=2))
        log = log - 0.5 * (np.einsum("ni,ni->n", e, solved[:, :, -1]) + np.linalg.slogdet(S)[1])
        K = np.swapaxes(solved[:, :, :-1], 1, 2)
        x, left = x + np.einsum("nij,nj->ni", K, e), np.eye(STATES) - K @ H
        P = left @ P @ np.swapaxes(left, 1, 2) + K @ R @ np.swapaxes(K, 1, 2)
        w = np.exp(log - log.max())
        w /= w.sum()
        instants = [h - part for h in AHEAD_S for part in (0.0, dt)]
        found = [
            _moments(_position(spin * (k * dt + h), arm) @ F, x, P, w)
            for F, h in zip(step[1:], instants, strict=True)
        ]
        variances.append([[found[0][0], found[1][0]], [found[2][0], found[3][0]]])
        errors.append([found[0][1], found[2][1]])
    return np.array(variances), np.array(errors), ["pose"] * len(errors)


def _transitions(derivatives: Array, h: float) -> Array:
    """(n, 17, 17) transitions over h seconds, attitude and rate in the turning frame."""
    out = []
    for D in derivatives:
        A = np.zeros((STATES, STATES))
        A[0, 1], A[1, 0], A[:3, 3:6], A[3:5, 3:5], A[6:9, 9:12] = (
            RATE,
            -RATE,
            np.eye(3),
            RATE * D,
            np.eye(3),
        )
        out.append(expm(A * h))
    return np.array(out)


def _position(turn: Array, arm: Array) -> Array:
    """(3, 17) derivative of the grasp point's position when the body has turned by the rotation
    vector ``turn``.
    """
    A, H = Rotation.from_rotvec(turn).as_matrix(), np.zeros((3, STATES))
    H[:, :3], H[:, 6:9], H[:, 12:15] = A @ np.cross(np.eye(3), arm), np.eye(3), A
    return H


def _moments(J: Array, x: Array, P: Array, w: Array) -> tuple[float, float]:
    """Variance of a position by all inertias, and its squared error; J (n, 3, 17)."""
    means = np.einsum("nij,nj->ni", J, x)
    mean = w @ means
    own = np.einsum("nij,njk,nik->n", J, P, J)
    return float(w @ (own + ((means - mean) ** 2).sum(axis=1))), float(mean @ mean)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", type=int, default=18)
    parser.add_argument("--first", type=int, default=600, help="seed of the first body")
    parser.add_argument("--seconds", type=float, default=150.0)
    parser.add_argument("--exact", action="store_true", help="instead, the exact posterior")
    given = parser.parse_args()
    rises, events, count = np.zeros((2, 2)), Counter[str](), 0
    claimed, true, ratios, runs = np.zeros(2), np.zeros(2), [], []
    for seed in range(given.first, given.first + given.bodies):
        for axis in range(1 if given.exact else 3):
            run = (
                exact_claims(seed, given.seconds)
                if given.exact
                else claims_of(seed, axis, given.seconds)
            )
            runs.append((run[0][:, 1, 0], run[1][:, 1]))
            variances, errors, kinds = (part[round(FROM_S * HZ) :] for part in run)
            up = np.sqrt(variances[1:] / variances[:-1, :, :1]) > RISE
            rises, count = rises + up.sum(axis=0), count + len(up)
            events.update(kind for kind, rose in zip(kinds[1:], up[:, 1, 1], strict=True) if rose)
            claimed, true = claimed + variances[1:, :, 0].sum(axis=0), true + errors[1:].sum(axis=0)
            ratios.append((errors / variances[:, :, 0]).mean(axis=0))
    for k, h in enumerate(AHEAD_S):
        (ahead, fixed), error = 100.0 * rises[k] / count, np.mean([ratio[k] for ratio in ratios])
        print(
            f"{h:.0f} s ahead: {fixed:.1f} % of {count} scans raise the 1 sigma of an instant,"
            f" {ahead:.1f} % that ahead"
        )
        print(
            f"  rms claim over rms error {np.sqrt(claimed[k] / true[k]):.2f}, squared error over"
            f" variance {error:.2f}"
        )
    for t in range(30, round(given.seconds) + 1, 30):
        claim, error = (
            1e3 * np.sqrt(np.mean([part[round(t * HZ)] for part in parts]))
            for parts in zip(*runs, strict=True)
        )
        print(f"{t} s: 1 sigma {claim:.1f} mm, error {error:.1f} mm 30 s ahead (rms)")
    found = ", ".join(f"{n} ({event})" for event, n in events.items())
    print(f"rises at the same instant, {AHEAD_S[-1]:.0f} s ahead, by event: {found}")


if __name__ == "__main__":
    main()
