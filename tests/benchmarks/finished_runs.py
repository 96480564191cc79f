"""Campaigns whose finished runs are appended to a file and not made again."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

Run = dict[str, Any]


def continued(
    file: Path,
    keys: Iterable[Any],
    key_of: Callable[[Run], Any],
    made: Callable[[Any], list[Run]],
    seconds: float,
) -> list[Run]:
    """Return the runs of a file after those that were missing have been made.

    Args:
        file: one JSON object in a line for each run; it is created.
        keys: of the runs that are wanted, in their order.
        key_of: key of a run of the file.
        made: runs of a key.
        seconds: time after which no further key is begun.
    """
    text = file.read_text() if file.exists() else ""
    runs = [json.loads(line) for line in text.splitlines()]
    done, until = {key_of(run) for run in runs}, time.monotonic() + seconds
    for key in keys:
        if key in done or time.monotonic() > until:
            continue
        more = made(key)
        runs += more
        with file.open("a") as stream:
            stream.writelines(json.dumps(run) + "\n" for run in more)
    return runs
