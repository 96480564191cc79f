"""Streams a run to Rerun (extra ``rerun``): model, cloud, poses and scalars on the log's own clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from avsreplay.chain import Memory
from avsreplay.errors import MissingBackend
from avsreplay.geometry import Pose
from avsreplay.records import Scan, Surface
from avsreplay.results import belief_of
from avsreplay.rows import Row

__all__ = ["RerunStream"]

_SCALARS = ("pos_err_m", "rot_err_deg", "rms_m", "nis", "sigma1", "sigma2", "t_go_s", "gamma")


class RerunStream:
    """A listener that logs every scan to a viewer.

    Args:
        surface: the target's model.  file: write an .rrd file in place of opening a viewer.

    Raises:
        MissingBackend: rerun-sdk is not installed.
    """

    def __init__(self, surface: Surface, file: Path | None = None) -> None:
        try:
            import rerun
        except ModuleNotFoundError:
            raise MissingBackend(
                "rerun-sdk is not installed", where="--rerun", hint="install avsreplay[rerun]"
            ) from None
        self._rr: Any = rerun
        rerun.init("avsreplay", spawn=file is None)
        if file is not None:
            rerun.save(str(file))
        model = (
            rerun.Mesh3D(vertex_positions=surface.vertices, triangle_indices=surface.faces)
            if len(surface.faces)
            else rerun.Points3D(surface.vertices)
        )
        for name in ("estimate", "truth"):
            rerun.log(f"camera/{name}/model", model, static=True)

    def __call__(self, scan: Scan, memory: Memory, row: Row) -> None:
        """Take one scan."""
        rr = self._rr
        rr.set_time("log", timestamp=np.datetime64(row.t_ns, "ns"))
        rr.log("camera/scan", rr.Points3D(np.array(scan.points, np.float32, order="C")))
        self._place("camera/estimate", belief_of(memory).x.T_ac)
        if scan.truth is not None:
            self._place("camera/truth", scan.truth)
        for name in _SCALARS:
            value = getattr(row, name)
            if value is not None:
                rr.log(f"rows/{name}", rr.Scalars(float(value)))
        if row.gamma == 0:
            rr.log("rows/reason", rr.TextLog(row.reason))

    def close(self) -> None:
        """Hand on what is still on its way."""
        self._rr.disconnect()

    def _place(self, path: str, pose: Pose) -> None:
        self._rr.log(path, self._rr.Transform3D(translation=pose.t, quaternion=pose.q))
