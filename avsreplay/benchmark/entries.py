"""The entries of the table: a back end with an estimator, and the settings that suit it best.

A back end or estimator of another package needs no entry here: it is named on the command line and
has its own defaults.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from avsreplay.errors import MissingBackend
from avsreplay.estimate.plugin import load_method
from avsreplay.parts import OWN, PRINTED
from avsreplay.register.backend import load_backend

HORN = "horn"


@dataclass(frozen=True, slots=True)
class Variant:
    """A back end with settings of its own.

    Attributes:
        backend: its entry-point name.
        settings: ``a.b=value``.
        thinned: whether scans of many points are thinned by voxels where the scenario says how.
    """

    backend: str
    settings: tuple[str, ...] = ()
    thinned: bool = False


# Of 10 and 20 neighbours and 5,000 to 100,000 points, as measured on clean-slow and clean-fast.
NEAR = "register.small_gicp.neighbours=10"
VARIANTS = {
    "horn": Variant("horn"),
    "reference": Variant("reference", thinned=True),
    "kiss": Variant("kiss", ("register.kiss.points_per_voxel=100",), thinned=True),
    "gicp": Variant("small_gicp", (NEAR,), thinned=True),
    "plane": Variant("small_gicp", (NEAR, 'register.small_gicp.cost="plane"'), thinned=True),
    "open3d": Variant("open3d", ("register.open3d.neighbours=10",), thinned=True),
}
ESTIMATORS = (OWN, PRINTED, "ekf")


@dataclass(frozen=True, slots=True)
class Entry:
    """A row of the table.

    Attributes:
        backend: name of the variant or of an installed back end.
        estimator: name of the estimator.
    """

    backend: str
    estimator: str

    @property
    def name(self) -> str:
        """Its name in tables."""
        return f"{self.backend}+{self.estimator}"

    @property
    def variant(self) -> Variant:
        """The back end and its settings."""
        return VARIANTS.get(self.backend, Variant(self.backend))

    @property
    def assignments(self) -> tuple[str, ...]:
        """Settings ``a.b=value`` of its runs."""
        chosen = (
            f'register.backend="{self.variant.backend}"',
            f'estimator.method="{self.estimator}"',
        )
        return (*chosen, *self.variant.settings)

    @property
    def missing(self) -> str:
        """Why it cannot run here, "" if it can.

        Raises:
            UsageError: no back end or estimator has this name.
        """
        try:
            load_backend(self.variant.backend)
            if self.estimator not in (OWN, PRINTED):
                load_method(self.estimator)
        except MissingBackend:
            return "not installed"
        return ""


def entries_of(backends: Sequence[str] = (), named: Sequence[str] = ()) -> tuple[Entry, ...]:
    """Return the entries of a table.

    Args:
        backends: names of back ends or variants.
        named: names of estimators.

    Without names these are all variants with the program's own estimator, and ``horn`` with the
    other estimators. Back ends alone are paired with the program's own estimator, estimators alone
    with ``horn``; of both, each is paired with each.
    """
    if not backends and not named:
        pairs = [(b, OWN) for b in VARIANTS] + [(HORN, e) for e in ESTIMATORS[1:]]
    else:
        pairs = [(b, e) for b in backends or (HORN,) for e in named or (OWN,)]
    return tuple(Entry(*pair) for pair in dict.fromkeys(pairs))
