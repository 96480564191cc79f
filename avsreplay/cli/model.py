"""``avsreplay model`` and ``avsreplay odometry``: an unknown target, with and without a model
built from its scans.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.config import Command
from avsreplay.cli.options import (
    PATH,
    Numbers,
    check_outputs,
    check_suffix,
    read_options,
    report_losses,
    scan_options,
    tracked,
)
from avsreplay.errors import MissingBackend, UsageError

if TYPE_CHECKING:
    from avsreplay.reconstruct.model import Deviations, Reconstruction

EPILOG = """\b
Examples:
  avsreplay model tumble.mcap -o model.ply
  avsreplay model scans/ -o model.ply --every-scan 2
  avsreplay model tumble.mcap -o model.ply --against cad.obj
                                            deviations from a CAD model
  avsreplay run tumble.mcap --model auto    build the model and use it"""


@click.command("model", cls=Command, epilog=EPILOG)
@click.argument("log", type=PATH)
@click.option(
    "-o",
    "--output",
    required=True,
    type=PATH,
    help="The model to write (.ply): points with normals.",
)
@click.option(
    "--against",
    type=PATH,
    help="CAD model to compare the result with; the points are coloured by distance.",
)
@click.option(
    "--grasp",
    type=Numbers(3),
    metavar="X,Y,Z",
    help=(
        "Grasp point in the frame that the same command without this option writes [m]; default:"
        " the flattest patch."
    ),
)
@click.option(
    "--mesh",
    type=PATH,
    help="Also write a triangle mesh (.ply); needs Open3D: pip install 'avsreplay[open3d]'.",
)
@click.option(
    "--poses", type=PATH, help="Also write the pose of {C} at each scan that was used (TUM)."
)
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")
@scan_options
def model_command(
    log: Path,
    output: Path,
    against: Path | None,
    grasp: tuple[float, ...] | None,
    mesh: Path | None,
    poses: Path | None,
    overwrite: bool,
    as_json: bool,
    **reading: Any,
) -> None:
    """Build a model of the target from the scans of LOG, without a model and without an initial
    guess.

    The result is a point cloud with normals in a frame {C} that is fixed to the target: its origin
    is a grasp point on the surface and its x axis the outward normal there. Ground truth in LOG is
    not used. 'avsreplay run LOG --model auto' builds the model and replays the log against it in
    one step.

    The poses of --poses are a fit to all scans together; if the target moves freely, they are those
    of the fitted motion. Their errors are not independent of one another, as a filter assumes of
    measurements. \f Raises:
        MissingBackend: a mesh is requested and Open3D is not installed.
        DataLost: a part of LOG could not be read.
    """  # noqa: D301
    import numpy as np

    from avsreplay.files import output_path
    from avsreplay.log import open_source, read_surface
    from avsreplay.log.header import surface_bytes
    from avsreplay.reconstruct.model import at_grasp, deviations, meshed, reconstruction_ply
    from avsreplay.reconstruct.reconstruction import reconstruct
    from avsreplay.report.export import write_tum

    for each in (output, mesh):
        if each is not None:
            check_suffix(each, ".ply")
    check_outputs("output", "mesh", "poses", overwrite=overwrite)
    if poses is not None:
        check_suffix(poses, *TUM)
    if mesh is not None and find_spec("open3d") is None:
        hint = "pip install 'avsreplay[open3d]'"
        raise MissingBackend(
            "a mesh needs Open3D, which is not installed", where="--mesh", hint=hint
        )
    cad = read_surface(against) if against else None
    with open_source(log, read_options(reading)) as source:
        made = at_grasp(reconstruct(lambda: tracked(source.scans(), len(source), "reading")))
    made = made if grasp is None else at_grasp(made, np.array(grasp))
    found = deviations(made, cad) if cad else None
    with output_path(output, overwrite=overwrite) as path:
        path.write_bytes(reconstruction_ply(made, found))
    said = _document(made, found)
    if mesh is not None:
        surface, said["mesh_interpolated"] = meshed(made)
        said["mesh_faces"] = len(surface.faces)
        with output_path(mesh, overwrite=overwrite) as path:
            path.write_bytes(surface_bytes(surface))
    if poses is not None:
        with output_path(poses, overwrite=overwrite) as path:
            write_tum(path, made.poses)
    click.echo(json.dumps(said, indent=2) if as_json else _text(said))
    report_losses(source)


def _document(made: Reconstruction, found: Deviations | None) -> dict[str, Any]:
    """Return the JSON document: figures of the reconstruction and of its deviations from a
    CAD model.
    """
    out: dict[str, Any] = {
        "scans_used": made.used,
        "scans_in_log": made.offered,
        "searches": made.searches,
        "points": len(made.points),
        "median_one_sigma_m": float(sorted(made.one_sigma_m)[len(made.one_sigma_m) // 2]),
        "extent_m": made.extent,
        "coverage": made.coverage,
        "turn_deg": made.turn_deg,
        "rms_m": made.rms_m,
        "frame": made.frame,
        "motion": None,
        "notes": list(made.notes),
    }
    if made.motion and made.mass_centre and made.principal_axes:
        (centre, centre_1s), (axes, axes_1s) = made.mass_centre, made.principal_axes
        out["motion"] = {
            "angle_rms_deg": math.degrees(made.motion.rms[0]),
            "distance_rms_m": made.motion.rms[1],
            "mass_centre_m": centre.tolist(),
            "mass_centre_1s_m": centre_1s,
            "principal_axes_xyzw": axes.tolist(),
            "principal_axes_1s_deg": min(math.degrees(axes_1s), 180.0),
        }
    if found:
        out["against"] = {
            "median_m": found.median_m,
            "p95_m": found.p95_m,
            "points_within": found.inlier_ratio,
            "within_m": found.most_m,
            "regions": [asdict(region) for region in found.regions],
        }
    return out


def _text(said: dict[str, Any]) -> str:
    """Return the lines that a person reads."""
    lines = [
        (
            f"scans used:     {said['scans_used']} of {said['scans_in_log']}, {said['searches']} of"
            " them needed a search"
        ),
        (
            f"surface:        {said['points']} points, median 1 sigma"
            f" {1e3 * said['median_one_sigma_m']:.2f} mm, extent {said['extent_m']:.3f} m"
        ),
        (
            f"seen from:      {100.0 * said['coverage']:.0f} % of all directions; the target turned"
            f" {said['turn_deg']:.0f} deg"
        ),
        f"consistency:    {1e3 * said['rms_m']:.2f} mm rms between overlapping scans",
        f"frame {{C}}:      {said['frame']}",
    ]
    motion, against = said["motion"], said.get("against")
    if motion:
        centre = ", ".join(f"{x:.3f}" for x in motion["mass_centre_m"])
        lines += [
            (
                f"free motion:    explains the poses to {motion['angle_rms_deg']:.2f} deg and"
                f" {1e3 * motion['distance_rms_m']:.2f} mm rms"
            ),
            (
                f"mass centre:    ({centre}) m in {{C}}, 1 sigma"
                f" {1e3 * motion['mass_centre_1s_m']:.1f} mm; principal axes to"
                f" {motion['principal_axes_1s_deg']:.1f} deg"
            ),
        ]
    else:
        lines.append(
            "free motion:    the poses do not follow one; mass centre and principal axes are not"
            " known"
        )
    if "mesh_faces" in said:
        lines.append(
            f"mesh:           {said['mesh_faces']} triangles,"
            f" {100.0 * said['mesh_interpolated']:.1f} % of the area interpolated"
        )
    if against:
        far = (
            f"{1e3 * against['median_m']:.2f} mm median, {1e3 * against['p95_m']:.2f} mm 95 %"
            " quantile"
        )
        share = (
            f"{100.0 * against['points_within']:.1f} % within {1e3 * against['within_m']:.0f} mm"
        )
        lines.append(f"from CAD model: {far}, {share}")
        lines += _table(against["regions"])
    return "\n".join([*lines, *(f"note: {note}" for note in said["notes"])])


def _table(regions: list[dict[str, Any]]) -> list[str]:
    """Return the lines of the table of deviating regions."""
    if not regions:
        return ["                no region differs from the CAD model"]
    lines = ["  region    points   size [m]   deviation [m]   centre in the CAD frame [m]"]
    for region in regions:
        centre = ", ".join(f"{x:.3f}" for x in region["centre_m"])
        deviation = (
            "beyond" if math.isnan(region["deviation_m"]) else f"{region['deviation_m']:+.3f}"
        )
        lines.append(
            f"  {region['kind']:<8}{region['points']:>8}{region['size_m']:>11.3f}{deviation:>16}  "
            f" ({centre})"
        )
    return lines


TUM = (".tum", ".txt")  # names of trajectories
LEAST_SCAN_POINTS = 50  # a scan with fewer is left out
LEAST_TARGET_M = 1e-6  # smallest size of a target
MOST_TARGET_M = 1e6  # largest size of a target

ODOMETRY_EPILOG = """\b
Examples:
  avsreplay odometry scans.mcap -o poses.tum --crop-range 2,4
  avsreplay run poses.tum --backend poses --extent 1.5
                                            the motion from these poses"""


@click.command("odometry", cls=Command, epilog=ODOMETRY_EPILOG)
@click.argument("log", type=PATH)
@click.option(
    "-o", "--output", required=True, type=PATH, help="The trajectory to write (TUM: .tum or .txt)."
)
@click.option(
    "--size",
    type=click.FloatRange(LEAST_TARGET_M, MOST_TARGET_M),
    help="Size of the target [m]; default: of the first scan.",
)
@click.option("--no-deskew", is_flag=True, help="Ignore the times of the points.")
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@scan_options
def odometry_command(
    log: Path, output: Path, size: float | None, no_deskew: bool, overwrite: bool, **reading: Any
) -> None:
    """Track an unknown target through the scans of LOG by KISS-ICP, without a model, and write its
    poses.

    The odometry is relative to the target; crop everything that does not move with it. {C} is
    parallel to the camera frame of the first scan, its origin at the centroid of that scan. Errors
    accumulate: 'avsreplay model' builds a model with closed loops, and a registration to a model
    does not drift. The voxel is a hundredth of the size.

    \f
    Raises:
        MissingBackend: kiss-icp is not installed.
        DataLost: a part of LOG could not be read.
        UsageError: no scan has enough points, or the name of the output states another format.
    """  # noqa: D301
    from avsreplay.files import STDOUT
    from avsreplay.geometry import bounding_diagonal
    from avsreplay.log import open_source
    from avsreplay.register.backend import load_backend
    from avsreplay.register.peers import KissOdometry
    from avsreplay.report.export import write_tum

    check_outputs("output", overwrite=overwrite)
    check_suffix(output, *TUM)
    load_backend("kiss")  # reports where the library is not installed
    odometry, poses = None, []
    with open_source(log, read_options(reading)) as source:
        for scan in tracked(source.scans(), len(source), "odometry"):
            if len(scan.points) < LEAST_SCAN_POINTS:
                continue
            if odometry is None:
                extent = bounding_diagonal(scan.points) if size is None else size
                if not LEAST_TARGET_M <= extent <= MOST_TARGET_M:  # also nan
                    what = f"the size of the target would be {extent:g} m"
                    raise UsageError(
                        what, where="--size", hint=f"give {LEAST_TARGET_M:g} to {MOST_TARGET_M:g} m"
                    )
                odometry = KissOdometry(extent, not no_deskew)
            pose, after_s = odometry.add(scan.points, scan.times_s)
            poses.append((scan.t_ns + round(1e9 * after_s), pose))
    if not poses:
        raise UsageError(
            f"no scan has {LEAST_SCAN_POINTS} points",
            where=str(log),
            hint="check the crop and --topic",
        )
    click.echo(f"{output}: {write_tum(output, poses)} poses", err=output == STDOUT)
    report_losses(source)
