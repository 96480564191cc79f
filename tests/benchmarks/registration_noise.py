"""Is the registration's covariance right, and how long do its errors stay alike? Seeded tumbles of the built-in target.

python tests/benchmarks/registration_noise.py [--quick]

Prints the normalised error squared per degree of freedom (1 is right), its share inside the 95 % band, and the
autocorrelation of the whitened error against the turn between two scans.
"""

from __future__ import annotations

import argparse

import numpy as np
from true_scans import true_scans

from avsreplay import geometry, toml_document
from avsreplay.register import Registrar
from avsreplay.simulate import builtin_surface, scenario_of, simulate

TURNS_RAD = (0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.2, 1.6)
BAND = (1.2373, 14.4494)  # chi-square with 6 degrees of freedom, 95 %


def scenario(seed: int, duration_s: float) -> str:
    rng = np.random.default_rng(seed)
    q, axis = geometry.normalise(rng.normal(size=4)), rng.normal(size=3)
    rate = 0.1 * axis / np.linalg.norm(axis)
    return (
        f"seed = {seed}\nduration_s = {duration_s}\nrate_hz = 5.0\n[motion]\n"
        f"attitude_xyzw = {q.tolist()}\nrate_radps = {rate.tolist()}\nposition_m = [0.1, -0.1, 5.0]\n"
    )


def whitened(seed: int, duration_s: float) -> np.ndarray:
    """(n, 6) whitened errors of the registration along one tumble, NaN where the view is degenerate."""
    surface = builtin_surface()
    simulated = simulate(scenario_of(toml_document.parse(scenario(seed, duration_s), "noise")), surface)
    registrar, out = Registrar(surface), []
    for scan in true_scans(simulated):
        found = registrar.register(scan.points, scan.truth)
        error = found.T_ac.inverse() @ scan.truth
        d = np.concatenate([geometry.log(error.q), error.t])
        out.append(np.full(6, np.nan) if found.covariance is None else _white(found.covariance, d))
    return np.array(out)


def _white(covariance: np.ndarray, d: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return vectors @ ((vectors.T @ d) / np.sqrt(values))


def autocorrelation(w: np.ndarray, lag: int) -> float:
    return float(np.nansum(w[lag:] * w[:-lag]) / np.nansum(w * w) * len(w) / (len(w) - lag))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="three short tumbles")
    args = parser.parse_args()
    seeds, duration_s = (range(3), 40.0) if args.quick else (range(12), 120.0)
    runs = [whitened(seed, duration_s) for seed in seeds]
    sizes = np.concatenate([(w**2).sum(axis=1) for w in runs])
    sizes = sizes[np.isfinite(sizes)]
    print(f"{len(runs)} tumbles, {len(sizes)} scans")
    print(f"mean normalised error squared per degree of freedom  {sizes.mean() / 6:.3f}")
    print(f"median over the law's median                         {np.median(sizes) / 5.348:.3f}")
    print(f"inside the 95 % band                                 {np.mean((sizes > BAND[0]) & (sizes < BAND[1])):.3f}")
    print("turn between scans [rad]  autocorrelation of the whitened error")
    for turn in TURNS_RAD:
        print(f"{turn:24.2f}  {np.mean([autocorrelation(w, max(1, round(turn / 0.02))) for w in runs]):.3f}")


if __name__ == "__main__":
    main()
