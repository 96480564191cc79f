"""Arrays as base64 text for a page: little-endian, typed, NaN for nothing."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avsreplay.rows import Row

__all__ = ["embed", "pack", "values"]

_TYPES = {"f8": "<f8", "f4": "<f4", "i4": "<i4", "i2": "<i2", "u4": "<u4", "u1": "u1"}


def pack(array: ArrayLike, kind: str) -> dict[str, str]:
    """``{"type", "data"}`` of an array of kind f8, f4, i4, i2, u4 or u1, flattened."""
    flat = np.ascontiguousarray(np.asarray(array), dtype=_TYPES[kind]).reshape(-1)
    return {"type": kind, "data": base64.b64encode(flat.tobytes()).decode("ascii")}


def values(rows: Iterable[Row], name: str) -> NDArray[np.float64]:
    """A column as floats (n,), NaN where a row has nothing to say."""
    found = (getattr(row, name) for row in rows)
    return np.array([np.nan if v is None else float(v) for v in found], dtype=np.float64)


def embed(value: Any) -> str:
    """JSON that may stand inside a script element: no ``<``, no line separators, no NaN."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
