"""The fit against a turntable. ``python tests/benchmarks/estimate_turntable.py LOG``.

LOG is a recording of scans on a turntable with their true poses (``avsreplay record`` on the
dragon's folder). Printed: the last estimate's spin rate and axis against the truth's steps, the
scatter of these steps, the pose errors, and NIS.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from true_scans import true_scans

from avsreplay import geometry
from avsreplay.geometry import Array
from avsreplay.log import open_source
from avsreplay.run import Job, Run


def steps(log: Path) -> tuple[Array, Array]:
    """Rotation vectors (n, 3) in {A} from each true pose to the next [rad], and seconds between
    them (n,).
    """
    with open_source(log) as source:
        poses = [(scan.t_ns, scan.truth.q) for scan in true_scans(source) if scan.truth is not None]
    if len(poses) < 2:
        raise SystemExit(f"{log}: fewer than two true poses")
    q = np.array([q for _, q in poses])
    turns = geometry.log(geometry.multiply(q[1:], geometry.conjugate(q[:-1])))
    return turns, np.diff([t for t, _ in poses]) * 1e-9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    log = parser.parse_args().log
    turns, seconds = steps(log)
    rates = np.degrees(np.linalg.norm(turns, axis=1) / seconds)
    axis = np.sum(turns, axis=0) / np.linalg.norm(np.sum(turns, axis=0))
    with Run(Job(source=log, prefetch=0)) as run:
        rows = list(run.rows())
    last = rows[-1]
    q_ac = np.array([last.qx, last.qy, last.qz, last.qw])
    mu = np.array([last.mux, last.muy, last.muz, last.muw])
    w_a = (
        geometry.matrix(q_ac)
        @ geometry.matrix(mu).T
        @ np.array([last.wx_radps, last.wy_radps, last.wz_radps])
    )
    rate = np.degrees(np.linalg.norm(w_a))
    off = np.degrees(np.arccos(np.clip(w_a @ axis / np.linalg.norm(w_a), -1.0, 1.0)))
    used = [row for row in rows if row.gamma]
    print(
        f"truth: {rates.mean():.3f} deg/s over {len(rates)} steps, scatter {rates.std():.3f} deg/s"
    )
    print(f"estimate ({last.estimator}): {rate:.3f} deg/s, axis {off:.3f} deg off")
    for name, unit, scale in (
        ("pos_err_m", "mm", 1e3),
        ("rot_err_deg", "deg", 1.0),
        ("rms_m", "mm", 1e3),
    ):
        values = scale * np.array([getattr(row, name) for row in used])
        print(
            f"{name}: rms {np.sqrt(np.mean(values**2)):.3f} {unit}, largest {values.max():.3f}"
            f" {unit}"
        )
    print(
        f"NIS: median {np.median([row.nis for row in used]):.1f} (5.3 is right); consistent:"
        f" {last.consistent}"
    )


if __name__ == "__main__":
    main()
