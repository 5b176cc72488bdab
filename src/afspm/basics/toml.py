"""TOML documents of unknown origin, such as the experiment file of a run folder from elsewhere."""

from __future__ import annotations

import tomllib

from afspm.basics.plain_data import Plain

MOST_LEVELS = 50
"""Tables and lists in each other: later code follows a document by recursion."""


def parse_toml(text: str) -> Plain:
    """Return a TOML document.

    Raises:
        tomllib.TOMLDecodeError: the text is not TOML, its tables and lists are nested more than `MOST_LEVELS` deep, or
            it has an integer of thousands of digits.
    """
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except (RecursionError, ValueError) as error:
        what = "an integer has too many digits" if isinstance(error, ValueError) else _TOO_DEEP
        raise tomllib.TOMLDecodeError(what) from None
    level: list[object] = [document]
    for _ in range(MOST_LEVELS):
        inside = (one.values() if isinstance(one, dict) else one for one in level if isinstance(one, dict | list))
        level = [value for values in inside for value in values]
    if level:
        raise tomllib.TOMLDecodeError(_TOO_DEEP)
    return document


_TOO_DEEP = f"tables and lists are nested more than {MOST_LEVELS} deep"
