"""A run's summary as flat numbers: one column a metric, named by its path in the summary, units as suffixes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from avsreplay import settings
from avsreplay.report.summary import Summary
from avsreplay.rows import Row

__all__ = ["metrics"]


def metrics(summary: Summary, last: Row | None) -> dict[str, Any]:
    """Every single value of the summary, the parameters' errors by name, the worst of the blackouts, the end.

    ``end.*`` are columns of the last row.
    """
    plain = settings.dump(summary)
    flat = dict(_flat({k: v for k, v in plain.items() if k not in ("parameters", "coasts")}))
    for parameter in plain["parameters"]:
        for what in ("error", "one_sigma"):
            flat[f"parameter.{_word(parameter['name'])}.{what}"] = parameter[what]
    for what in ("duration_s", "pos_err_m", "rot_err_deg"):
        flat[f"worst_coast.{what}"] = max((c[what] for c in plain["coasts"] if c[what] is not None), default=None)
    for what in ("nees", "pos_err_m", "rot_err_deg", "pos_1s_m", "rot_1s_deg", "converged", "estimator"):
        flat[f"end.{what}"] = getattr(last, what) if last is not None else None
    return flat


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{_word(key)}.")
        elif not isinstance(value, list):
            yield f"{prefix}{_word(key)}", value


def _word(name: str) -> str:
    return "".join(c if c.isalnum() or c == "_" else "_" for c in name).strip("_")
