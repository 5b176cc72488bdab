"""Output of an experiment as one TOML text, with references replaced and defaults filled in."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from datetime import date, datetime, time
from typing import Any

from afspm.experiment.parts import ExperimentParts
from afspm.experiment.toml_lines import Settings, Table

SECRETS = ("webhook", "ping")
"""Names of settings and keys whose value is a secret, unless it is the "$NAME" of an environment variable."""
_NAMED_INSTEAD = "$AFSPM_WEBHOOK"


def to_toml(parts: ExperimentParts, *, secrets: bool = True) -> str:
    """Return variables, sections and components as TOML; reading the text gives the same experiment.

    Args:
        secrets: whether to include secrets; otherwise each is replaced by the name of an environment variable, which
            must be set where the text is read.
    """
    tables: Settings = dict(parts.variables)
    tables.update(parts.sections)
    for part in parts.components:
        what: Settings = {"class": part.class_path} if part.class_path else {"command": list(part.command)}
        own = {k: v for k, v in part.own.items() if k not in {"class", "command", "component"}}
        tables[part.name] = {"component": True, **what, **own, **part.settings}
    return dumps(tables if secrets else _without(_secrets_in(tables), tables))


def _secrets_in(value: object) -> list[str]:
    if isinstance(value, list | tuple):
        return list(dict.fromkeys(secret for one in value for secret in _secrets_in(one)))
    if not isinstance(value, Mapping):
        return []
    own = [value.get(key) for key in SECRETS]
    here = [one for one in own if isinstance(one, str) and one and not one.startswith("$")]
    return list(dict.fromkeys([*here, *_secrets_in(list(value.values()))]))


def _without(secrets: list[str], value: object) -> Any:
    # a variable may hold the same secret, so values are compared, not keys
    if isinstance(value, Mapping):
        return {key: _without(secrets, one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without(secrets, one) for one in value]
    if isinstance(value, str) and value in secrets:
        return _NAMED_INSTEAD + (f"_{secrets.index(value) + 1}" if secrets.index(value) else "")
    return value


def dumps(document: Table) -> str:
    """Return a document of plain TOML values as text."""
    lines = [f"{_key(k)} = {value(v)}" for k, v in document.items() if not isinstance(v, Mapping)]
    blocks = ["\n".join(lines)] if lines else []
    blocks += [_table((key,), one) for key, one in document.items() if isinstance(one, Mapping)]
    return "\n\n".join(blocks) + "\n"


def _table(path: tuple[str, ...], table: Table) -> str:
    # TOML has no null: a missing key stands for None
    header = "[" + ".".join(map(_key, path)) + "]"
    return "\n".join([header, *(f"{_key(k)} = {value(v)}" for k, v in table.items() if v is not None)])


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)


def value(of: object) -> str:
    """Return a value in TOML's notation."""
    if isinstance(of, bool):
        return "true" if of else "false"
    if isinstance(of, str):
        # JSON's escapes are TOML's, but for the delete character, which TOML wants escaped
        return json.dumps(of, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(of, float):
        return repr(of) if math.isfinite(of) else str(of)
    if isinstance(of, datetime | date | time):
        return of.isoformat()
    if isinstance(of, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {value(v)}" for k, v in of.items() if v is not None) + " }"
    if isinstance(of, list | tuple):
        return "[" + ", ".join(map(value, of)) + "]"
    return str(of)
