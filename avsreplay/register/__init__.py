"""Registration of a scan against a fixed model: back ends behind one contract, one ruler for all."""

from __future__ import annotations

from avsreplay.register.params import Limits, RegisterParams
from avsreplay.register.port import Availability, Backend, Target, available
from avsreplay.register.registrar import Registrar

__all__ = ["Availability", "Backend", "Limits", "RegisterParams", "Registrar", "Target", "available"]
