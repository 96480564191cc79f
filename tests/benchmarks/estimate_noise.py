"""Is the registration's covariance right, and how long do its errors stay alike: target by target,
against the truth.

python tests/benchmarks/estimate_noise.py [--quick] [--target NAME]

Simulated flash scans of several meshes from 1.2 extents away, each turned by 0.02 rad from scan to
scan and registered from its true pose. Noise is in thousandths of the extent. Prints, of the
whitened error w = C^-1/2 d:

    size    mean w'w / 6: 1 is right
    share   autocorrelation at turns up to 0.06 rad: what two nearly equal views have in common
    k       share / (1 - share) over inliers (rms / extent)^2
    reach   sum of the autocorrelations over the turn, over the share [rad]
    colour  1 + 2 sum of the autocorrelations: how many times less such poses say than white ones
    const   the colour of CONST over REACH_RAD, whatever the scan
    law     the colour of share / (1 - share) = K inliers (rms / extent)^2 over REACH_RAD
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from true_scans import true_scans

from avsreplay import geometry, toml_document
from avsreplay.geometry import Array
from avsreplay.log import parse_surface, read_surface
from avsreplay.records import AlignStatus, Surface
from avsreplay.register.registrar import Registrar
from avsreplay.simulate.scenario import scenario_of
from avsreplay.simulate.simulation import simulate
from avsreplay.simulate.target import Shape, box, builtin_surface, frustum, join, ply_bytes

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
TURN_RAD, FARTHEST_RAD, NEAR_RAD = 0.02, 0.6, 0.06
RATE_RADPS, RATE_HZ = 0.1, 5.0
NOISE = (0.0005, 0.002, 0.004)  # of the extent
RAYS = (48, 100)  # a side
K, CONST, REACH_RAD = 20.0, 0.1, 0.4


@dataclass(frozen=True)
class Plan:
    """Tumbles a cell and scans a tumble."""

    tumbles: int
    scans: int


def meshes() -> Iterator[tuple[str, Surface]]:
    """The targets by name."""
    yield "satellite", builtin_surface()
    yield "bracket", builtin_surface(Shape.BRACKET)
    yield "box", _made("box", [box((-1.0, -0.8, -0.35), (0.0, 0.8, 0.35))])
    yield (
        "stage",
        _made("stage", [frustum(-3.0, 0.8, 0.0, 0.8, 48), frustum(-3.6, 0.7, -3.0, 0.3, 48)]),
    )
    for name, file in (("bunny", "bun_zipper_res3.ply"), ("dragon", "dragon_vrip_res3.ply")):
        path = DATA / f"stanford-{name}" / file
        if path.exists():
            yield name, read_surface(path)
        else:
            print(f"{name}: ../shared/data is not here")


def _made(name: str, parts: list) -> Surface:
    solid = join(parts)
    return parse_surface(ply_bytes(solid.vertices, solid.faces), f"{name}.ply")


def scenario(surface: Surface, noise: float, rays: int, seed: int, scans: int) -> str:
    """A tumble about the middle of the box from a drawn attitude."""
    rng = np.random.default_rng(seed)
    q, axis = geometry.normalise(rng.normal(size=4)), rng.normal(size=3)
    rate = RATE_RADPS * axis / np.linalg.norm(axis)
    extent = surface.extent
    centre = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    return (
        f"seed = {seed}\nduration_s = {scans / RATE_HZ}\nrate_hz = {RATE_HZ}\n"
        "[target]\nmoments_m2 = [1.0, 1.1, 1.2]\naxes_xyzw = [0.0, 0.0, 0.0, 1.0]\n"
        f"mass_centre_m = {centre.tolist()}\n"
        f"[motion]\nattitude_xyzw = {q.tolist()}\nrate_radps = {rate.tolist()}\n"
        f"position_m = [0.0, 0.0, {1.2 * extent}]\n"
        f"[scanner]\nfov_deg = [48.0, 48.0]\nrays = [{rays}, {rays}]\nnoise_m = {noise * extent}\n"
        f"range_min_m = {0.2 * extent}\nrange_max_m = {3.0 * extent}\noutlier_ratio = 0.02\n"
    )


def whitened(surface: Surface, registrar: Registrar, text: str) -> tuple[Array, Array]:
    """(n, 6) whitened errors along one tumble, NaN where the view is degenerate; (n,) inliers
    (rms / extent)^2.
    """
    out, edge = [], []
    for scan in true_scans(simulate(scenario_of(toml_document.parse(text, "noise")), surface)):
        found = registrar.register(scan.points, scan.truth)
        error = found.T_ac.inverse() @ scan.truth
        d = np.concatenate([geometry.log(error.q), error.t])
        certain = found.status is AlignStatus.ALIGNED and found.covariance is not None
        out.append(np.linalg.solve(_root(found.covariance), d) if certain else np.full(6, np.nan))
        edge.append(found.inliers * (found.rms_m / surface.extent) ** 2 if certain else np.nan)
    return np.array(out), np.array(edge)


def _root(C: Array) -> Array:
    """Symmetric square root: the same axes from scan to scan, which a Cholesky factor's are
    too but less evenly.
    """
    values, vectors = np.linalg.eigh(C)
    return (vectors * np.sqrt(values)) @ vectors.T


def autocorrelations(runs: list[Array]) -> Array:
    """Over lags 1 to FARTHEST_RAD / TURN_RAD, pairs with a degenerate view left out."""
    power = np.nanmean(np.concatenate([w * w for w in runs]))
    lags = range(1, round(FARTHEST_RAD / TURN_RAD) + 1)
    return np.array(
        [np.nanmean(np.concatenate([w[k:] * w[:-k] for w in runs])) / power for k in lags]
    )


def line(
    name: str, surface: Surface, registrar: Registrar, noise: float, rays: int, plan: Plan
) -> str:
    """One cell of the table."""
    seeds = range(plan.tumbles)
    found = [
        whitened(surface, registrar, scenario(surface, noise, rays, seed, plan.scans))
        for seed in seeds
    ]
    runs, edge = [w for w, _ in found], np.concatenate([x for _, x in found])
    every = np.concatenate(runs)
    good = np.isfinite(every[:, 0])
    head = f"{name:10} {1e3 * noise:5.1f} {rays:5} {good.mean():8.0%}"
    if good.mean() < 0.1:
        return head
    size, edge_mean = np.mean(every[good] ** 2), float(edge[good].mean())
    rho = autocorrelations(runs)
    share, area = rho[: round(NEAR_RAD / TURN_RAD)].mean(), rho.sum() * TURN_RAD
    law = K * edge_mean / (1.0 + K * edge_mean)
    shown = share > 0.02
    return (
        f"{head} {size:6.2f} {share:7.3f}"
        f" {share / (1.0 - share) / edge_mean if shown else np.nan:6.1f}"
        f" {area / share if shown else np.nan:6.2f} {1.0 + 2.0 * rho.sum():8.2f}"
        f" {_colour(CONST):6.1f} {_colour(law):6.1f}"
    )


def _colour(share: float) -> float:
    return 1.0 + 2.0 * share * REACH_RAD / TURN_RAD


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="two noise levels, one grid, shorter tumbles"
    )
    parser.add_argument("--target", help="only this one")
    args = parser.parse_args()
    plan = Plan(3, 80) if args.quick else Plan(5, 120)
    print("target     noise  rays  certain   size   share      k  reach   colour  const    law")
    for name, surface in meshes():
        if args.target not in (None, name):
            continue
        registrar = Registrar(surface)
        for rays in RAYS[1:] if args.quick else RAYS:
            for noise in NOISE[:2] if args.quick else NOISE:
                print(line(name, surface, registrar, noise, rays, plan), flush=True)


if __name__ == "__main__":
    main()
