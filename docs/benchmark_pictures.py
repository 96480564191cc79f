"""Makes the picture of the benchmark's scenarios: ``python docs/benchmark_pictures.py LOGS DATA``.

LOGS is the folder ``logs`` of a benchmark, DATA the folder of the recordings of others. Each tile
shows one scan, coloured by distance from yellow (near) to blue; the toss shows its track.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from avsreplay.benchmark.prepare import prepare
from avsreplay.benchmark.suite import load_suite
from avsreplay.log import open_source

TILE, HEAD, ACROSS, SHARE = 220, 18, 6, 0.42  # pixels; tiles in a row; which scan of a log
AT = {"blocked-blackouts": 0.45, "wrong-gripper": 0.27, "wrong-object": 0.4}
NEAR, FAR = np.array([240.0, 228.0, 66.0]), np.array([0.0, 60.0, 140.0])
IMAGE = Path(__file__).resolve().parent / "images" / "benchmark-scenarios.png"


def points_of(log, share):
    """Points (n, 3) of a scan [m], x to the right, y down, z away; of a log of poses its track."""
    if log.poses:
        return np.loadtxt(log.source)[:, [1, 3, 2]] * [1.0, -1.0, 1.0]
    with open_source(Path(log.source), log.options) as source:
        points = np.asarray(source.scan_at(int(share * len(source))).points, dtype=float)
    if log.scenario == "real-turntable":  # y up, the sensor looks along -z
        return points * [1.0, -1.0, -1.0]
    if log.scenario == "real-lidar":  # x forward, y left, z up
        return np.column_stack([-points[:, 1], -points[:, 2], points[:, 0]])
    return points


def tile(points, name):
    """A picture of the points."""
    picture = Image.new("RGB", (TILE, TILE + HEAD), "white")
    draw = ImageDraw.Draw(picture)
    draw.text((6, 4), name, fill="black")
    if len(points):
        low, high = (np.quantile(points, q, axis=0) for q in (0.005, 0.995))
        scale = 0.9 * TILE / max(*(high - low)[:2], 1e-6)
        xy = (points[:, :2] - 0.5 * (low + high)[:2]) * scale + 0.5 * TILE
        depth = np.clip((points[:, 2] - low[2]) / max(high[2] - low[2], 1e-6), 0.0, 1.0)
        for (x, y), d in zip(xy, depth, strict=True):
            if 1 < x < TILE - 2 and 1 < y < TILE - 2:
                colour = tuple(int(c) for c in NEAR + d * (FAR - NEAR))
                draw.rectangle((x - 1, y + HEAD - 1, x + 1, y + HEAD + 1), fill=colour)
    draw.rectangle((0, 0, TILE - 1, TILE + HEAD - 1), outline="#bbbbbb")
    return picture


def main(logs, data):
    suite = load_suite()
    scenarios = suite.params.scenario
    rows = -(-len(scenarios) // ACROSS)
    sheet = Image.new("RGB", (ACROSS * TILE, rows * (TILE + HEAD)), "white")
    for k, scenario in enumerate(scenarios):
        log = prepare(suite, scenario, suite.params.seed, 0, Path(logs), Path(data))
        points = np.zeros((0, 3))
        if not log.missing:
            points = points_of(log, AT.get(scenario.name, SHARE))
        at = (k % ACROSS * TILE, k // ACROSS * (TILE + HEAD))
        sheet.paste(tile(points, scenario.name), at)
    sheet.quantize(64).save(IMAGE, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
