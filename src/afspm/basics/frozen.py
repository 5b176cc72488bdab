"""A much faster `dataclasses.replace`, for the frozen dataclasses of the scheduler's state."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, TypeVar

T = TypeVar("T")

if TYPE_CHECKING:
    from dataclasses import replace as replace  # so that names and types of its arguments are checked
else:

    def replace(part: T, /, **changes: object) -> T:
        """Return a copy of a dataclass with some fields changed, without a call of `__post_init__`.

        A class with slots is copied by `dataclasses.replace`, which calls `__post_init__`.
        """
        if not hasattr(part, "__dict__"):
            return dataclasses.replace(part, **changes)
        copy = object.__new__(type(part))
        copy.__dict__.update(part.__dict__, **changes)
        return copy
