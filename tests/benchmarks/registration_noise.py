"""Is the registration's covariance right, and how long do its errors stay alike? Seeded tumbles of
the built-in target.

python tests/benchmarks/registration_noise.py [--quick] [--seeds FIRST END] [--seconds S] [--hz HZ]
python tests/benchmarks/registration_noise.py --bodies [--names probe,guitar,hst,...] [--seed 1]
[--views 12]
                                [--draws 1] [--points 2000,4000,10000] [--noise
                                0.002,0.004,0.008,0.015]

Prints the normalised error squared per degree of freedom (1 is right), its share inside the 95 %
band, how often it exceeds upper points of chi-square with 6 degrees of freedom and of Hotelling's
T-squared with the degrees of freedom of each covariance, and the autocorrelation of the whitened
error against the turn between two scans.

With ``--bodies`` the scans are ray-cast views of thin bodies (``bodies.THIN``, a body of its own
for each view), of the meshes of ``scenes.py`` and of mesh files, with noise of a share of the
extent along the rays. ``--ranges`` adds an error that varies over the image by waves of one to two
widths of the target, of a rms of so many times the noise. They are registered from 0.5 deg and
0.002 of the extent off. Printed for
each body, noise and number of points: the accepted scans, the normalised error squared per degree
of freedom (mean, median, largest), the median of the claimed standard deviation of the attitude,
that of the error, and of the processor time.
"""

from __future__ import annotations

import argparse
import time

import bodies
import numpy as np
import scenes
from scipy.stats import chi2, f
from true_scans import true_scans

from avsreplay import geometry, toml_document
from avsreplay.records import AlignStatus, Surface
from avsreplay.register.registrar import Registrar
from avsreplay.simulate.scenario import scenario_of
from avsreplay.simulate.simulation import simulate
from avsreplay.simulate.target import builtin_surface

TURNS_RAD = (0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.2, 1.6)
RATE_RADPS = 0.1
TAILS = (0.05, 0.01, 0.001, 0.0001)
BAND = (1.2373, 14.4494)  # chi-square with 6 degrees of freedom, 95 %


def scenario(seed: int, duration_s: float, hz: float) -> str:
    rng = np.random.default_rng(seed)
    q, axis = geometry.normalise(rng.normal(size=4)), rng.normal(size=3)
    rate = RATE_RADPS * axis / np.linalg.norm(axis)
    return (
        f"seed = {seed}\nduration_s = {duration_s}\nrate_hz = {hz}\n[motion]\nattitude_xyzw ="
        f" {q.tolist()}\nrate_radps = {rate.tolist()}\nposition_m = [0.1, -0.1, 5.0]\n"
    )


def whitened(seed: int, duration_s: float, hz: float) -> tuple[np.ndarray, np.ndarray]:
    """(n, 6) whitened errors of the registration along one tumble, NaN where the view is
    degenerate; (n,) their dof.
    """
    surface = builtin_surface()
    simulated = simulate(
        scenario_of(toml_document.parse(scenario(seed, duration_s, hz), "noise")), surface
    )
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


def surface_for(name: str, seed: int, known: dict[str, Surface]) -> Surface:
    """A thin body of this seed, or a mesh."""
    if name in bodies.THIN:
        return bodies.surface_of(bodies.body(name, seed), name)
    if name not in known:
        known[name] = next(iter(scenes.meshes([name]).values()))
    return known[name]


def of_bodies(args: argparse.Namespace) -> None:
    """Print a row for each body, noise and number of points."""
    known: dict[str, Surface] = {}
    print(
        "body       noise  points  accepted  NEES  median  largest  claimed deg  error deg      ms"
    )
    for name in args.names.split(","):
        views = [
            (surface_for(name, args.seed + k, known), args.seed + 100 * k)
            for k in range(args.views)
        ]
        registrars = {id(surface): Registrar(surface) for surface, _ in views}
        for noise in map(float, args.noise.split(",")):
            for count in map(int, args.points.split(",")):
                rows = []
                for surface, seed in views:
                    for draw in range(args.draws):
                        v = scenes.view(surface, count, seed + draw, noise=noise)
                        points = v.points + args.ranges * noise * surface.extent * waves(v)
                        guess, begun = scenes.off(v, 0.5, 0.002), time.process_time()
                        found = registrars[id(surface)].register(points, guess, 1)
                        rows.append((*_claims(found, v.T_ac), 1e3 * (time.process_time() - begun)))
                used = np.array([row for row in rows if np.isfinite(row[0])]).reshape(-1, 4)
                nees = used[:, 0] if len(used) else np.full(1, np.nan)
                claimed, error = (np.median(used[:, k]) if len(used) else np.nan for k in (1, 2))
                what = f"{name:9} {noise:6.4f} {count:7} {len(used):4}/{len(rows):<4}"
                size = (
                    f"{nees.mean():5.2f} {np.median(nees):7.2f} {nees.max():8.1f} {claimed:12.3f}"
                    f" {error:10.3f}"
                )
                print(f"{what} {size} {np.median([row[3] for row in rows]):7.2f}", flush=True)


def waves(v: scenes.View) -> np.ndarray:
    """Displacements (n, 3) along the rays that vary slowly over the image, of a rms of 1."""
    rng = np.random.default_rng(int(1e9 * abs(v.points[0, 0])))
    image = v.points[:, :2] / v.points[:, 2:]
    image = image / np.ptp(image, axis=0).max()
    turn, size = rng.uniform(0.0, 2.0 * np.pi, 4), rng.uniform(0.5, 1.0, 4)
    k = 2.0 * np.pi * size * np.stack([np.cos(turn), np.sin(turn)])
    e = np.cos(image @ k + rng.uniform(0.0, 2.0 * np.pi, 4)) @ rng.standard_normal(4)
    rays = v.points / np.linalg.norm(v.points, axis=1, keepdims=True)
    return rays * (e / np.sqrt(np.mean(e**2)))[:, None]


def _claims(found: object, truth: geometry.Pose) -> tuple[float, float, float]:
    """Normalised error squared over 6, claimed deviation and error of the attitude [deg];
    NaN: not accepted.
    """
    if found.status is not AlignStatus.ALIGNED or found.covariance is None:
        return np.nan, np.nan, np.nan
    error, P = found.T_ac.inverse() @ truth, found.covariance
    d = np.concatenate([geometry.log(error.q), error.t])
    claimed = np.degrees(np.sqrt(np.trace(P[:3, :3])))
    return float(d @ np.linalg.solve(P, d)) / 6.0, claimed, np.degrees(np.linalg.norm(d[:3]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", action="store_true", help="views of thin bodies and of meshes")
    parser.add_argument("--names", default=",".join([*bodies.THIN, "hst", "kepler"]))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--points", default="2000,4000,10000")
    parser.add_argument("--noise", default="0.002,0.004,0.008,0.015")
    parser.add_argument("--ranges", type=float, default=0.0, help="see above")
    parser.add_argument("--quick", action="store_true", help="three short tumbles")
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 12))
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--hz", type=float, default=5.0)
    args = parser.parse_args()
    if args.bodies:
        of_bodies(args)
        return
    seeds, duration_s = (range(3), 40.0) if args.quick else (range(*args.seeds), args.seconds)
    found = [whitened(seed, duration_s, args.hz) for seed in seeds]
    runs = [w for w, _ in found]
    sizes, dof = (
        np.concatenate([(w**2).sum(axis=1) for w in runs]),
        np.concatenate([n for _, n in found]),
    )
    sizes, dof = sizes[np.isfinite(sizes)], dof[np.isfinite(sizes)]
    print(f"{len(runs)} tumbles, {len(sizes)} scans")
    print(f"mean normalised error squared per degree of freedom  {sizes.mean() / 6:.3f}")
    print(f"median over the law's median                         {np.median(sizes) / 5.348:.3f}")
    print(
        "inside the 95 % band                                "
        f" {np.mean((sizes > BAND[0]) & (sizes < BAND[1])):.3f}"
    )
    print(
        "degrees of freedom, 5, 50 and 95 %                   ",
        *np.percentile(dof, (5, 50, 95)).round(),
    )
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
