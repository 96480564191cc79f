"""What a decoder returns: the fields of a cloud as the file declares them, before their meaning is
known.

Every decoder of clouds and depth images ends here, and ``canonical`` begins here: a decoder states
names, types and byte order, and does not interpret units, origins of times or codes of missing
returns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, MeasuredPose


@value_class
class RawCloud:
    """One undecided cloud, or one measured pose.

    Attributes:
        stamp_ns: stamp of the message or file [ns]; 0: unset.
        frame: frame of the coordinates as named by the message, "" if it names none.
        fields: array of each field by its declared name, in the order of the message, (n,) or
            (height, width), of the declared type and byte order; views of the message where
            possible. A cloud has ``x``, ``y`` and ``z``.
        shape: (height, width); height is 1 for a cloud without rows.
        origin: (3,) origin of the rays in ``frame`` in the unit of the coordinates; None: the
            origin of the frame.
        rays: (n, 3) unit vector of the ray of each point or pixel in ``frame``, also of those
            without a return; None: unknown.
        unit_m: size of one unit of the coordinates where the format defines it [m], such as
            0.001 of a depth image of 16 bits; None: it is inferred.
        pose: measured pose in place of fields.
    """

    stamp_ns: int
    frame: str
    fields: Mapping[str, NDArray[Any]]
    shape: tuple[int, int]
    origin: Array | None = None
    rays: Array | None = None
    unit_m: float | None = None
    pose: MeasuredPose | None = None

    def __len__(self) -> int:
        """Return the number of points, with those that are not valid."""
        return 0 if self.pose is not None else self.shape[0] * self.shape[1]

    def column(self, name: str) -> NDArray[Any]:
        """Return one field as (n,) values of its declared type."""
        return self.fields[name].reshape(-1)

    def in_other_byte_order(self) -> RawCloud:
        """Return the cloud with the bytes of every value reversed."""
        fields = {
            name: values.view(values.dtype.newbyteorder("S"))
            for name, values in self.fields.items()
        }
        return replace(self, fields=fields)


def of_points(
    points: NDArray[Any], stamp_ns: int = 0, frame: str = "", **columns: NDArray[Any]
) -> RawCloud:
    """Return an array of points as a raw cloud.

    Args:
        points: (n, 3) of any numeric type.
        stamp_ns: stamp [ns].
        frame: frame of the coordinates.
        columns: (n,) further fields by name.
    """
    fields = {axis: np.asarray(points)[:, k] for k, axis in enumerate("xyz")}
    return RawCloud(stamp_ns, frame, {**fields, **columns}, (1, len(points)))
