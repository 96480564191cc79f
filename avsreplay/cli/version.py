"""What ``--version`` prints."""

from __future__ import annotations

import platform
from importlib import metadata

import avsreplay

PARTS = ("numpy", "scipy", "mcap", "rosbags", "kiss-icp", "trimesh", "embreex", "click", "rich")


def versions() -> dict[str, str]:
    """Versions of the package, Python and its dependencies; "missing" where one is not installed."""
    found = {"avsreplay": avsreplay.__version__, "python": platform.python_version()}
    for part in PARTS:
        try:
            found[part] = metadata.version(part)
        except metadata.PackageNotFoundError:
            found[part] = "missing"
    return found


def version_text() -> str:
    """Return one line for the package and one for its dependencies."""
    own, *rest = versions().items()
    return f"{own[0]} {own[1]}\n" + ", ".join(f"{name} {version}" for name, version in rest)
