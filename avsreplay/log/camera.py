"""Cameras of depth images: intrinsics with lens distortion, from CameraInfo messages and files, and
the ray of each pixel.

A whole pixel coordinate (u, v) is the centre of a pixel; the camera frame has x to the right, y
down and z forward. Lens models: ``plumb_bob`` (k1 k2 p1 p2 k3), ``rational_polynomial`` (the same
and k4 k5 k6, then s1 s2 s3 s4 of a thin prism) and ``equidistant`` (k1 k2 k3 k4).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.binary_files import read_limited
from avsreplay.errors import UnreadableInput, value_class
from avsreplay.geometry import Array
from avsreplay.log.bytes_io import BadMessage, shown
from avsreplay.log.cdr import Cursor

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
MILLIMETRE = 1e-3
_MAX_COEFFICIENTS = 14
_POLYNOMIALS = {"plumb_bob": 5, "radtan": 5, "rational_polynomial": 12, "equidistant": 4}
_NEWTON_STEPS = 12  # iterations of the inverse
_JACOBIAN_STEP = 1e-6  # difference of the numeric Jacobian, in units of the focal length
_CONVERGED_ERROR = 1e-9  # error of the inverse in units of the focal length
_MAX_PIXEL_ERROR = 0.01  # a pixel whose ray is not found to within this [pixel] has no ray
_MAX_CAMERA_FILE_BYTES = 1 << 20
_CAMERA_FILE_NAME = re.compile(
    r"(?:scene_)?(?:camera|intrinsics?)(?:_info|_intrinsics?)?\.(?:txt|json|ya?ml)$"
)
_TAUGHT = (
    "give --intrinsics FX,FY,CX,CY, or a file with the 3 x 3 matrix, the YAML of a ROS calibration"
    " or the JSON of Open3D"
)


@value_class(eq=True)
class Camera:
    """A camera.

    Attributes:
        focal: (fx, fy) [pixel].
        centre: (cx, cy) [pixel].
        size: (width, height) of its images [pixel], None if unknown.
        lens: name of the lens model, "" without distortion.
        coefficients: of the lens model, in the order of ROS and OpenCV.
        unit_m: one unit of an image of whole numbers [m].
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    size: tuple[int, int] | None = None
    lens: str = ""
    coefficients: tuple[float, ...] = ()
    unit_m: float = MILLIMETRE

    def check(self) -> Camera:
        """Return the camera.

        Raises:
            ValueError: its values do not describe a camera.
        """
        numbers = (*self.focal, *self.centre, *self.coefficients, self.unit_m)
        if not all(math.isfinite(v) for v in numbers) or min(*self.focal, self.unit_m) <= 0.0:
            raise ValueError("the camera is not calibrated: its focal length is not positive")
        if any(self.coefficients) and self.lens not in _POLYNOMIALS:
            raise ValueError(f"unknown lens model '{self.lens}'")
        if any(self.coefficients[_POLYNOMIALS.get(self.lens, 0) :]):
            raise ValueError(f"lens model '{self.lens}' with {len(self.coefficients)} coefficients")
        return self


def distorted(camera: Camera, xy: Array) -> Array:
    """Return where a lens images the directions (x, y, 1).

    Args:
        camera: its lens is used.
        xy: (n, 2), free of distortion.

    Returns:
        (n, 2), in units of the focal length.
    """
    if not any(camera.coefficients):
        return xy
    k = (*camera.coefficients, *(0.0,) * 12)
    x, y = xy.T
    r2 = x * x + y * y
    if camera.lens == "equidistant":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        a2 = angle * angle
        seen = angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
        shrunk: Array = xy * np.divide(seen, r, out=np.ones_like(r), where=r > 0.0)[:, None]
        return shrunk
    radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    radial /= 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    prism = r2 * (k[8] + r2 * k[9]), r2 * (k[10] + r2 * k[11])
    return np.stack(
        [
            x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x) + prism[0],
            y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y + prism[1],
        ],
        axis=1,
    )


@lru_cache(maxsize=4)
def rays(
    camera: Camera, width: int, height: int
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the direction of each pixel; NaN where the lens has none.

    Args:
        camera: the camera.
        width: of the image [pixel].
        height: of the image [pixel].

    Returns:
        x / z and y / z, (height, width, 2), and unit vectors row by row, (height * width, 3); both
        read-only.
    """
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    seen = (np.stack([u.ravel(), v.ravel()], axis=1) - camera.centre) / camera.focal
    found: Array = seen if not any(camera.coefficients) else _undistorted(camera, seen)
    unit = np.concatenate([found, np.ones((len(found), 1))], axis=1)
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    slopes = found.reshape(height, width, 2).astype(np.float32)
    for out in (slopes, unit):
        out.setflags(write=False)
    return slopes, unit


def _undistorted(camera: Camera, seen: Array) -> Array:
    """Return the directions (n, 2) that a lens images at ``seen``, by Newton's method; NaN where
    there is none or the image of the lens folds back.
    """
    xy = seen.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            error = distorted(camera, xy) - seen
            if float(np.abs(error).max()) < _CONVERGED_ERROR:
                break
            a, b, c, d = _jacobian(camera, xy)
            turned = np.stack(
                [d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]]
            )
            xy -= (turned / (a * d - b * c)).T
        off = np.abs(distorted(camera, xy) - seen).max(axis=1) * max(camera.focal)
        a, b, c, d = _jacobian(camera, xy)
        xy[~(off <= _MAX_PIXEL_ERROR) | ~(a * d - b * c > 0.0)] = np.nan
    return xy


def _jacobian(camera: Camera, xy: Array) -> tuple[Array, Array, Array, Array]:
    """Return the elements of d(image) / d(direction) by row, (n,) each."""
    (a, c), (b, d) = (
        ((distorted(camera, xy + step) - distorted(camera, xy - step)) / (2.0 * _JACOBIAN_STEP)).T
        for step in _JACOBIAN_STEP * np.eye(2)
    )
    return a, b, c, d


def read_camera_info(
    payload: bytes | memoryview, encoding: str, rectified: bool
) -> tuple[int, str, Camera]:
    """Decode a sensor_msgs/CameraInfo.

    Args:
        payload: the serialised message.
        encoding: ``cdr`` or ``ros1``.
        rectified: whether the image is rectified: its projection matrix P counts then, else the
            matrix K with the distortion.

    Returns:
        Header stamp [ns], header frame, and the camera of the image after region and binning.

    Raises:
        BadMessage: the message is malformed, or the camera is not calibrated.
    """
    cursor = Cursor(payload, encoding)
    stamp_ns, frame = cursor.header()
    height, width = cursor.u32(), cursor.u32()
    lens, count = cursor.string(), cursor.u32()
    if count > _MAX_COEFFICIENTS:
        raise BadMessage(f"a CameraInfo with {count} coefficients of distortion")
    coefficients = cursor.f64s(count)
    K, _, P = cursor.f64s(9), cursor.f64s(9), cursor.f64s(12)
    binning = max(cursor.u32(), 1), max(cursor.u32(), 1)
    x_offset, y_offset, roi_height, roi_width = (cursor.u32() for _ in range(4))
    if rectified:
        lens, coefficients = "", ()
        K = (P[0], P[1], P[2], P[4], P[5], P[6], *P[8:11]) if P[0] else K
    camera = Camera(
        (K[0] / binning[0], K[4] / binning[1]),
        ((K[2] - x_offset) / binning[0], (K[5] - y_offset) / binning[1]),
        ((roi_width or width) // binning[0], (roi_height or height) // binning[1]),
        lens,
        coefficients,
    )
    try:
        return stamp_ns, frame, camera.check()
    except ValueError as error:
        raise BadMessage(f"CameraInfo: {error}") from None


def stated_camera(text: str) -> Camera:
    """Return the camera that ``--intrinsics`` states: four numbers, or the name of a file.

    Raises UnreadableInput if it is neither.
    """
    words = text.split(",")
    if len(words) != 4:
        return read_camera(Path(text))
    try:
        fx, fy, cx, cy = (float(word) for word in words)
        return Camera((fx, fy), (cx, cy)).check()
    except ValueError as error:
        raise UnreadableInput(
            f"not the intrinsics of a camera: {error}", where=shown(text), hint=_TAUGHT
        ) from None


def find_camera(folder: Path, stated: str | None) -> Camera:
    """Return the camera of a folder of depth images.

    Args:
        folder: the folder; a file of intrinsics is searched in it and in the folder above.
        stated: value of ``--intrinsics``, which is used instead.

    Raises:
        UnreadableInput: there is no such file, there are several, or it cannot be read.
    """
    if stated is not None:
        return stated_camera(stated)
    for place in (folder, folder.resolve().parent):
        found = sorted(
            p for p in place.iterdir() if _CAMERA_FILE_NAME.match(p.name.lower()) and p.is_file()
        )
        if len(found) > 1:
            names = ", ".join(shown(p.name) for p in found)
            raise UnreadableInput(
                f"several files of intrinsics: {names}",
                where=shown(place),
                hint="choose one with --intrinsics FILE",
            )
        if found:
            return read_camera(found[0])
    raise UnreadableInput("depth images without intrinsics", where=shown(folder), hint=_TAUGHT)


def read_camera(path: Path) -> Camera:
    """Read a file of intrinsics: the numbers of a 3 x 3 matrix or FX FY CX CY, the YAML of a ROS
    calibration, or a JSON with a matrix (Open3D, BOP) or fx, fy, cx, cy.

    Raises UnreadableInput with the reason.
    """
    try:
        raw = read_limited(path, _MAX_CAMERA_FILE_BYTES, _TAUGHT).decode(
            "utf-8-sig", "backslashreplace"
        )
        suffix = path.suffix.lower()
        if suffix == ".json":
            return _of_table(json.loads(raw)).check()
        if suffix in (".yaml", ".yml"):
            from ruamel.yaml import YAML

            return _of_table(YAML(typ="safe", pure=True).load(raw)).check()
        return _of_matrix([float(word) for word in re.split(r"[\s,;\[\]]+", raw) if word]).check()
    except UnreadableInput:
        raise
    except OSError as error:
        raise UnreadableInput(
            error.strerror or "cannot be read", where=shown(path), hint=_TAUGHT
        ) from None
    except (ValueError, TypeError, LookupError, RecursionError, ArithmeticError) as error:
        what = f"not the intrinsics of a camera: {shown(error)[:120]}"
        raise UnreadableInput(what, where=shown(path), hint=_TAUGHT) from None
    except Exception as error:  # the errors of the YAML library have a common base of their own
        if type(error).__module__.partition(".")[0] != "ruamel":
            raise
        raise UnreadableInput("not a YAML file", where=shown(path), hint=_TAUGHT) from None


def _of_matrix(values: list[float], unit_m: float = MILLIMETRE) -> Camera:
    if len(values) == 4:
        fx, fy, cx, cy = values
    elif len(values) == 9:
        if values[5] == 0.0 and values[7] != 0.0:  # by column
            values = np.array(values).reshape(3, 3).T.ravel().tolist()
        fx, _, cx, _, fy, cy, *last = values
        if last != [0.0, 0.0, 1.0]:
            raise ValueError("the last row of its matrix is not 0 0 1")
    else:
        raise ValueError(f"{len(values)} numbers, not 4 or 9")
    return Camera((fx, fy), (cx, cy), unit_m=unit_m)


def _of_table(table: Any) -> Camera:
    if not isinstance(table, Mapping) or not table:
        raise ValueError("no table of names and values")
    first = next(iter(table.values()))
    if isinstance(first, Mapping) and "cam_K" in first:  # BOP: one entry for each image
        if any(entry["cam_K"] != first["cam_K"] for entry in table.values()):
            raise ValueError("the images have different cameras")
        table = first
    table = {str(key).lower(): value for key, value in table.items()}
    size = tuple(int(table.get(k, table.get(f"image_{k}", 0))) for k in ("width", "height"))
    matrix = next(
        (
            _numbers(table[key])
            for key in ("camera_matrix", "intrinsic_matrix", "cam_k", "k")
            if key in table
        ),
        None,
    )
    values = matrix or [float(table[key]) for key in ("fx", "fy", "cx", "cy")]
    given = table.get("distortion_coefficients", table.get("d", ()))
    coefficients = tuple(_numbers(given))
    # BOP states millimetres for one unit, others units for one metre
    scale = float(table.get("depth_scale", 1.0))
    unit_m = MILLIMETRE * scale if scale < 100.0 else 1.0 / scale
    return replace(
        _of_matrix(values, unit_m),
        size=(size[0], size[1]) if all(size) else None,
        lens=str(table.get("distortion_model", "plumb_bob" if any(coefficients) else "")),
        coefficients=coefficients,
    )


def _numbers(value: Any) -> list[float]:
    if isinstance(value, Mapping):
        value = value["data"]
    return [float(v) for v in np.array(value, dtype=np.float64).ravel()]
