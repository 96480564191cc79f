"""Registration in the frame of the sensor, for scans that were transformed to a fixed frame.

The facing test, the search without a guess and the test of free space take the origin of the points
as the position of the sensor. A fixed frame may have its origin anywhere, so that a scan is
registered in the sensor's own frame, and its pose is transformed. The covariance is that of d in
{C} and does not change.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from avsreplay.errors import value_class
from avsreplay.geometry import Array, Pose
from avsreplay.records import Alignment
from avsreplay.register.registrar import Registrar
from avsreplay.register.shown import Effort


@value_class
class SensorFrame:
    """A registrar for points and poses in {A}, seen from a sensor.

    Attributes:
        registrar: of the model.
        sensor: pose of the sensor in {A}; None if {A} is the frame of the sensor.
    """

    registrar: Registrar
    sensor: Pose | None

    def register(self, points: NDArray[Any], guess: Pose, *more: Any) -> Alignment:
        """Register a scan from a guess, as ``Registrar.register`` does.

        Args:
            points: (n, 3) in {A} [m].
            guess: predicted T_ac.
            more: the other arguments of ``Registrar.register``.

        Returns:
            The pose T_ac with its quality.
        """
        if self.sensor is None:
            return self.registrar.register(points, guess, *more)
        T_sa = self.sensor.inverse()
        return self._in_a(
            self.registrar.register(T_sa.apply(points), T_sa @ guess, *more), self.sensor
        )

    def acquire(
        self,
        points: NDArray[Any],
        effort: Effort = Effort.FULL,
        ambiguous: Pose | None = None,
    ) -> Alignment:
        """Find the pose without a guess, as ``Registrar.acquire`` does.

        Args:
            points: (n, 3) in {A} [m].
            effort: as for ``Registrar.acquire``.
            ambiguous: the same, T_ac of a scan shortly before; None for none.

        Returns:
            The pose T_ac with its quality.
        """
        if self.sensor is None:
            return self.registrar.acquire(points, effort, ambiguous)
        T_sa = self.sensor.inverse()
        before = None if ambiguous is None else T_sa @ ambiguous
        return self._in_a(self.registrar.acquire(T_sa.apply(points), effort, before), self.sensor)

    def instants(self, points: NDArray[Any], times_s: NDArray[Any], T_ac: Pose) -> Array:
        """Return the effective measurement time of each direction, as ``Registrar.instants`` does.

        Args:
            points: (n, 3) in {A} [m].
            times_s: (n,) of each [s].
            T_ac: the registered pose.

        Returns:
            (6, 6) mean instants by direction [s].
        """
        if self.sensor is None:
            return self.registrar.instants(points, times_s, T_ac)
        T_sa = self.sensor.inverse()
        return self.registrar.instants(T_sa.apply(points), times_s, T_sa @ T_ac)

    @staticmethod
    def _in_a(found: Alignment, sensor: Pose) -> Alignment:
        members = tuple(sensor @ each for each in found.members)
        return replace(found, T_ac=sensor @ found.T_ac, members=members)
