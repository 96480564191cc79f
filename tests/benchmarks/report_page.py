"""How long a report page takes to build and to open, and how large it is.

python tests/benchmarks/report_page.py [--quick]
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from avsreplay.geometry import Pose, exp
from avsreplay.records import Surface
from avsreplay.report.page import build_page
from avsreplay.report.summary import Summary
from avsreplay.report.view import View, thin_cloud, thin_surface
from avsreplay.rows import Row, field_types
from avsreplay.simulate.target import builtin_surface

STEP_NS = 200_000_000


def made_up(n: int, seed: int = 0) -> tuple[list[Row], list[tuple[int, Pose]]]:
    """Rows with every number filled in at random, and true poses."""
    rng = np.random.Generator(np.random.PCG64(seed))
    types = field_types()
    fill = {
        str: lambda: "ok",
        int: lambda: 3,
        float: lambda: float(rng.normal()),
        bool: lambda: True,
    }
    rows, poses = [], []
    for k in range(n):
        pose = Pose(exp([0.02 * k, 0.3, 0.01 * k]), [0.3, 0.2, 5.0])
        row = Row(**{name: fill[kind]() for name, (kind, _) in types.items()})
        where = dict(
            zip(
                ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"),
                map(float, (*pose.t, *pose.q)),
                strict=True,
            )
        )
        blind = 300 <= k % 600 < 360
        row = dataclasses.replace(
            row,
            seq=k,
            t_ns=k * STEP_NS,
            t_s=k * STEP_NS * 1e-9,
            gamma=int(not blind),
            reason="no_scan" if blind else "ok",
            fault="occlusion" if blind else None,
            action="approach",
            **where,
        )
        rows.append(row)
        poses.append((row.t_ns, pose))
    return rows, poses


def clouds(rows: list[Row], poses: list[tuple[int, Pose]], surface: Surface) -> View:
    """300 noisy points of the model a scan."""
    rng = np.random.Generator(np.random.PCG64(1))
    kept = []
    for row, (_, pose) in zip(rows, poses, strict=True):
        chosen = surface.vertices[rng.integers(0, len(surface.vertices), 300)]
        noise = rng.normal(0.0, 0.008, chosen.shape)
        kept.append(thin_cloud(row.seq, pose.apply(chosen + noise), np.linalg.norm(noise, axis=1)))
    vertices, faces = thin_surface(surface)
    return View(vertices, faces, tuple(kept))


def opened(path: Path, times: int) -> tuple[float, float] | None:
    """Medians [ms] until the page answers and from a slider move to its frame; None without a
    browser.
    """
    if not (shutil.which("chromium") and shutil.which("chromedriver")):
        return None
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    flags = (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--window-size=1280,900",
    )
    for flag in (*flags, "--enable-unsafe-swiftshader"):
        options.add_argument(flag)
    service = webdriver.ChromeService(shutil.which("chromedriver"))
    browser = webdriver.Chrome(options=options, service=service)
    move = """const done = arguments[1], s = document.getElementById('slider');
    const t = performance.now();
    s.value = arguments[0]; s.dispatchEvent(new Event('input'));
    requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - t)))"""
    ready, moves = [], []
    try:
        for k in range(times):
            browser.get(path.as_uri())
            ready.append(
                float(browser.execute_script("return document.documentElement.dataset.ready"))
            )
            moves += [float(browser.execute_async_script(move, 20 * k + j)) for j in range(10)]
    finally:
        browser.quit()
    return statistics.median(ready), statistics.median(moves)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="600 scans only")
    quick = parser.parse_args().quick
    surface = builtin_surface()
    print("| scans | built in [s] | size [MB] | answers after [ms] | slider to frame [ms] |")
    print("|---|---|---|---|---|")
    for n in (600,) if quick else (600, 6000):
        rows, poses = made_up(n)
        view, summary = clouds(rows, poses, surface), Summary.fold(rows)
        begun = time.perf_counter()
        page = build_page(rows, summary, {}, poses=poses, view=view)
        built = time.perf_counter() - begun
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "page.html"
            path.write_text(page, encoding="utf-8")
            found = opened(path, 3 if quick else 7)
        browser = "no browser | " if found is None else f"{found[0]:.0f} | {found[1]:.0f}"
        print(f"| {n} | {built:.2f} | {len(page) / 1e6:.2f} | {browser} |")


if __name__ == "__main__":
    main()
