"""Refuse a commit whose first line is not `area: imperative` in at most 72 characters (a hook of pre-commit)."""

from __future__ import annotations

import re
import sys
from pathlib import Path

LENGTH = 72
FORM = re.compile(r"(Merge|Revert|fixup!|squash!) .+|[a-z][\w./, -]*: \S.*[^.\s]")


def problem_of(subject: str) -> str:
    """Return what is wrong with a first line; empty if nothing is."""
    if len(subject) > LENGTH:
        return f"the first line has {len(subject)} characters; at most {LENGTH} are shown by git's tools"
    if not FORM.fullmatch(subject):
        return f'"{subject}" is not of the form "area: imperative", without a full stop'
    return ""


if __name__ == "__main__":
    lines = [line for line in Path(sys.argv[1]).read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    if problem := problem_of(lines[0] if lines else ""):
        sys.exit(f"{problem}\n(for example: translator: subscribe before connecting)")
