"""The header of a log: scenario, seed, fault labels and start state in one MCAP metadata record of JSON values.

Floats are written in their shortest exact form, so that a header read back equals the one written, bit for bit. MCAP
has no checksum for metadata records; this record contains one over its own values.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from avsreplay.records import Belief, Label, LogHeader, State

HEADER_RECORD = "avsreplay"
FORMAT = "1"
_STATE = ("q_ab", "w_b", "r_a", "v_a", "sigma", "c_b", "q_bc")


def encode_header(header: LogHeader) -> dict[str, str]:
    """Return the metadata record of a header; the model itself is an attachment."""
    values = {
        "format": FORMAT,
        "scenario": header.scenario,
        "seed": _json(header.seed),
        "labels": _json([_label(label) for label in header.labels]),
        "start": _json(_belief(header.start)),
        "truth": _json(_state(header.truth)),
        "notes": _json(dict(header.notes)),
        "model": _json(None if header.surface is None else header.surface.name),
        "model_sha256": _json(None if header.surface is None else header.surface.sha256),
    }
    return {**values, "crc32": f"{_checksum(values):08x}"}


def decode_header(values: Mapping[str, str]) -> LogHeader:
    """Return the header of a metadata record, without the model.

    Raises ValueError if its checksum or one of its values is wrong.
    """
    rest = {k: v for k, v in values.items() if k != "crc32"}
    if values.get("crc32") != f"{_checksum(rest):08x}":
        raise ValueError("the checksum of the header record is wrong")
    if values.get("format") != FORMAT:
        raise ValueError(f"header record of format {values.get('format')!r}, this version reads {FORMAT}")
    try:
        return LogHeader(
            scenario=values["scenario"],
            seed=_to_seed(_loads(values["seed"])),
            labels=tuple(_to_label(label) for label in _loads(values["labels"])),
            start=_to_belief(_loads(values["start"])),
            truth=_to_state(_loads(values["truth"])),
            notes={str(name): str(text) for name, text in dict(_loads(values["notes"])).items()},
        )
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"header record: {str(error)[:120]}") from None


def _checksum(values: Mapping[str, str]) -> int:
    return zlib.crc32(json.dumps(dict(sorted(values.items()))).encode())


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, sort_keys=True)


def _label(label: Label) -> dict[str, Any]:
    return {name: getattr(label, name) for name in ("kind", "start_ns", "end_ns", "harmful", "strength")}


def _state(state: State | None) -> dict[str, Any] | None:
    return None if state is None else {name: getattr(state, name).tolist() for name in _STATE}


def _belief(belief: Belief | None) -> dict[str, Any] | None:
    return None if belief is None else {"t_ns": belief.t_ns, "x": _state(belief.x), "P": belief.P.tolist()}


def _loads(text: str) -> Any:
    return json.loads(text, parse_constant=_no_number)


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is not a number")


def _to_seed(value: Any) -> int | None:
    if value is not None and type(value) is not int:
        raise ValueError(f"a seed of {str(value)[:40]}")
    return value


def _to_label(values: Any) -> Label:
    label = Label(**values)
    whole = type(label.start_ns) is int and type(label.end_ns) is int and type(label.harmful) is bool
    if not isinstance(label.kind, str) or not whole or not isinstance(label.strength, (int, float, type(None))):
        raise ValueError("a fault label with a value of the wrong type")
    return label


def _to_state(values: Any) -> State | None:
    if values is None:
        return None
    state = State(**{name: np.array(values[name], dtype=np.float64) for name in _STATE})
    lengths = np.linalg.norm(state.q_ab), np.linalg.norm(state.q_bc)
    if not all(abs(length - 1.0) < 1e-6 for length in lengths) or np.abs(state.sigma).max() >= 1.0:
        raise ValueError("an invalid state: a quaternion is not of unit length, or a sigma is not below 1")
    return state


def _to_belief(values: Any) -> Belief | None:
    if values is None:
        return None
    state = _to_state(values["x"])
    if state is None:
        raise ValueError("a first belief without a state")
    return Belief(int(values["t_ns"]), state, np.array(values["P"], dtype=np.float64))
