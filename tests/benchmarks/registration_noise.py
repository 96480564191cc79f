"""Is the registration's covariance right, and how long do its errors stay alike? Seeded tumbles of the built-in target.

python tests/benchmarks/registration_noise.py [--quick] [--seeds FIRST END] [--seconds S] [--hz HZ]

Prints the normalised error squared per degree of freedom (1 is right), its share inside the 95 % band, how often it
exceeds upper points of chi-square with 6 degrees of freedom and of Hotelling's T-squared with the degrees of freedom of
each covariance, and the autocorrelation of the whitened error against the turn between two scans.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.stats import chi2, f
from true_scans import true_scans

from avsreplay import geometry, toml_document
from avsreplay.register import Registrar
from avsreplay.simulate import builtin_surface, scenario_of, simulate

TURNS_RAD = (0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.2, 1.6)
RATE_RADPS = 0.1
TAILS = (0.05, 0.01, 0.001, 0.0001)
BAND = (1.2373, 14.4494)  # chi-square with 6 degrees of freedom, 95 %


def scenario(seed: int, duration_s: float, hz: float) -> str:
    rng = np.random.default_rng(seed)
    q, axis = geometry.normalise(rng.normal(size=4)), rng.normal(size=3)
    rate = RATE_RADPS * axis / np.linalg.norm(axis)
    return (
        f"seed = {seed}\nduration_s = {duration_s}\nrate_hz = {hz}\n[motion]\n"
        f"attitude_xyzw = {q.tolist()}\nrate_radps = {rate.tolist()}\nposition_m = [0.1, -0.1, 5.0]\n"
    )


def whitened(seed: int, duration_s: float, hz: float) -> tuple[np.ndarray, np.ndarray]:
    """(n, 6) whitened errors of the registration along one tumble, NaN where the view is degenerate; (n,) their dof."""
    surface = builtin_surface()
    simulated = simulate(scenario_of(toml_document.parse(scenario(seed, duration_s, hz), "noise")), surface)
    registrar, out, dof = Registrar(surface), [], []
    for scan in true_scans(simulated):
        found = registrar.register(scan.points, scan.truth)
        error = found.T_ac.inverse() @ scan.truth
        d = np.concatenate([geometry.log(error.q), error.t])
        out.append(np.full(6, np.nan) if found.covariance is None else _white(found.covariance, d))
        dof.append(found.dof)
    return np.array(out), np.array(dof)


def _white(covariance: np.ndarray, d: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return vectors @ ((vectors.T @ d) / np.sqrt(values))


def autocorrelation(w: np.ndarray, lag: int) -> float:
    return float(np.nansum(w[lag:] * w[:-lag]) / np.nansum(w * w) * len(w) / (len(w) - lag))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="three short tumbles")
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 12))
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--hz", type=float, default=5.0)
    args = parser.parse_args()
    seeds, duration_s = (range(3), 40.0) if args.quick else (range(*args.seeds), args.seconds)
    found = [whitened(seed, duration_s, args.hz) for seed in seeds]
    runs = [w for w, _ in found]
    sizes, dof = np.concatenate([(w**2).sum(axis=1) for w in runs]), np.concatenate([n for _, n in found])
    sizes, dof = sizes[np.isfinite(sizes)], dof[np.isfinite(sizes)]
    print(f"{len(runs)} tumbles, {len(sizes)} scans")
    print(f"mean normalised error squared per degree of freedom  {sizes.mean() / 6:.3f}")
    print(f"median over the law's median                         {np.median(sizes) / 5.348:.3f}")
    print(f"inside the 95 % band                                 {np.mean((sizes > BAND[0]) & (sizes < BAND[1])):.3f}")
    print("degrees of freedom, 5, 50 and 95 %                   ", *np.percentile(dof, (5, 50, 95)).round())
    exact = f.sf(sizes * (dof - 5.0) / (6.0 * dof), 6, dof - 5.0)
    print("probability  expected  beyond chi-square  beyond T-squared")
    for tail in TAILS:
        beyond = np.sum(sizes > chi2.isf(tail, 6)), np.sum(exact < tail)
        print(f"{tail:11.4f}  {tail * len(sizes):8.1f}  {beyond[0]:17}  {beyond[1]:16}")
    print("turn between scans [rad]  autocorrelation of the whitened error")
    for turn in TURNS_RAD:
        lag = max(1, round(turn * args.hz / RATE_RADPS))
        print(f"{turn:24.2f}  {np.mean([autocorrelation(w, lag) for w in runs]):.3f}")


if __name__ == "__main__":
    main()
