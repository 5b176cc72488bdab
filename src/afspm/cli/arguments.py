"""Arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Files = Annotated[
    list[Path],
    typer.Argument(
        metavar="FILE [OVERLAY…]",
        help="The experiment file; each further file is laid over it and needs to hold only what differs.",
        show_default=False,
    ),
]

FilesUnlessResumed = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="FILE [OVERLAY…]",
        help="The experiment file; each further file is laid over it and needs to hold only what differs.",
        show_default=False,
    ),
]


def names_in(given: list[str] | None) -> tuple[str, ...]:
    """Names given by repeating the option, by commas, or both."""
    return tuple(name.strip() for names in given or () for name in names.split(",") if name.strip())
