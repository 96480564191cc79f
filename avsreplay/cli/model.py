"""``avsreplay model``: reconstruct the model of an unknown target from the scans of a log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avsreplay.cli.options import PATH, Numbers, read_options, source_options
from avsreplay.cli.progress import tracked

if TYPE_CHECKING:
    from avsreplay.reconstruct import Deviations, Reconstruction

EPILOG = """\b
Examples:
  avsreplay model tumble.mcap -o model.ply
  avsreplay model scans/ -o model.ply --every-scan 2
  avsreplay model tumble.mcap -o model.ply --against cad.obj    deviations from a CAD model
  avsreplay run tumble.mcap --model auto                        build the model and replay against it"""


@click.command("model", epilog=EPILOG)
@click.argument("log", type=PATH)
@click.option("-o", "--output", required=True, type=PATH, help="The model to write (.ply): points with normals.")
@click.option("--against", type=PATH, help="CAD model to compare the result with; the points are coloured by distance.")
@click.option(
    "--grasp",
    type=Numbers(3),
    metavar="X,Y,Z",
    help="Grasp point in the frame that the same command without this option writes [m]; default: the flattest patch.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@click.option("--json", "as_json", is_flag=True, help="Write one JSON document to stdout.")
@source_options
def command(
    log: Path,
    output: Path,
    against: Path | None,
    grasp: tuple[float, ...] | None,
    overwrite: bool,
    as_json: bool,
    **reading: Any,
) -> None:
    """Build a model of the target from the scans of LOG, without a model and without an initial guess.

    The result is a point cloud with normals in a frame {C} that is fixed to the target: its origin is a grasp point
    on the surface and its x axis the outward normal there. Ground truth in LOG is not used. 'avsreplay run LOG
    --model auto' builds the model and replays the log against it in one step.
    """
    import numpy as np

    from avsreplay.files import check_output, output_path
    from avsreplay.log import open_source, read_surface
    from avsreplay.reconstruct import at_grasp, deviations, reconstruct, reconstruction_ply

    check_output(output, overwrite=overwrite)
    cad = read_surface(against) if against else None
    with open_source(log, read_options(reading)) as source:
        made = at_grasp(reconstruct(tracked(source.scans(), len(source), "reading")))
    made = made if grasp is None else at_grasp(made, np.array(grasp))
    found = deviations(made, cad) if cad else None
    with output_path(output, overwrite=overwrite) as path:
        path.write_bytes(reconstruction_ply(made, found))
    click.echo(json.dumps(_document(made, found), indent=2) if as_json else _text(made, found))


def _document(made: Reconstruction, found: Deviations | None) -> dict[str, Any]:
    """Return the JSON document: figures of the reconstruction and of its deviations from a CAD model."""
    out: dict[str, Any] = {
        "scans_used": made.used,
        "scans_in_log": made.offered,
        "searches": made.searches,
        "points": len(made.points),
        "median_one_sigma_m": float(sorted(made.one_sigma_m)[len(made.one_sigma_m) // 2]),
        "coverage": made.coverage,
        "turn_deg": made.turn_deg,
        "rms_m": made.rms_m,
        "notes": list(made.notes),
    }
    if found:
        out["against"] = {
            "median_m": found.median_m,
            "p95_m": found.p95_m,
            "points_within": found.inlier_ratio,
            "within_m": found.most_m,
        }
    return out


def _text(made: Reconstruction, found: Deviations | None) -> str:
    said = _document(made, found)
    lines = [
        f"scans used:     {made.used} of {made.offered}, {made.searches} of them needed a search",
        f"surface:        {said['points']} points, median 1 sigma {1e3 * said['median_one_sigma_m']:.2f} mm",
        f"seen from:      {100.0 * made.coverage:.0f} % of all directions; the target turned {made.turn_deg:.0f} deg",
        f"consistency:    {1e3 * made.rms_m:.2f} mm rms between overlapping scans",
    ]
    if found:
        far = f"{1e3 * found.median_m:.2f} mm median, {1e3 * found.p95_m:.2f} mm 95 % quantile"
        lines.append(f"from CAD model: {far}, {100.0 * found.inlier_ratio:.1f} % within {1e3 * found.most_m:.0f} mm")
    return "\n".join([*lines, *(f"note: {note}" for note in made.notes)])
