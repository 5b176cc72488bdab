"""A published experiment file in afspm's short form, and the equivalent of each line of the file."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Final

from afspm.basics import UnitError, is_address, si
from afspm.experiment.findings import SourceLocation
from afspm.experiment.parts import ExperimentPart
from afspm.experiment.published_form.files import INSTEAD, last
from afspm.experiment.toml_lines import Settings, Table
from afspm.experiment.toml_writer import dumps as toml_text
from afspm.experiment.toml_writer import value as toml
from afspm.experiment.wiring_classes import WIRE_KEYS, WiringClass, wire_of
from afspm.model import Role
from afspm.transport import is_local

if TYPE_CHECKING:
    from afspm.experiment.resolved_experiment import ResolvedExperiment
    from afspm.experiment.wiring_classes import WiringKeys

_VARIABLES: Final[tuple[str, ...]] = ("name", "messages")
_FILLED_IN: Final = "filled in: processes on one computer find each other"


def explained(resolved: ResolvedExperiment) -> list[tuple[SourceLocation, str, str]]:
    """Return the location, the setting and afspm's equivalent of each line of the file."""
    return [(resolved.document.place(*path), _shown(path), became) for path, became in _lines(resolved)]


def short(resolved: ResolvedExperiment) -> str:
    """Return the experiment in the short form: the file's sections, and its components with their settings.

    Addresses on this computer are left out, and timeouts of components move to [control]. A component without
    counterpart becomes a comment: with a `ScanSeries` below it if the settings determine one region, else with advice.
    """
    parts = resolved.parts
    kept = {name: parts.variables[name] for name in _VARIABLES if name in parts.variables}
    blocks = [toml_text(kept)] if kept else []
    blocks += [toml_text({name: table}) for name, table in _sections(resolved).items()]
    for part in parts.components:
        if not part.implied:
            blocks.append(toml_text({part.name: _table(part, resolved)}))
    blocks += [_instead(name, table) for name, table in parts.instead.items()]
    return "\n".join(blocks)


def _lines(resolved: ResolvedExperiment) -> Iterator[tuple[tuple[str, ...], str]]:
    parts = resolved.parts
    components = {part.name for part in parts.components} | parts.instead.keys()
    addresses = _addresses(resolved)
    for name, raw in resolved.document.data.items():
        if name in parts.variables:
            yield (name,), _variable(name, parts.variables[name], addresses)
        elif name in parts.sections:
            yield (name,), "as it is"
        elif name in components or (name, "class") in parts.became:
            for key in raw:
                yield (name, key), parts.became.get((name, key)) or (_FILLED_IN if key in WIRE_KEYS else "as it is")
        else:
            yield (name,), parts.became.get((name,)) or _intermediary(parts.intermediaries[name])


def _addresses(resolved: ResolvedExperiment) -> set[str]:
    # addresses stand in the net of processes, and in the tables of intermediaries
    found = {slot.address for slot in resolved.net.slots.values()}
    for table in resolved.parts.intermediaries.values():
        if wire_of(table) is not None:
            found |= {url for key, url in table.items() if key.endswith("url") and isinstance(url, str)}
    return {address for address in found if address is not None}


def _variable(name: str, value: object, addresses: Collection[str]) -> str:
    if name in _VARIABLES:
        return "as it is"
    if isinstance(value, str) and value in addresses:
        return f"{_FILLED_IN}; name them if they are on several computers"
    return f"{toml(value)} stands where it is named"


def _intermediary(table: Table) -> str:
    match wire_of(table):
        case None:
            pass
        case WiringClass.ROUTER | WiringClass.CLIENT:
            return f"{_FILLED_IN}; timeouts are [control] request_timeout"
        case WiringClass.SUBSCRIBER:
            return f"{_FILLED_IN}; topics are `envelopes` of the component"
        case _:
            return _FILLED_IN
    if "component" in table:
        return "switched off"
    return "its settings are those of the component that names it"


def _shown(path: tuple[str, ...]) -> str:
    return path[0] if len(path) == 1 else f"[{path[0]}] {path[1]}"


def _table(part: ExperimentPart, resolved: ResolvedExperiment) -> Settings:
    what: Settings = {"class": part.class_path} if part.class_path else {"command": list(part.command)}
    own = {key: value for key, value in part.own.items() if key not in {"class", "command", *WIRE_KEYS}}
    wires = resolved.processes[part.name].wires
    if wires.envelopes is not None and "envelopes" not in own:
        own["envelopes"] = wires.envelopes
    return {"component": True, **what, **own, **_remote(wires, resolved.processes[part.name].role), **part.settings}


def _remote(wires: WiringKeys, role: Role) -> Settings:
    # addresses of other computers can't be left out
    places = {
        "publisher": wires.publish,
        "control_server" if role is Role.TRANSLATOR else "router": wires.serve,
        "pubsubcache": wires.cache_out,
    }
    if role is Role.COMPONENT:
        places["control_client"] = wires.control
    found: Settings = {key: at for key, at in places.items() if at is not None and _is_remote(at)}
    if role is Role.COMPONENT and any(map(_is_remote, wires.subscribe or ())):
        found["subscriber"] = {"class": "Subscriber", "sub_url": wires.subscribe}
    return found


def _is_remote(address: str) -> bool:
    return is_address(address) and not is_local(address)


def _sections(resolved: ResolvedExperiment) -> dict[str, Settings]:
    sections = {name: dict(table) for name, table in resolved.parts.sections.items()}
    wirings = [process.wires for process in resolved.processes.values()]
    timeouts = [wires.request_timeout_s for wires in wirings if wires.request_timeout_s]
    retries = [wires.request_retries for wires in wirings if wires.request_retries is not None]
    given = {"request_timeout": f"{max(timeouts):g} s"} if timeouts else {}
    asked = {"request_retries": max(retries)} if retries else {}
    if control := {**given, **asked, **sections.get("control", {})}:
        sections["control"] = control
    return sections


def _instead(name: str, table: Table) -> str:
    # a series of scans where the data name its region, else a comment
    called = table.get("get_next_params") or table.get("message_received_method") or table.get("per_loop_method") or ""
    was = f"# [{name}] was {last(table)}{f', which called {called}' if called else ''}."
    series = _series(table)
    if series is None:
        return f"{was}\n# Instead: {INSTEAD[last(table)]}.\n"
    return f"{was}\n# It is taken for one region again and again: see that this is so.\n{toml_text({name: series})}"


def _series(table: Table) -> Settings | None:
    # possible if the function's arguments give one region, and the pause after each scan
    given = table.get("next_params_kwargs")
    data = next((one for one in given.values() if isinstance(one, Mapping)), {}) if isinstance(given, Mapping) else {}
    match data:
        case {
            "scan_origin": [origin_x, origin_y],
            "scan_size": [width, height],
            "length_units": str(unit),
            "scan_res": [columns, rows],
            "scan_wait_s": int(wait_s) | float(wait_s),
        }:
            try:
                center = [_middle(origin_x, width, unit), _middle(origin_y, height, unit)]
            except UnitError:
                return None
            return {
                "component": True,
                "class": "ScanSeries",
                "size": [f"{width} {unit}", f"{height} {unit}"],
                "center": center,
                "pixels": [columns, rows],
                "every": f"{wait_s} s",
            }
    return None


def _middle(origin: float, length: float, unit: str) -> str:
    # published regions have an origin, afspm's a centre
    si(f"{length} {unit}", "m")
    return f"{origin + length / 2:g} {unit}"
