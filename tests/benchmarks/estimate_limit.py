"""How well a covariance can be calibrated where the density of a random force is unknown: exact
inference.

``python tests/benchmarks/estimate_limit.py [--bodies 40]``.

A point fixed to a body that rotates at a known rate of 0.1 rad/s is seen at 2 Hz with 2 mm of white
noise; position, velocity and arm are unknown, and a random force may act. The Kalman filters of 38
densities, none among them, give the exact posterior probability of each. Printed per true density
and prior probability of none: mean and median NEES of the velocity per degree of freedom at four
instants, by the exact covariance (that of the mixture) and by single densities: the one for which
the posterior of all densities expects NEES 1, as the estimator uses, and that with the mean of
q^1.5. No code of the estimator is used.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
HZ, SIGMA_M, SECONDS, RATE = 2.0, 0.002, 80.0, 0.1
MARKS_S = (20.0, 40.0, 60.0, 80.0)
DENSITIES = np.concatenate([[0.0], np.logspace(-7.0, -2.5, 37)])
TRUE = (0.0, 1e-5, 3e-5, 1e-4)
FREE = (0.5, 0.9)
START = np.repeat([0.2, 0.25, 1.0], 3) ** 2
DT = 1.0 / HZ


def process(q: float) -> Array:
    """Covariance (9, 9) of one step."""
    Q = np.zeros((9, 9))
    Q[:3, :3], Q[3:6, 3:6] = np.eye(3) * DT**3 / 3.0, np.eye(3) * DT
    Q[:3, 3:6] = Q[3:6, :3] = np.eye(3) * DT**2 / 2.0
    return q * q * Q


def measured(q: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Rotations (n, 3, 3), measured positions (n, 3) and true velocities (n, 3) of one body."""
    n = round(SECONDS * HZ) + 1
    axis = rng.normal(size=3)
    turns = Rotation.from_rotvec(
        np.outer(RATE * DT * np.arange(n), axis / np.linalg.norm(axis))
    ).as_matrix()
    r, v, arm, seen, speeds = (
        np.zeros(3),
        0.005 * rng.normal(size=3),
        0.2 * rng.normal(size=3),
        [],
        [],
    )
    for k in range(n):
        if k:
            a, b = rng.normal(size=3), rng.normal(size=3)
            r = r + v * DT + q * DT**1.5 * (a / 2.0 + b / np.sqrt(12.0))
            v = v + q * np.sqrt(DT) * a
        seen.append(r + turns[k] @ arm + SIGMA_M * rng.normal(size=3))
        speeds.append(v)
    return turns, np.array(seen), np.array(speeds)


def filtered(turns: Array, seen: Array) -> list[tuple[Array, Array, Array]]:
    """At each mark the means (m, 9), covariances (m, 9, 9) and log likelihoods (m,) of all
    densities.
    """
    F, Q = np.eye(9), np.array([process(q) for q in DENSITIES])
    F[:3, 3:6] = DT * np.eye(3)
    x, P, log = np.zeros((len(Q), 9)), np.tile(np.diag(START), (len(Q), 1, 1)), np.zeros(len(Q))
    found = []
    for k, z in enumerate(seen):
        if k:
            x, P = x @ F.T, F @ P @ F.T + Q
        H = np.hstack([np.eye(3), np.zeros((3, 3)), turns[k]])
        S, e = H @ P @ H.T + SIGMA_M**2 * np.eye(3), z - x @ H.T
        K = P @ H.T @ np.linalg.inv(S)
        log = log - 0.5 * (
            np.einsum("mi,mi->m", e, np.linalg.solve(S, e[:, :, None])[:, :, 0])
            + np.linalg.slogdet(S)[1]
        )
        x, P = x + (K @ e[:, :, None])[:, :, 0], P - K @ H @ P
        if k * DT in MARKS_S:
            found.append((x, 0.5 * (P + P.swapaxes(1, 2)), log))
    return found


def nees(x: Array, P: Array, v: Array) -> float:
    """NEES of the velocity per degree of freedom."""
    e = x[3:6] - v
    return float(e @ np.linalg.solve(P[3:6, 3:6], e)) / 3.0


def in_use(x: Array, P: Array, w: Array) -> int:
    """Index of the density whose velocity has the expected NEES 1 under the posterior w; at
    most the rms density.
    """
    v, C, most = x[:, 3:6], P[:, 3:6, 3:6], float(w @ DENSITIES**2) ** 0.5
    for k, (mean, own) in enumerate(zip(v, C, strict=True)):
        about = np.einsum("m,mij->ij", w, C + (v - mean)[:, :, None] * (v - mean)[:, None, :])
        if np.trace(np.linalg.solve(own, about)) <= 3.0 or DENSITIES[k] > most:
            break
    return k


def step_power(hz: float, scans: int, sigma_m: float = SIGMA_M) -> float:
    """Power of the generalised likelihood ratio test against a step of the velocity of 1 cm/s after
    so many scans.

    Of a constant velocity, known from 45 s of positions with white noise, at a known instant half
    an interval before the first of these scans; 100 logs of 80 s have one false report in the mean.
    """
    from scipy.stats import chi2, ncx2

    t = np.append(np.arange(1.0 - 45.0 * hz, 1.0), np.arange(1.0, scans + 1.0)) / hz
    A, moved = (
        np.stack([np.ones_like(t), t], axis=1) / sigma_m,
        0.01 * np.maximum(t - 0.5 / hz, 0.0) / sigma_m,
    )
    left = moved - A @ np.linalg.lstsq(A, moved, rcond=None)[0]
    return float(ncx2.sf(chi2.isf(1.0 / (100 * 80.0 * hz), 3), 3, left @ left))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", type=int, default=40)
    parser.add_argument(
        "--step",
        action="store_true",
        help="instead, how soon a step of the velocity can be detected",
    )
    options = parser.parse_args()
    if options.step:
        for hz in (1.0, 2.0, 5.0, 10.0):
            print(
                f"{hz:.0f} Hz: "
                + ", ".join(f"{100.0 * step_power(hz, k, 2e-3):.0f} %" for k in range(1, 13))
            )
        return
    bodies, rng = options.bodies, np.random.Generator(np.random.PCG64(1))
    for q in TRUE:
        values = np.zeros((len(FREE), 3, len(MARKS_S), bodies))
        for body in range(bodies):
            turns, seen, speeds = measured(q, rng)
            for k, (x, P, log) in enumerate(filtered(turns, seen)):
                v = speeds[round(MARKS_S[k] * HZ)]
                for j, free in enumerate(FREE):
                    prior = np.append(
                        free, np.full(len(DENSITIES) - 1, (1.0 - free) / (len(DENSITIES) - 1))
                    )
                    w = prior * np.exp(log - log.max())
                    w /= w.sum()
                    mean = w @ x
                    exact = np.einsum(
                        "m,mij->ij", w, P + (x - mean)[:, :, None] * (x - mean)[:, None, :]
                    )
                    one = int(
                        np.argmin(np.abs(DENSITIES - float(w @ DENSITIES**1.5) ** (2.0 / 3.0)))
                    )
                    c = in_use(x, P, w)
                    values[j, :, k, body] = (
                        nees(mean, exact, v),
                        nees(x[c], P[c], v),
                        nees(x[one], P[one], v),
                    )
        for j, free in enumerate(FREE):
            for name, found in zip(("exact", "in use", "q^1.5"), values[j], strict=True):
                text = ", ".join(f"{np.mean(row):.2f} ({np.median(row):.2f})" for row in found)
                print(f"q {q:.0e} m/s^1.5, none {free}, {name:6}: {text}", flush=True)


if __name__ == "__main__":
    main()
