"""The parts of an experiment on the bench, either defaults or from an experiment file."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.basics.plain_data import PlainMapping
from afspm.client.component import Component
from afspm.emulation import Simulator
from afspm.experiment import load as load_experiment
from afspm.experiment.class_loader import importing_from
from afspm.experiment.process_starts import ProcessStart
from afspm.model import Role
from afspm.scheduler.scheduler import Scheduler
from afspm.transport.process.loading import find_class, load
from afspm.wire.message_types import register_all


@dataclass(frozen=True)
class BenchCast:
    """The parts of an experiment on the bench.

    Attributes:
        name: name of the component under test.
        components, launches: components and launch lines by name; the launch lines have no folders, and their sockets
            are never opened.
        simulator: class of the microscope.
        microscope: settings of the microscope.
    """

    name: str
    components: Mapping[str, Component]
    launches: Mapping[str, Launch]
    scheduler: Scheduler
    scheduler_launch: Launch
    simulator: type[Simulator]
    microscope: PlainMapping


def cast_of(file: str | Path, *overlays: str | Path, component: str, without: Collection[str]) -> BenchCast:
    """Return the parts of an experiment file for the bench; see `Bench.of`.

    Raises:
        ConfigError: the file has errors, or a part of it can't run on the bench.
    """
    experiment = load_experiment(file, *overlays)
    with importing_from(experiment.folders):
        starts = experiment.launches(take_address=_Addresses(), without=without, simulated=True)
        register_all(tuple(dict.fromkeys(module for start in starts for module in start.launch.messages)))
        components: dict[str, Component] = {}
        launches: dict[str, Launch] = {}
        for start in starts:
            if start.role is Role.COMPONENT and not start.leaves_last:
                made = load(start.launch) if start.launch.class_ else None
                if not isinstance(made, Component) or type(made).run_process is not Component.run_process:
                    raise _not_here(start.launch.name, f"leave it out: without = [{start.launch.name!r}]")
                components[start.launch.name], launches[start.launch.name] = made, start.launch
        scheduler_start, translator_start = (_only(starts, role) for role in (Role.SCHEDULER, Role.TRANSLATOR))
        scheduler = load(scheduler_start.launch) if scheduler_start.launch.class_ else None
        if not isinstance(scheduler, Scheduler):
            raise _not_here(scheduler_start.launch.name, "use afspm's Scheduler, by an overlay for example")
        translator = translator_start.launch
        simulator = find_class(translator.class_, translator.name) if translator.class_ else None
        if simulator is None or not issubclass(simulator, Simulator):
            raise _not_here(translator.name, 'use class = "Simulator", by an overlay for example')
    acting = [start.launch.name for start in starts if start.acts and start.launch.name in components]
    return BenchCast(
        _under_test(component, list(components), acting),
        components,
        launches,
        scheduler,
        replace(scheduler_start.launch, name="scheduler"),
        simulator,
        translator.settings,
    )


class _Addresses:
    """Addresses of sockets that are never opened."""

    def __init__(self) -> None:
        self._count = 0

    def __call__(self) -> str:
        self._count += 1
        return f"tcp://127.0.0.1:{self._count}"


def _only(starts: list[ProcessStart], role: Role) -> ProcessStart:
    found = [start for start in starts if start.role is role]
    if len(found) != 1:
        raise ConfigError(f"the bench needs one {role.name.lower()}, and the file has {len(found)}")
    return found[0]


def _not_here(name: str, hint: str) -> ConfigError:
    return ConfigError(f"[{name}] can't run on the bench", where="Bench.of", hint=hint)


def _under_test(component: str, names: list[str], acting: list[str]) -> str:
    if component and component not in names:
        raise ConfigError(f"there is no component {component!r}", where="Bench.of", hint=f"one of {', '.join(names)}")
    if component or len(acting) == 1:
        return component or acting[0]
    why = "several components have plans of their own" if acting else "no component has a plan of its own"
    raise ConfigError(why, where="Bench.of", hint=f"name the one under test: component = {(acting or names)[:1]}")
