"""Registration of scans against a fixed model: back ends behind one protocol, one quality measure for all of them."""

from __future__ import annotations

from avsreplay.register.backend import POSES, Availability, Backend, Target, available, measured_alignment
from avsreplay.register.model_check import ModelCheck
from avsreplay.register.params import RegisterParams, RegistrationLimits
from avsreplay.register.registrar import Registrar
from avsreplay.register.restarts import allowed_scans

__all__ = [
    "POSES",
    "Availability",
    "Backend",
    "ModelCheck",
    "RegisterParams",
    "Registrar",
    "RegistrationLimits",
    "Target",
    "allowed_scans",
    "available",
    "measured_alignment",
]
