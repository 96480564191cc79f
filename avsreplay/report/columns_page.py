"""Makes docs/columns.md and the JSON schema of a row from the declaration of ``Row`` and from columns.toml."""

from __future__ import annotations

import json
import tomllib
from functools import cache
from importlib.resources import files
from typing import Any

from avsreplay.report.jsonl import field_types
from avsreplay.rows import Column, columns

_HEAD = """# Columns of a row

Each scan gives one row in `rows.jsonl`, CSV, Parquet and `--json`. A value is null where it does not apply, for example
an error without ground truth. Frames, units and symbols are defined under [conventions](conventions.md), terms in the
[glossary](glossary.md).

The tables state the tolerance of a [golden file](ci.md) for each column: a value passes if it differs from the expected
one by at most the absolute tolerance plus the relative tolerance times the expected value; *exact* columns are equal.
[rows.schema.json](rows.schema.json) is the JSON schema of a row.

`python -m avsreplay.report.columns_page` makes this page (with `--schema` the schema) from `avsreplay/rows.py` and
`avsreplay/columns.toml`; a test compares them.
"""


@cache
def _sections() -> list[dict[str, Any]]:
    text = (files("avsreplay") / "columns.toml").read_text(encoding="utf-8")
    found: list[dict[str, Any]] = tomllib.loads(text)["sections"]
    return found


@cache
def descriptions() -> dict[str, str]:
    """Meaning of each column by its name."""
    return {name: text for section in _sections() for name, text in section["columns"].items()}


@cache
def listed_values() -> dict[str, dict[str, str]]:
    """Meaning of every value of the columns that hold one of a few words, by column and value."""
    return {name: words for section in _sections() for name, words in section.get("values", {}).items()}


def columns_page() -> str:
    """Return the Markdown page."""
    types, declared = field_types(), {c.name: c for c in columns()}
    parts = [_HEAD]
    for section in _sections():
        parts.append(f"\n## {section['title']}\n\n")
        parts += [f"{section['text']}\n\n"] if "text" in section else []
        parts.append("| column | type | unit | golden | meaning |\n|---|---|---|---|---|\n")
        parts += [_line(declared[name], *types[name]) for name in section["columns"]]
        for name, words in section.get("values", {}).items():
            parts.append(f"\n| value of `{name}` | meaning |\n|---|---|\n")
            parts += [f"| `{word}` | {meaning} |\n" for word, meaning in words.items()]
    return "".join(parts)


def _line(column: Column, kind: type, nullable: bool) -> str:
    tolerance = " + ".join(
        text for value, text in ((column.atol, f"{column.atol:g}"), (column.rtol, f"{column.rtol:g} relative")) if value
    )
    word = kind.__name__ + (" or null" if nullable else "")
    meaning = descriptions()[column.name].replace("|", "\\|")
    return f"| `{column.name}` | {word} | {column.unit} | {tolerance or 'exact'} | {meaning} |\n"


def row_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of one line of ``rows.jsonl``."""
    names = {str: "string", int: "integer", float: "number", bool: "boolean"}
    properties = {}
    for column in columns():
        kind, nullable = field_types()[column.name]
        properties[column.name] = {
            "type": [names[kind], "null"] if nullable else names[kind],
            "description": descriptions()[column.name] + (f" [{column.unit}]" if column.unit else ""),
        }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "avsreplay row",
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def row_schema_text() -> str:
    """Return the schema as text."""
    return json.dumps(row_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    import sys

    sys.stdout.write(row_schema_text() if "--schema" in sys.argv else columns_page())
