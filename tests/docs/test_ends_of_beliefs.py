"""Each thing that afspm remembers of the instrument has a row in the table that says until when it is believed."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from dataclasses import fields
from pathlib import Path

from afspm.client.control_hold import ControlHold
from afspm.client.measurement_setup import MeasurementSetup
from afspm.model.microscope_status import TipRisk
from afspm.scheduler.control.panel_state import PanelState
from afspm.scheduler.safety.limit_state import LimitState
from afspm.scheduler.safety.movers import MoverState
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.state import SchedulerState
from afspm.translator.state import KeptState

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "afspm"
PAGE = ROOT / "docs" / "explanation" / "at-the-panel.md"
# the makers' drivers, and the modules that write into their memory for them
DRIVERS = [
    *(
        SOURCE / "translator" / f"{name}.py"
        for name in ("result_files", "folder_files", "own_files", "activity", "setting_groups")
    ),
    *(
        one
        for maker in ("nanonis", "gxsm", "asylum", "nanosurf", "park")
        for one in (SOURCE / "plugins" / maker).glob("*.py")
    ),
]


def rows() -> dict[str, set[str]]:
    """Return the remembered things of each part, as the page lists them."""
    text = PAGE.read_text(encoding="utf-8").partition("## Memory and its ends")[2].partition("\n## ")[0]
    found, part = defaultdict[str, set[str]](set), ""
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and len(cells) == 3 and "`" in cells[1]:
            part = (re.findall(r"`(\w+)`", cells[0]) or [part])[0]
            found[part] |= set(re.findall(r"`(\w+)`", cells[1]))
    return found


def own_attributes(of: type) -> set[str]:
    """Return the attributes that `__init__` makes, without those that are its parameters."""
    file = SOURCE / Path(*of.__module__.split(".")[1:]).with_suffix(".py")
    (init,) = (
        one
        for made in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(made, ast.ClassDef) and made.name == of.__name__
        for one in made.body
        if isinstance(one, ast.FunctionDef) and one.name == "__init__"
    )
    given = {one.arg for one in (*init.args.args, *init.args.kwonlyargs)}
    made_here = set()
    for node in init.body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        value = getattr(node, "value", None)
        if not (isinstance(value, ast.Name) and value.id in given):
            made_here |= {one.attr for one in targets if isinstance(one, ast.Attribute)}
    return made_here


def keys_of_drivers() -> set[str]:
    """Return the names under which drivers keep things on disk: `self._kept["running"]`, `memory.get("image")` …"""
    found = set()
    for file in DRIVERS:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Subscript):
                of, key = node.value, node.slice
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.args:
                if node.func.attr not in ("get", "setdefault", "pop"):
                    continue
                of, key = node.func.value, node.args[0]
            else:
                continue
            name = of.attr if isinstance(of, ast.Attribute) else of.id if isinstance(of, ast.Name) else ""
            if name in ("_kept", "kept", "memory") and isinstance(key, ast.Constant):
                found.add(str(key.value))
    return found


def test_each_thing_remembered_of_the_instrument_says_until_when() -> None:
    remembered = {one.__name__: {field.name for field in fields(one)} for one in (SchedulerState, SavedState)}
    remembered |= {one.__name__: {field.name for field in fields(one)} for one in (LimitState, MoverState)}
    remembered |= {one.__name__: {field.name for field in fields(one)} for one in (TipRisk, PanelState)}
    remembered |= {one.__name__: own_attributes(one) for one in (ControlHold, MeasurementSetup)}
    remembered |= {"KeptState": set(KeptState.__annotations__), "memory": keys_of_drivers()}
    listed = rows()
    assert listed.keys() == remembered.keys()
    assert {part: listed[part] ^ remembered[part] for part in listed if listed[part] != remembered[part]} == {}
