"""An experiment as it was resolved: what is known of each process, and of all together, before anything starts."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from afspm.client.component import Component
from afspm.experiment import capabilities
from afspm.experiment.capabilities import MicroscopeCapabilities
from afspm.experiment.class_loader import ComponentDeclaration
from afspm.experiment.document import Document
from afspm.experiment.parts import EMULATED, SIMULATED, ExperimentPart, ExperimentParts
from afspm.experiment.planned_measurements import PlannedMeasurements
from afspm.experiment.sections import ExperimentSections
from afspm.experiment.toml_lines import Settings
from afspm.experiment.wiring_classes import BoundSocket, Wiring, WiringKeys
from afspm.model import ProblemNames, Role
from afspm.scheduler.publishing.envelopes import CacheSettings
from afspm.scheduler.safety.limits import ExperimentLimits


@dataclass
class ResolvedProcess:
    """One process with all that is known of it before it starts.

    Attributes:
        component: its class, and `class_path` where that is; None and empty for a command, or what can't be loaded.
        settings: as its constructor gets them: in SI, of JSON's types.
        wrong: the settings that were refused; None where all are right.
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
        """Return whether it follows a plan of its own: a script, unless it solves problems. A command: unknown."""
        if self.component is None or not issubclass(self.component, Component):
            return self.component is None
        return self.component.run is not Component.run and not self.declared.solves

    def says(self, attribute: str) -> bool:
        """Return whether its class has an attribute that is true."""
        return getattr(self.component, attribute, False) is True

    @property
    def is_microscope(self) -> bool:
        """True for a simulated microscope, as its class (a command: its table) says."""
        return self.part.own.get(SIMULATED) is True if self.part.command else self.says(SIMULATED)

    @property
    def envelopes(self) -> tuple[str, ...] | None:
        """The prefixes that it subscribes to: as the file says, else as its class declares; None: all."""
        wanted = self.part.own.get("envelopes", self.wires.envelopes)
        if wanted is None:
            return self.declared.listens
        return (wanted,) if isinstance(wanted, str) else tuple(map(str, wanted))

    def capabilities(self) -> MicroscopeCapabilities | None:
        """Return what a translator can do; None where that is not known before it runs."""
        return None if self.component is None else capabilities.of_class(self.component, self.settings)


@dataclass
class ResolvedExperiment:
    """Everything about the experiment that is known before it starts.

    Attributes:
        processes: by name, in the order of the file.
        listening: where components listen by settings of their own, beside the wiring.
        plans: by component, as far as they are fixed before it runs.
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
    caching: CacheSettings = field(default_factory=CacheSettings)
    plans: dict[str, PlannedMeasurements] = field(default_factory=dict)

    @property
    def problems(self) -> ProblemNames:
        return ProblemNames(self.named_problems)

    def metadata(self) -> dict[str, str]:
        """Return the metadata of a run: that of the microscope's class, overridden by [metadata] of the file."""
        given = {name: value for name, value in self.sections.metadata.model_dump().items() if value is not None}
        translators = self.with_role(Role.TRANSLATOR)
        return (_metadata_of_class(translators[0]) if translators else {}) | given

    def error(self, what: str, *path: str | int, hint: str = "") -> None:
        """Report an error at the line where `path` is set."""
        self.document.error(what, *path, hint=hint)

    def warning(self, what: str, *path: str | int, hint: str = "") -> None:
        """Report a warning at the line where `path` is set."""
        self.document.warning(what, *path, hint=hint)

    def with_role(self, role: Role) -> list[ResolvedProcess]:
        return [process for process in self.processes.values() if process.role is role]

    def saying(self, attribute: str) -> list[str]:
        """Return the names of the processes whose class has an attribute that is true."""
        return [name for name, process in self.processes.items() if process.says(attribute)]

    @property
    def keys_folder(self) -> Path | None:
        """The folder of [security] keys, absolute."""
        keys = self.sections.security.keys
        return None if keys is None else self.document.folder_of("security", "keys") / keys

    @property
    def simulated(self) -> bool:
        """True if the microscope is simulated for certain, where all of the file is started on this computer."""
        return self.simulated_with(self.processes)

    def simulated_with(self, started: Collection[str]) -> bool:
        """Return whether the microscope is simulated for certain, where these processes are started together.

        Either the translator is the microscope itself, or it is wired to an emulator that is started with it.
        """
        translators = self.with_role(Role.TRANSLATOR)
        return bool(translators) and all(
            translator.is_microscope or bool(self.controller_of(translator.name, started)) for translator in translators
        )

    def controller_of(self, translator: str, started: Collection[str]) -> str:
        """Return the name of the emulator that a translator is wired to; empty: none that is started with it.

        A translator of another language can't be: nothing proves to whom it talks.
        """
        process = self.processes[translator]
        if process.is_microscope or process.part.command or translator not in started:
            return ""
        return next((name for name in self.emulators if name in started), "")

    @property
    def emulators(self) -> list[str]:
        """The emulated controllers among the components."""
        return self.saying(EMULATED)


def _metadata_of_class(translator: ResolvedProcess) -> dict[str, str]:
    from afspm.translator.driver import Driver

    kind = translator.component
    if kind is None or not issubclass(kind, Driver):
        return {}
    about = {"vendor": kind.maker, "software": kind.software, "technique": kind.technique(translator.settings)}
    return {name: text for name, text in about.items() if text}
