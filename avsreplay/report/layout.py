"""A layout for Foxglove and Lichtblick that shows ``result.mcap``: 3D view, plots, diagnostics."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from avsreplay.report.atomic import atomic_text

_ORANGE, _BLUE, _GREEN = "#D55E00", "#0072B2", "#009E73"


def viewer_layout() -> dict[str, Any]:
    """The layout as plain data; topics and frames are those of the result log."""
    return {
        "configById": {
            "3D!scene": _scene(),
            "Plot!position": _plot("Position in camera [m]", _poses("position", "xyz")),
            "Plot!fit": _plot("Fit error [m]", [(_value("rms_m"), "rms_m", _BLUE)]),
            "Plot!nis": _plot("Innovation squared (NIS)", [(_value("nis"), "nis", _BLUE)]),
            "Plot!time": _plot("Time to go [s]", [(_value("t_go_s"), "t_go_s", _ORANGE)]),
            "StateTransitions!gamma": {
                "paths": [
                    {"value": "/diagnostics.status[0].message", "label": "reason", "timestampMethod": "receiveTime"}
                ],
                "isSynced": True,
            },
            "DiagnosticStatusPanel!gamma": {"topicToRender": "/diagnostics", "selectedName": "gamma"},
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _stack(["3D!scene", "StateTransitions!gamma", "DiagnosticStatusPanel!gamma"]),
            "second": _stack(["Plot!position", "Plot!fit", "Plot!nis", "Plot!time"]),
            "splitPercentage": 60,
        },
    }


def _scene() -> dict[str, Any]:
    topics = {
        "/points_aligned": {"visible": True, "pointSize": 3, "colorMode": "flat", "flatColor": _ORANGE},
        "/model": {"visible": True},
        "/estimate/pose": {"visible": True, "type": "axis", "axisScale": 0.5, "showCovariance": True},
        "/registration/pose": {"visible": False, "type": "axis", "axisScale": 0.3},
        "/truth/pose": {"visible": True, "type": "axis", "axisScale": 0.4},
        "/plan": {"visible": True, "type": "line", "lineWidth": 0.01, "gradient": [_GREEN, _GREEN]},
    }
    return {
        "followTf": "camera",
        "followMode": "follow-pose",
        "cameraState": {
            "distance": 8,
            "perspective": True,
            "phi": 160,
            "thetaOffset": 0,
            "target": [0, 0, 0],
            "targetOffset": [0, 0, 3],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.05,
            "far": 500,
        },
        "topics": topics,
    }


def _poses(part: str, axes: str) -> list[tuple[str, str, str]]:
    colours = dict(zip(axes, (_ORANGE, _GREEN, _BLUE), strict=True))
    return [(f"/estimate/pose.pose.pose.{part}.{axis}", axis, colours[axis]) for axis in axes]


def _value(name: str) -> str:
    """A scalar among the diagnostics; viewers read numbers out of its text."""
    return f'/diagnostics.status[0].values[:]{{key=="{name}"}}.value'


def _plot(title: str, lines: Sequence[tuple[str, str, str]]) -> dict[str, Any]:
    paths = [
        {"value": value, "label": label, "color": colour, "enabled": True, "timestampMethod": "receiveTime"}
        for value, label, colour in lines
    ]
    return {"title": title, "paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"}


def _stack(panels: Sequence[str]) -> Any:
    """Panels one under the other, the first taking two shares."""
    if len(panels) == 1:
        return panels[0]
    share = 100 * 2 / (len(panels) + 1) if panels[0].startswith("3D") else 100 / len(panels)
    return {"direction": "column", "first": panels[0], "second": _stack(panels[1:]), "splitPercentage": share}


def write_layout(path: str | Path) -> None:
    """Write the layout as JSON."""
    with atomic_text(path) as stream:
        stream.write(json.dumps(viewer_layout(), indent=1) + "\n")
