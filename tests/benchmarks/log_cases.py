"""Small logs for the tests and campaigns of the readers: seeded, with every kind of content."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avsreplay import geometry
from avsreplay.geometry import Pose
from avsreplay.log import LogWriter
from avsreplay.records import Belief, Label, LogHeader, Scan, State, Surface

SECOND = 1_000_000_000


def state(rng: np.random.Generator) -> State:
    unit = geometry.normalise(rng.normal(size=(2, 4)))
    return State(
        unit[0], *rng.normal(size=(3, 3)), rng.uniform(-0.5, 0.5, 2), rng.normal(size=3), unit[1]
    )


def header(rng: np.random.Generator) -> LogHeader:
    surface = Surface(
        rng.normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]], np.int32), "part.ply", ""
    )
    root = rng.normal(size=(20, 20))
    return LogHeader(
        surface=surface,
        scenario="[target]\nname = 'π'\n",
        seed=7,
        labels=(
            Label("occlusion", 2 * SECOND, 3 * SECOND, True, 0.3),
            Label("dropped", 4 * SECOND, 5 * SECOND),
            Label("bias", 2 * SECOND + SECOND // 2, 9 * SECOND, False),
        ),
        start=Belief(SECOND, state(rng), root @ root.T),
        truth=state(rng),
        notes={"source": "test", "unit": "m"},
    )


def scans(count: int = 12, points: int = 300, timed: bool = False) -> list[Scan]:
    out = []
    for i in range(count):
        rng = np.random.Generator(np.random.PCG64(i))
        cloud = rng.normal(size=(points, 3)).astype(np.float32)
        times = np.linspace(0, 0.1, points, dtype=np.float32) if timed else None
        out.append(
            Scan(
                i,
                SECOND + i * SECOND // 2,
                cloud,
                times_s=times,
                log_ns=SECOND + i * SECOND // 2 + 5,
            )
        )
    return out


def write(
    path: Path, head: LogHeader, clouds: list[Scan], **options: object
) -> list[tuple[Pose, State]]:
    rng = np.random.Generator(np.random.PCG64(99))
    truth = [(Pose(rng.normal(size=4), rng.normal(size=3)), state(rng)) for _ in clouds]
    with LogWriter(path, head, **options) as writer:  # type: ignore[arg-type]
        for scan, (pose, body) in zip(clouds, truth, strict=True):
            writer.write(scan)
            writer.write_truth(scan.log_ns, scan.t_ns, pose, body)
    return truth
