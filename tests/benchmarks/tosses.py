"""Real free flights of a thrown cube that end in an impact: poses as the measurement, gravity as a
known acceleration.

``python tests/benchmarks/tosses.py [--data ../shared/data/cube-tosses] [--count 300] [--sigma
0.05,0.05] [--set A=B]``

The acceleration is the median over the flights of one half of the tosses and is used for the other
half. The instant of the first impact is determined here, without the code under test: the first of
two successive samples that are more than 0.5 mm or 0.3 deg off a motion with constant acceleration
and constant world rate (the cube's inertia is isotropic) that was fitted to the samples before the
lowest corner comes under 5 mm. It lies in the interval before that sample.

Printed: the acceleration; impacts found as manoeuvres within 2 samples, and how many samples later
that was decided; manoeuvres and new initialisations in free flight; NIS in flight; and the error of
predictions 7 and 15 samples (47 and 101 ms) ahead within the flight against their own covariance,
the noise of the sample added.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from avsreplay import geometry
from avsreplay.config import load_config
from avsreplay.estimate.acceleration import fit_acceleration
from avsreplay.estimate.estimator import Estimator
from avsreplay.estimate.measurement import innovation_vector, measurement_jacobian
from avsreplay.estimate.track import Track
from avsreplay.geometry import Array, MeasuredPose, Pose
from avsreplay.log import SourceOptions
from avsreplay.register.backend import measured_alignment
from avsreplay.run import Job, Run

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "cube-tosses"
EPOCH_NS, AHEAD, FEWEST = 1_000_000_000, (7, 15), 10
EXTENT_M, AFTER = 0.1815, 12  # of the cube; samples replayed after the impact
BAND = (1.237, 14.449)  # 95 % of chi-square with 6 degrees of freedom


@dataclass(frozen=True, eq=False)
class Toss:
    """Times [s] and poses of a toss; ``flight`` is the number of samples before the impact."""

    number: int
    times: Array
    poses: list[Pose]
    flight: int

    @property
    def impact_s(self) -> float:
        """Middle of the interval in which the impact lies."""
        return float(self.times[self.flight - 1 : self.flight + 1].mean())


@dataclass
class Found:
    """What the replay of one toss gave."""

    manoeuvre_s: float | None = None  # nearest to the impact
    delay: int = 0
    false_manoeuvres: int = 0
    reinitialised: int = 0
    nis: list[float] = field(default_factory=list)
    predictions: dict[int, list[tuple[float, float, float]]] = field(default_factory=dict)


def tosses(data: Path, count: int) -> list[Toss]:
    """The tosses whose impact can be determined and whose flight has at least ``FEWEST``
    samples.
    """
    rows: dict[int, list[dict[str, str]]] = {}
    with (data / "tosses.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            rows.setdefault(int(row["toss"]), []).append(row)
    found = [_toss(number, rows[number]) for number in sorted(rows)[:count]]
    return [toss for toss in found if toss is not None and toss.flight >= FEWEST]


def _toss(number: int, rows: list[dict[str, str]]) -> Toss | None:
    times = np.array([float(r["t_s"]) for r in rows])
    t = np.array([[float(r[f"p{axis}_m"]) for axis in "xyz"] for r in rows])
    q = np.array([[float(r[f"q{axis}"]) for axis in "xyzw"] for r in rows])
    poses = [Pose(a, b) for a, b in zip(q, t, strict=True)]
    near = next((k for k, r in enumerate(rows) if r["free_flight"] == "0"), 0)
    clear = near - 1
    if clear < 6:
        return None
    turns = geometry.log(
        geometry.multiply(q, geometry.conjugate(q[0]))
    )  # world frame, relative to the first
    turns = np.unwrap(turns, axis=0) if np.abs(turns[:clear]).max() < 3.0 else turns
    rate = np.linalg.lstsq(times[:clear, None], turns[:clear], rcond=None)[0]
    straight = np.vander(times, 3)
    motion = np.linalg.lstsq(straight[:clear], t[:clear], rcond=None)[0]
    off = np.linalg.norm(t - straight @ motion, axis=1) > 0.5e-3
    predicted = geometry.multiply(geometry.exp(times[:, None] * rate), q[0])
    off |= np.degrees(geometry.angle(geometry.multiply(geometry.conjugate(predicted), q))) > 0.3
    first = next((k for k in range(clear - 1, len(off) - 1) if off[k] and off[k + 1]), None)
    return None if first is None else Toss(number, times, poses, first)


def acceleration(
    flights: list[Toss], sigma: tuple[float, float], settings: tuple[str, ...]
) -> tuple[Array, Array, Array]:
    """Median over flights, its standard error by their spread, and that spread in units of the
    claimed 1 sigma.
    """
    C = covariance(sigma)
    params = load_config(None, {}, settings).estimator.resolved(EXTENT_M)
    means, sigmas = [], []
    for toss in flights:
        pairs = zip(toss.times[: toss.flight], toss.poses[: toss.flight], strict=True)
        found = fit_acceleration(
            [(round(t * 1e9), measured_alignment(MeasuredPose(T, C))) for t, T in pairs], params
        )
        means.append(found.mean)
        sigmas.append(np.sqrt(np.diagonal(found.P)))
    mean = np.median(means, axis=0)
    spread = 1.4826 * np.median(np.abs(means - mean), axis=0)
    return (
        mean,
        1.2533 * spread / np.sqrt(len(means)),
        1.4826 * np.median(np.abs((means - mean) / sigmas), axis=0),
    )


def covariance(sigma: tuple[float, float]) -> Array:
    """(6, 6) of d = [theta; v] from position [mm] and attitude [deg]."""
    return np.diag(np.repeat([np.radians(sigma[1]), 1e-3 * sigma[0]], 3) ** 2)


def replayed(
    toss: Toss,
    gravity: Array,
    sigma: tuple[float, float],
    folder: Path,
    assignments: tuple[str, ...] = (),
) -> Found:
    """Replay a toss to some samples after its impact."""
    path = folder / "toss.tum"
    pairs = list(zip(toss.times, toss.poses, strict=True))[: toss.flight + AFTER]
    lines = [
        " ".join(map(repr, [EPOCH_NS * 1e-9 + float(t), *T.t.tolist(), *T.q.tolist()]))
        for t, T in pairs
    ]
    path.write_text("\n".join(lines))
    settings = (
        "register.backend=poses",
        f"estimator.acceleration_mps2={gravity.tolist()}",
        *assignments,
    )
    options = SourceOptions(pose_sigma=sigma, extent_m=EXTENT_M)
    out = Found(predictions={n: [] for n in AHEAD})
    with Run(Job(source=path, options=options, assignments=settings, prefetch=0)) as run:
        last: list[Track] = []
        for row in run.rows([lambda scan: last.append(scan.state.track)]):
            track = last[-1]
            if row.seq < toss.flight:
                if row.seq >= 3 and row.nis is not None:
                    out.nis.append(row.nis)
                for n in AHEAD:
                    if row.seq >= FEWEST - 1 and row.seq + n < toss.flight:
                        out.predictions[n].append(
                            prediction(run.estimator, track, toss, row.seq + n, sigma)
                        )
            _impact(out, toss, track, row.seq)
        out.reinitialised = track.reinitialised
    return out


def _impact(out: Found, toss: Toss, track: Track, seq: int) -> None:
    dt = float(np.median(np.diff(toss.times)))
    times = [(m.t_ns - EPOCH_NS) * 1e-9 for m in track.manoeuvres]
    out.false_manoeuvres = sum(t < toss.impact_s - 2.5 * dt for t in times)
    near = min(times, key=lambda t: abs(t - toss.impact_s), default=None)
    if near is not None and out.manoeuvre_s is None:
        out.manoeuvre_s, out.delay = near, seq - toss.flight + 1


def prediction(
    estimator: Estimator, track: Track, toss: Toss, k: int, sigma: tuple[float, float]
) -> tuple[float, float, float]:
    """Position error [m], attitude error [deg] and NEES of the pose predicted for sample k, its
    noise included.
    """
    belief = estimator.predict(track, EPOCH_NS + round(float(toss.times[k]) * 1e9)).belief
    x = estimator.frame.belief_out(belief).x
    e, H = innovation_vector(x, toss.poses[k]), measurement_jacobian(x)
    R = np.diag(np.repeat([1e-3 * sigma[0], 0.5 * np.radians(sigma[1])], 3) ** 2)
    S = H @ belief.P @ H.T + R
    angle = 2.0 * np.degrees(np.arcsin(min(1.0, float(np.linalg.norm(e[3:])))))
    return float(np.linalg.norm(e[:3])), float(angle), float(e @ np.linalg.solve(S, e))


def share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100.0 * part / max(whole, 1):.1f} %)"


def report(flights: list[Toss], results: list[Found]) -> None:
    """Print the figures of all tosses."""
    dt = float(np.median(np.diff(flights[0].times)))
    off = [
        np.inf if f.manoeuvre_s is None else abs(f.manoeuvre_s - t.impact_s) / dt
        for t, f in zip(flights, results, strict=True)
    ]
    print(
        f"flights of {min(t.flight for t in flights)} to {max(t.flight for t in flights)} samples:"
        f" {len(flights)}"
    )
    for limit in (1.0, 2.0):
        print(
            f"impacts found as a manoeuvre within {limit:g} samples:"
            f" {share(sum(o <= limit for o in off), len(off))}"
        )
    delays = [f.delay for f, o in zip(results, off, strict=True) if o <= 2.0]
    if delays:
        print(
            f"decided after: median {np.median(delays):g}, at most {max(delays)} samples of the"
            " impact"
        )
    samples = sum(t.flight for t in flights)
    false = sum(f.false_manoeuvres for f in results)
    print(f"manoeuvres reported in free flight: {false} in {samples} samples")
    print(f"tosses with a new initialisation instead: {sum(f.reinitialised > 0 for f in results)}")
    nis = np.array([v for f in results for v in f.nis])
    inside = float(np.mean((nis > BAND[0]) & (nis < BAND[1])))
    print(
        f"NIS in flight: mean {nis.mean():.2f}, median {np.median(nis):.2f} (5.35),"
        f" {100 * inside:.1f} % in 95 % band"
    )
    for n in AHEAD:
        found = np.array([v for f in results for v in f.predictions[n]]).reshape(-1, 3)
        if len(found):
            inside = float(np.mean((found[:, 2] > BAND[0]) & (found[:, 2] < BAND[1])))
            above = float(np.mean(found[:, 2] >= BAND[1]))
            low, high = np.median(found, axis=0), np.quantile(found, 0.95, axis=0)
            print(f"{1e3 * n * dt:.0f} ms ahead, {len(found)} predictions, median and 95 %:")
            print(
                f"  position {1e3 * low[0]:.2f}, {1e3 * high[0]:.2f} mm; attitude {low[1]:.3f},"
                f" {high[1]:.3f} deg"
            )
            print(
                f"  NEES median {low[2]:.2f} (5.35), {100 * inside:.1f} % in the band,"
                f" {100 * above:.1f} % above"
            )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--sigma", default="0.05,0.05", help="1 sigma of the poses: mm,deg")
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="A=B", help="as for run"
    )
    options = parser.parse_args()
    position_mm, attitude_deg = (float(v) for v in options.sigma.split(","))
    sigma, settings = (position_mm, attitude_deg), tuple(options.settings)
    flights = tosses(options.data, options.count)
    halves = [
        acceleration([t for t in flights if t.number % 2 == odd], sigma, settings) for odd in (0, 1)
    ]
    for name, (mean, error, spread) in zip(("even", "odd"), halves, strict=True):
        values = ", ".join(f"{m:.3f} +- {e:.3f}" for m, e in zip(mean, error, strict=True))
        over = ", ".join(f"{v:.1f}" for v in spread)
        print(
            f"acceleration of the {name} tosses [m/s2]: {values}; spread in units of the claimed"
            f" sigma: {over}"
        )
    with tempfile.TemporaryDirectory() as folder:
        results = [
            replayed(t, halves[1 - t.number % 2][0], sigma, Path(folder), settings) for t in flights
        ]
    report(flights, results)
    for toss, found in zip(flights, results, strict=True):
        if found.false_manoeuvres:
            print(f"toss {toss.number}: manoeuvre in free flight")


if __name__ == "__main__":
    main()
