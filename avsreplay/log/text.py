"""Text from a file on its way to a person: control characters are shown, never obeyed."""

from __future__ import annotations

import re

__all__ = ["shown"]

# C0 and C1 controls, and the marks that turn the direction of writing or hide (bidi, zero width).
_UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]")


def shown(text: object) -> str:
    r"""``text`` with every control character written as an escape (``\x1b``, ``\u202e``)."""
    return _UNSAFE.sub(lambda m: m[0].encode("unicode_escape", "surrogatepass").decode("ascii"), str(text))
