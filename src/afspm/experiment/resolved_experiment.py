"""The resolved experiment: all facts about an experiment that are known before its start."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.client.component import Component
from afspm.experiment import capabilities
from afspm.experiment.capabilities import MicroscopeCapabilities
from afspm.experiment.class_loader import ComponentDeclaration
from afspm.experiment.default_limits import DefaultLimits
from afspm.experiment.document import Document
from afspm.experiment.parts import EMULATED, SIMULATED, ExperimentPart, ExperimentParts
from afspm.experiment.planned_measurements import PlannedMeasurements
from afspm.experiment.sections import ExperimentSections
from afspm.experiment.toml_lines import Settings
from afspm.experiment.wiring_classes import BoundSocket, Wiring, WiringKeys
from afspm.model import Frame, ProblemNames, Role
from afspm.scheduler import ExperimentLimits
from afspm.scheduler.instruments.conditions import InstrumentSettings
from afspm.scheduler.publishing.envelopes import CacheSettings

if TYPE_CHECKING:
    from afspm.translator.driver import Driver


@dataclass
class ResolvedProcess:
    """One process, with its class loaded and its settings checked.

    Attributes:
        component: its class, loaded from `class_path`; None and empty for a command, or a class that can't be loaded.
        settings: arguments of its constructor: in SI, of JSON's types.
        wrong: settings with errors; None if there are no errors.
    """

    part: ExperimentPart
    wires: WiringKeys
    role: Role = Role.COMPONENT
    declared: ComponentDeclaration = field(default_factory=ComponentDeclaration)
    settings: Settings = field(default_factory=dict)
    component: type | None = None
    class_path: str = ""
    wrong: frozenset[str] | None = None

    @property
    def name(self) -> str:
        return self.part.name

    @property
    def acts(self) -> bool:
        """Whether the process has a plan of its own: a `run`, and no problems to solve; True if unknown."""
        if self.component is None or not issubclass(self.component, Component):
            return self.component is None
        return self.component.run is not Component.run and not self.declared.solves

    def declares(self, attribute: str) -> bool:
        """Return whether the flag `attribute` of the process's class is true."""
        return getattr(self.component, attribute, False) is True

    @property
    def is_microscope(self) -> bool:
        """Whether the process is a simulated microscope, by its class, or for a command by its table."""
        return self.part.own.get(SIMULATED) is True if self.part.command else self.declares(SIMULATED)

    @property
    def frame(self) -> Frame:
        """The coordinates of components beside this scheduler; its settings may decide."""
        frame_of: Callable[[Settings], Frame] | None = getattr(self.component, "frame_of", None)
        return Frame.TIP if frame_of is None else frame_of(self.settings)

    @property
    def envelopes(self) -> tuple[str, ...] | None:
        """Prefixes of the envelopes to subscribe to, from the file or else from the class; None: all."""
        wanted = self.part.own.get("envelopes", self.wires.envelopes)
        if wanted is None:
            return self.declared.listens
        return (wanted,) if isinstance(wanted, str) else tuple(map(str, wanted))

    @property
    def after(self) -> tuple[str, ...]:
        """The components that must be done before this component begins."""
        names = self.part.own.get("after", ())
        return (names,) if isinstance(names, str) else tuple(map(str, names))

    def capabilities(self) -> MicroscopeCapabilities | None:
        """Return a translator's capabilities; None if they can't be known before it runs."""
        return None if self.component is None else capabilities.of_class(self.component, self.settings)


@dataclass
class ResolvedExperiment:
    """An experiment, with classes loaded, settings checked and sockets connected.

    Attributes:
        processes: processes by name, in the order of the file.
        listening: sockets that components bind by settings of their own, beside the wiring.
        limits: of the file, within the default limits of the driver.
        plans: plan of each component whose settings define a plan.
    """

    parts: ExperimentParts
    document: Document
    sections: ExperimentSections
    messages: tuple[str, ...]
    named_problems: dict[str, int]
    processes: dict[str, ResolvedProcess] = field(default_factory=dict)
    net: Wiring = field(default_factory=Wiring)
    listening: list[BoundSocket] = field(default_factory=list)
    limits: ExperimentLimits = field(default_factory=ExperimentLimits)
    default_limits: DefaultLimits = field(default_factory=DefaultLimits)
    conditions: InstrumentSettings = field(default_factory=InstrumentSettings)
    caching: CacheSettings = field(default_factory=CacheSettings)
    plans: dict[str, PlannedMeasurements] = field(default_factory=dict)

    @property
    def problems(self) -> ProblemNames:
        return ProblemNames(self.named_problems)

    def metadata(self) -> dict[str, str]:
        """Return the metadata of a run: [metadata] of the file, completed by the microscope's class."""
        given = {name: value for name, value in self.sections.metadata.model_dump().items() if value is not None}
        translators = self.with_role(Role.TRANSLATOR)
        return (_metadata_of_class(translators[0]) if translators else {}) | given

    def never_shown(self) -> dict[str, str]:
        """Return what the controller never shows of a measurement, with the reasons; empty if it is simulated."""
        kind, settings = self.driver()
        return kind.without_witness(settings) if kind is not None else {}

    def lost_without(self) -> Sequence[str]:
        """Return what a real controller with these settings can't do, each with its remedy, as sentences."""
        kind, settings = self.driver()
        return kind.lost_without(settings) if kind is not None and not self.emulators else ()

    def driver(self) -> tuple[type[Driver] | None, Mapping[str, object]]:
        """Return the class of a microscope with its settings; None for a simulated one, or in another language."""
        from afspm.translator.driver import Driver

        for translator in self.with_role(Role.TRANSLATOR)[:1]:
            kind = translator.component
            if kind is not None and issubclass(kind, Driver) and not kind.simulated:
                return kind, translator.settings
        return None, {}

    def error(self, what: str, *path: str | int, hint: str = "") -> None:
        self.document.error(what, *path, hint=hint)

    def warning(self, what: str, *path: str | int, hint: str = "") -> None:
        self.document.warning(what, *path, hint=hint)

    def with_role(self, role: Role) -> list[ResolvedProcess]:
        return [process for process in self.processes.values() if process.role is role]

    def declaring(self, attribute: str) -> list[str]:
        """Return the names of the processes whose class has the flag `attribute` set to True."""
        return [name for name, process in self.processes.items() if process.declares(attribute)]

    @property
    def instruments(self) -> dict[str, tuple[str, ...]]:
        """Parameters of each instrument, by component."""
        parameters = {}
        for name in self.declaring("is_instrument"):
            setting = self.processes[name].settings.get("parameters")
            parameters[name] = tuple(setting) if isinstance(setting, dict) else ()
        return parameters

    @property
    def keys_folder(self) -> Path | None:
        """Folder of [security] keys, absolute; None if no keys are used."""
        keys = self.sections.security.keys
        return None if keys is None else self.document.folder_of("security", "keys") / keys

    @property
    def simulated(self) -> bool:
        """Whether the microscope is certain to be simulated, if the whole file is started on this computer."""
        return self.simulated_with(self.processes)

    def simulated_with(self, started: Collection[str]) -> bool:
        """Return whether the microscope is certain to be simulated, if these processes are started together.

        Either the translator is the microscope itself, or it is wired to an emulator that is started as well.
        """
        translators = self.with_role(Role.TRANSLATOR)
        return bool(translators) and all(
            translator.is_microscope or bool(self.controller_of(translator.name, started)) for translator in translators
        )

    def controller_of(self, translator: str, started: Collection[str]) -> str:
        """Return the name of the emulator that a translator is wired to; empty without an emulator among `started`.

        Empty also if the translator is not started, or is the simulated microscope itself. Always empty for a
        translator written in another language: nothing proves to which controller it connects.
        """
        process = self.processes[translator]
        if process.is_microscope or process.part.command or translator not in started:
            return ""
        return next((name for name in self.emulators if name in started), "")

    @property
    def emulators(self) -> list[str]:
        return self.declaring(EMULATED)


def _metadata_of_class(translator: ResolvedProcess) -> dict[str, str]:
    from afspm.translator.driver import Driver

    kind = translator.component
    if kind is None or not issubclass(kind, Driver):
        return {}
    about = {"vendor": kind.maker, "software": kind.software, "technique": kind.technique(translator.settings)}
    return {name: text for name, text in about.items() if text}
