"""Value classes: data classes whose fields the type checker protects."""

from __future__ import annotations

from dataclasses import field, replace

from avsreplay.errors import value_class


def test_a_value_is_described_by_its_fields_and_has_slots() -> None:
    @value_class(eq=True)
    class Pair:
        left: int
        right: float = 2.0
        hidden: int = field(default=7, repr=False)

    pair = Pair(1)
    assert repr(pair).endswith("Pair(left=1, right=2.0)")
    assert pair == Pair(1, 2.0)
    assert replace(pair, left=3) == Pair(3)
    assert not hasattr(pair, "__dict__")
