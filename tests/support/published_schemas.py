"""The JSON schemas of docs/reference/schemas: what a command prints for programs must agree with them."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema

SCHEMAS = Path(__file__).parents[2] / "docs" / "reference" / "schemas"


def require_valid(name: str, value: object) -> None:
    """Raise ValidationError unless a value agrees with the schema of this name, times included."""
    schema = json.loads((SCHEMAS / f"{name}.json").read_text(encoding="utf-8"))
    checker = jsonschema.Draft202012Validator
    checker.check_schema(schema)
    checker(schema, format_checker=jsonschema.FormatChecker()).validate(value)
