"""Sockets that each process binds or connects to; the file may leave addresses open.

Translator and scheduler each bind a publisher and a control server. The scheduler connects to the translator's sockets,
every component to the scheduler's. A component that publishes binds a publisher, to which its listeners connect.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from afspm.basics.addresses import hint_on, is_address
from afspm.experiment.document import Document
from afspm.experiment.parts import ExperimentPart
from afspm.experiment.resolved_experiment import ResolvedProcess
from afspm.experiment.toml_lines import Table
from afspm.experiment.wiring_classes import (
    WIRE_KEYS,
    BoundSocket,
    ProcessSockets,
    Wiring,
    WiringClass,
    WiringKeys,
    wire_of,
)
from afspm.model import Role


def read_wires(part: ExperimentPart, document: Document) -> WiringKeys:
    """Return the wiring keys of a component as addresses; report wrong keys."""
    wires = WiringKeys()
    for key, kinds in WIRE_KEYS.items():
        if key not in part.own:
            continue
        value, path = part.own[key], (part.name, key)
        if isinstance(value, str) and is_address(value):
            _apply_address(wires, key, value)
        elif (kind := wire_of(value)) in kinds:
            _apply_table(wires, value)
        elif isinstance(value, str):
            what = f"[{part.name}] {key} = {value!r} is neither an address nor one of the tables above"
            document.error(what, *path, hint=hint_on(value))
        else:
            given = repr(value) if kind is None else f"a {kind.value}"
            document.error(f"[{part.name}] {key} is {given}, not a {kinds[0].value}", *path)
    return wires


def _apply_address(wires: WiringKeys, key: str, address: str) -> None:
    match key:
        case "subscriber":
            wires.subscribe = [address]
        case "control_client":
            wires.control = address
        case "publisher":
            wires.publish = address
        case "control_server" | "router":
            wires.serve = address
        case "pubsubcache":
            wires.cache_out = address


def _apply_table(wires: WiringKeys, table: Table) -> None:
    match wire_of(table):
        case WiringClass.PUBLISHER:
            wires.publish = table.get("url")
        case WiringClass.SUBSCRIBER:
            _add_subscriber(wires, table)
        case WiringClass.CLIENT:
            wires.control = table.get("url")
            _apply_timeouts(wires, table)
        case WiringClass.SERVER:
            wires.serve = table.get("url")
        case WiringClass.ROUTER:
            wires.serve, wires.control = table.get("router_url"), table.get("server_url")
            _apply_timeouts(wires, table)
        case WiringClass.CACHE:
            wires.cache_out, wires.cache_in = table.get("url"), table.get("sub_url")


def _add_subscriber(wires: WiringKeys, table: Table) -> None:
    urls = table.get("sub_url", ())
    wires.subscribe = [*(wires.subscribe or ()), *([urls] if isinstance(urls, str) else urls)]
    topics = table.get("topics_to_sub")
    if topics is not None:
        wires.envelopes = [*(wires.envelopes or ()), *([topics] if isinstance(topics, str) else topics)]


def _apply_timeouts(wires: WiringKeys, table: Table) -> None:
    timeout_ms, retries = table.get("request_timeout_ms"), table.get("request_retries")
    if isinstance(timeout_ms, int | float):
        wires.request_timeout_s = timeout_ms / 1000
    if isinstance(retries, int):
        wires.request_retries = retries


def wire(processes: Mapping[str, ResolvedProcess], document: Document) -> Wiring:
    """Return the sockets of all processes, from the wiring keys or else by default."""
    net = Wiring()
    scheduler = next((p for p in processes.values() if p.role is Role.SCHEDULER), None)
    translator = next((p for p in processes.values() if p.role is Role.TRANSLATOR), None)
    above = scheduler.wires if scheduler else WiringKeys()

    def slot(owner: str, use: str, address: str | None, key: str) -> str:
        net.slots[f"{owner}/{use}"] = BoundSocket(owner, use, address, key, document.place(owner, key))
        return f"{owner}/{use}"

    source, target = above.cache_in, above.control
    if translator:
        own, name = translator.wires, translator.name
        data = slot(name, "publish", own.publish or above.cache_in, "publisher")
        asked = slot(name, "serve", own.serve or above.control, "control_server")
        net.links[name] = ProcessSockets(publish=data, serve=asked)
        source, target = source or data, target or asked
    if scheduler:
        out = slot(scheduler.name, "publish", above.cache_out, "pubsubcache")
        router = slot(scheduler.name, "serve", above.serve, "router")
        net.links[scheduler.name] = ProcessSockets(out, (source,) if source else (), router, target)
    others = [p for p in processes.values() if p.role is Role.COMPONENT]
    for process in others:
        if process.wires.publish or process.declared.publishes:
            slot(process.name, "publish", process.wires.publish, "publisher")
    for process in others:
        publish = f"{process.name}/publish"
        net.links[process.name] = ProcessSockets(
            publish=publish if publish in net.slots else None,
            subscribe=_sources(process, scheduler, processes, net),
            control=process.wires.control or (f"{scheduler.name}/serve" if scheduler else None),
        )
    return net


def _sources(
    process: ResolvedProcess, scheduler: ResolvedProcess | None, processes: Mapping[str, ResolvedProcess], net: Wiring
) -> tuple[str, ...]:
    own = process.wires
    published = f"{scheduler.name}/publish" if scheduler else ""
    if own.subscribe is not None:
        # a publisher of the scheduler's own (rescans, in the paper's form) is its one publisher here
        extra = {scheduler.wires.publish: published} if scheduler and scheduler.wires.publish else {}
        return tuple(dict.fromkeys(extra.get(url, url) for url in own.subscribe))
    sources = [published] if scheduler else []
    wanted = process.part.own.get("listens_to")
    prefixes = own.envelopes if own.envelopes is not None else process.declared.listens
    for name, other in processes.items():
        slot = f"{name}/publish"
        if other is process or slot not in net.slots or slot in sources:
            continue
        is_wanted = other.declared.publishes and _overlap(other.declared.publishes, prefixes)
        if name in wanted if isinstance(wanted, list) else other is not scheduler and is_wanted:
            sources.append(slot)
    return tuple(sources)


def _overlap(published: Collection[str], prefixes: Collection[str] | None) -> bool:
    # no prefixes: all envelopes are wanted
    return prefixes is None or any(e.startswith(p) or p.startswith(e) for e in published for p in prefixes)
