"""Moves the news fragments into the changelog, under the version of pyproject.toml: `python tools/changelog.py`.

changes/README.md describes the fragments.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterator
from datetime import UTC, date, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GROUPS = {
    "experiment": "Experiment",
    "control": "Control and safety",
    "microscopes": "Microscopes",
    "drift": "Drift",
    "record": "Record",
    "page": "Terminal and page",
    "gateway": "Gateway and languages",
    "testing": "Testing and contributing",
}
NAME = re.compile(r"[a-z0-9-]+\.([a-z]+)\.md")
LONGEST = 200


def fragments(folder: Path) -> list[Path]:
    """Return the files of the fragments, by name."""
    return sorted(file for file in folder.glob("*.md") if file.name != "README.md")


def errors(file: Path) -> Iterator[str]:
    """Yield what is wrong with a fragment."""
    name = NAME.fullmatch(file.name)
    if name is None or name[1] not in GROUPS:
        yield f"{file.name}: the name is not SLUG.GROUP.md with a group of {', '.join(GROUPS)}"
    lines = file.read_text(encoding="utf-8").splitlines()
    if not lines:
        yield f"{file.name}: is empty"
    for number, line in enumerate(lines, 1):
        if not (line.startswith("- ") and line.endswith(".") and len(line) <= LONGEST):
            yield f"{file.name}:{number}: an item begins with '- ', ends with '.', has at most {LONGEST} characters"


def section(files: list[Path], version: str, day: date) -> str:
    """Return the section of a version, its groups in the order of `GROUPS`."""
    parts = [f"## [{version}] - {day.isoformat()}\n"]
    for group, heading in GROUPS.items():
        texts = [file.read_text(encoding="utf-8").strip() for file in files if file.name.endswith(f".{group}.md")]
        parts += [f"### {heading}\n", "\n".join(texts) + "\n"] if texts else []
    return "\n".join(parts) + "\n"


def main(day: date, root: Path = ROOT) -> None:
    version = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    files = fragments(root / "changes")
    wrong = [error for file in files for error in errors(file)]
    if wrong or not files:
        sys.exit("\n".join(wrong) or "there are no fragments in changes/")
    changelog = root / "CHANGELOG.md"
    before, heading, after = changelog.read_text(encoding="utf-8").partition("## [")
    if after.startswith(f"{version}]"):
        sys.exit(f"CHANGELOG.md has version {version} already; raise that of pyproject.toml: uv version --bump minor")
    text = before + section(files, version, day) + heading + after
    changelog.write_text(text, encoding="utf-8", newline="\n")
    for file in files:
        file.unlink()


if __name__ == "__main__":
    main(datetime.now(UTC).date())
