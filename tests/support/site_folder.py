"""Installs a package into a folder, without an installer, network or build tools."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

EXAMPLE_PLUGIN = Path(__file__).parent / "example_plugin"
EXAMPLE_MAKER = Path(__file__).parent / "example_maker"


def install(project: Path, site: Path) -> None:
    """Copy the package of a project to `site`, with the metadata of its pyproject.toml."""
    described = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    module = described["name"].replace("-", "_")
    shutil.copytree(project / module, site / module, ignore=shutil.ignore_patterns("__pycache__"))
    info = site / f"{module}-{described['version']}.dist-info"
    info.mkdir()
    name, version = described["name"], described["version"]
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = described["entry-points"]
    lines = [f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in groups[group].items()) for group in groups]
    (info / "entry_points.txt").write_text("\n".join(lines))
