"""The handlers of components: a name that is never called, a signature that can't be called."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator

from afspm import wire
from afspm.client.component import Component
from afspm.experiment.findings import closest
from afspm.experiment.resolution import ResolvedExperiment
from afspm.model import Role

_NEARLY = 0.8
_CALLED = ("run", *(name for name in vars(Component) if name.startswith("on_")))


def check_handlers(resolved: ResolvedExperiment) -> None:
    """Check methods that look like handlers: their names, and the arguments that they take."""
    for process in resolved.with_role(Role.COMPONENT):
        component = process.component
        if component is None or not issubclass(component, Component):
            continue
        for name, method in _methods(component):
            shown, path = f"[{process.name}] {component.__name__}.{name}", (process.name, "class")
            if hint := _hint_on_name(name, resolved):
                resolved.document.warning(f"{shown} is never called: there is no such handler", *path, hint=hint)
            wanted = _arguments(name)
            if wrong := _wrong_signature(method, wanted):
                hint = f"write `def {name}({', '.join(wanted)})`"
                resolved.document.error(f"{shown} can't be called as it will be: {wrong}", *path, hint=hint)


def _methods(component: type[Component]) -> Iterator[tuple[str, Callable[..., object]]]:
    """Methods of the user's that are called, or look so."""
    ours = set(Component.__mro__)
    seen: set[str] = set()
    for base in (base for base in component.__mro__ if base not in ours):
        for name, method in vars(base).items():
            if (name == "run" or name.startswith("on_")) and inspect.isfunction(method) and name not in seen:
                seen.add(name)
                yield name, method


def _hint_on_name(name: str, resolved: ResolvedExperiment) -> str:
    """Return what to do about a handler that is never called; empty: it is."""
    valid = {*_CALLED, *(message.handler for message in wire.declared())}
    near = closest(name, valid, _NEARLY)
    if name in valid or (near is None and resolved.messages):  # a handler of a message of the user's own
        return ""
    return f"did you mean {near!r}?" if near else "on_scan, on_state, …; of a message of your own after its name"


def _arguments(name: str) -> list[str]:
    base = getattr(Component, name, None)
    return list(inspect.signature(base).parameters) if base is not None else ["self", "message"]


def _wrong_signature(method: Callable[..., object], arguments: list[str]) -> str:
    if inspect.iscoroutinefunction(method) or inspect.isgeneratorfunction(method):
        return "calling it does nothing yet, since it is async or has a yield"
    try:
        inspect.signature(method).bind(*arguments)
    except TypeError as error:
        return str(error)
    return ""
