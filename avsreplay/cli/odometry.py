"""``avsreplay odometry``: poses of an unknown target by KISS-ICP, without a model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from avsreplay.cli.options import PATH, read_options, source_options
from avsreplay.cli.progress import tracked
from avsreplay.errors import UsageError

LEAST_POINTS = 50  # a scan with fewer is left out

EPILOG = """\b
Examples:
  avsreplay odometry scans.mcap -o poses.tum --crop-range 2,4
  avsreplay run poses.tum --backend poses --extent 1.5        estimate the motion from these poses"""


@click.command("odometry", epilog=EPILOG)
@click.argument("log", type=PATH)
@click.option("-o", "--output", required=True, type=PATH, help="The trajectory to write (TUM).")
@click.option(
    "--size", type=click.FloatRange(min=0.0, min_open=True), help="Size of the target [m]; default: of the first scan."
)
@click.option("--no-deskew", is_flag=True, help="Ignore the instants of the points.")
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@source_options
def odometry_command(
    log: Path, output: Path, size: float | None, no_deskew: bool, overwrite: bool, **reading: Any
) -> None:
    """Track an unknown target through the scans of LOG by KISS-ICP, without a model, and write its poses.

    The target takes the place of the world; crop what does not move with it. {C} is parallel to the camera frame of the
    first scan, its origin at the centroid of that scan. Errors accumulate: 'avsreplay model' builds a model with closed
    loops, and a registration to a model does not drift. The voxel is a hundredth of the size, as in kiss-icp.

    \f
    Raises:
        MissingBackend: kiss-icp is not installed.
        UsageError: no scan has enough points.
    """  # noqa: D301
    import numpy as np

    from avsreplay.files import STDOUT, check_output
    from avsreplay.log import open_source
    from avsreplay.register.backend import load_backend
    from avsreplay.register.kiss import KissOdometry
    from avsreplay.report.export import write_tum

    check_output(output, overwrite=overwrite)
    load_backend("kiss")  # reports where the library is not installed
    odometry, poses = None, []
    with open_source(log, read_options(reading)) as source:
        for scan in tracked(source.scans(), len(source), "odometry"):
            if len(scan.points) < LEAST_POINTS:
                continue
            if odometry is None:
                odometry = KissOdometry(size or float(np.linalg.norm(np.ptp(scan.points, axis=0))), not no_deskew)
            pose, after_s = odometry.add(scan.points, scan.times_s)
            poses.append((scan.t_ns + round(1e9 * after_s), pose))
    if not poses:
        raise UsageError(f"no scan has {LEAST_POINTS} points", where=str(log), hint="check the crop and --topic")
    click.echo(f"{output}: {write_tum(output, poses)} poses", err=output == STDOUT)
