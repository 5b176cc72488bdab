"""The lines of SECoP: "action specifier data", with data in JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import chain

from afspm.basics import escaped, from_json

IDENTIFY, DESCRIBE, ACTIVATE = "*IDN?", "describe", "activate"
LONGEST = 1 << 23
"""The greatest length of a line in bytes; a longer line is not SECoP. 10,000 modules are described in some 2 MB."""
_MOST_NESTED = 64
# SECoP's own structures have a depth of about ten. Below Python's limit a value could be read, and not be printed.


@dataclass(frozen=True)
class SecopLine:
    """One message of a SECoP server.

    Attributes:
        action: such as "update", "reply", "changed", "error_read".
        specifier: "module:accessible", or the name of a module.
        data: decoded JSON; None without data.
    """

    action: str
    specifier: str = ""
    data: object = None

    @property
    def value(self) -> object:
        """The value in a data report, [value, qualifiers]."""
        return self.data[0] if isinstance(self.data, list) and self.data else None

    @property
    def number(self) -> float | None:
        """The value, if it is a number."""
        return number_in(self.value)

    @property
    def time(self) -> object:
        """The server's own time of the value; None if missing."""
        qualifiers = self.data[1] if isinstance(self.data, list) and len(self.data) > 1 else None
        return qualifiers.get("t") if isinstance(qualifiers, dict) else None

    @property
    def is_error(self) -> bool:
        return self.action.startswith("error")

    @property
    def error(self) -> str:
        """The text of an error report, [class, text, details]."""
        parts = self.data if isinstance(self.data, list) else [self.data]
        return escaped(": ".join(str(one) for one in parts[:2]))


def parse(line: str) -> SecopLine | None:
    """Return the message in a line of a server; None if the line is not SECoP."""
    action, _, rest = line.strip().partition(" ")
    specifier, _, text = rest.partition(" ")
    if not action:
        return None
    try:
        data = from_json(text) if text else None
    except ValueError:
        return None
    return None if _is_nested_deeper(data, _MOST_NESTED) else SecopLine(action, specifier, data)


def _is_nested_deeper(data: object, levels: int) -> bool:
    here = [data]
    for _ in range(levels):
        holders = [one.values() if isinstance(one, dict) else one for one in here if isinstance(one, dict | list)]
        here = list(chain.from_iterable(holders))
        if not here:
            return False
    return True


def number_in(value: object) -> float | None:
    """Return a decoded JSON value as a number; None if it is of another type, or too large."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:  # an integer of JSON may have any length
        return None


def change(specifier: str, value: float) -> str:
    """Return the request to set a value."""
    return f"change {specifier} {json.dumps(value)}"


def switch_on(specifier: str) -> str:
    return f"change {specifier} true"


def read(specifier: str) -> str:
    return f"read {specifier}"
