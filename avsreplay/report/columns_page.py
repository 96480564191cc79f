"""Makes docs/columns.md and the JSON schema of a row from the declaration of ``Row``."""

from __future__ import annotations

import json
from typing import Any

from avsreplay.report.jsonl import field_types
from avsreplay.rows import Column, columns

_HEAD = """# Columns of a row

Each scan gives one row in `rows.jsonl`, CSV, Parquet and `--json`. `python -m avsreplay.report.columns_page` makes this
page from `avsreplay/rows.py`; a test compares the two. *Golden* is the tolerance of `--golden`: a value passes if
`|got - expected| <= absolute + relative x |expected|`. A value is null where it does not apply: no truth, no
measurement, no plan, no fault. [rows.schema.json](rows.schema.json) is the JSON schema of a row (`--schema` makes it).
Frames, units and symbols: [conventions](conventions.md).

| column | type | unit | golden | meaning |
|---|---|---|---|---|
"""


def columns_page() -> str:
    """Return the Markdown page."""
    types = field_types()
    return _HEAD + "".join(_line(c, *types[c.name]) for c in columns())


def _line(column: Column, kind: type, nullable: bool) -> str:
    tolerance = f"{column.atol:g} + {column.rtol:g} rel" if column.rtol or column.atol else "exact"
    word = kind.__name__ + (" or null" if nullable else "")
    meaning = column.doc.replace("|", "\\|")
    return f"| `{column.name}` | {word} | {column.unit} | {tolerance} | {meaning} |\n"


def row_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of one line of ``rows.jsonl``."""
    names = {str: "string", int: "integer", float: "number", bool: "boolean"}
    properties = {}
    for column in columns():
        kind, nullable = field_types()[column.name]
        properties[column.name] = {
            "type": [names[kind], "null"] if nullable else names[kind],
            "description": column.doc + (f" [{column.unit}]" if column.unit else ""),
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
