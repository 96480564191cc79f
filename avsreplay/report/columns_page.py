"""The column list of the docs and the JSON schema of a row, both read off ``Row``."""

from __future__ import annotations

import json
from typing import Any

from avsreplay.report.jsonl import field_types
from avsreplay.rows import Column, columns

_HEAD = """# Columns of a row

One row a scan, in `rows.jsonl`, CSV, Parquet and `--json`. Made by `python -m avsreplay.report.columns_page`
from `avsreplay/rows.py`; a test holds the two in step. *Golden* is the tolerance of `--golden`: a value passes where
`|got - expected| <= absolute + relative x |expected|`. Null: there is nothing to say (no truth, no measurement,
not converged, no fault). [rows.schema.json](rows.schema.json) says the same to a program (`--schema` makes it).

| column | type | unit | golden | meaning |
|---|---|---|---|---|
"""


def columns_page() -> str:
    """The Markdown page."""
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


def schema_text() -> str:
    """The schema as it stands in the docs."""
    return json.dumps(row_schema(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    import sys

    sys.stdout.write(schema_text() if "--schema" in sys.argv else columns_page())
