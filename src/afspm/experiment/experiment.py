"""An experiment as one or more TOML files say it: loaded, checked, and made into what is to be started."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.experiment import document as documents
from afspm.experiment import forms
from afspm.experiment import parts as sorting
from afspm.experiment.findings import Finding, Findings
from afspm.experiment.implied_parts import RECORDS
from afspm.experiment.toml_lines import Table
from afspm.model import Role

if TYPE_CHECKING:
    from afspm.experiment.resolution import ResolvedExperiment
    from afspm.model.planned_work import PlannedWork


@dataclass(frozen=True)
class ProcessStart:
    """One process to start.

    Attributes:
        launch: the line for its standard input; heartbeat, log, clock and folders are for the supervisor to add
            where it has not given them to `Experiment.launches`.
        command: program and arguments; empty: the Python host runs `launch.class_`.
        folder: to start commands in: that of the experiment file.
        beats: whether it sends heartbeats; a command that does not (`heartbeats = false`) is only known by its exit.
        python_path: to be put before PYTHONPATH, so that modules beside the file are found.
        leaves_last: whether it stays until the other components have ended, to record what they say at the end.
        acts: whether it follows a plan of its own, as a series does, or that is not known; the others react.
        hidden: environment variables that hold secrets of others.
    """

    launch: Launch
    role: Role
    command: tuple[str, ...]
    folder: Path
    python_path: tuple[str, ...]
    beats: bool = True
    leaves_last: bool = False
    acts: bool = False
    hidden: tuple[str, ...] = ()


class Experiment:
    """An experiment as its files say it. Made by `load`."""

    def __init__(self, document: documents.Document) -> None:
        self._document = document
        self.parts = sorting.sort(document, forms.all_forms())

    @property
    def name(self) -> str:
        """The general variable `name`, else the folder of an `experiment.toml`, else the file's own name."""
        named = self.parts.variables.get("name")
        file = self._document.files[0].resolve()
        return (
            named if isinstance(named, str) and named else file.parent.name if file.stem == "experiment" else file.stem
        )

    @property
    def is_readable(self) -> bool:
        """False if any of its files could not be read as TOML."""
        return self._document.is_whole

    @property
    def folder(self) -> Path:
        """Of the first file, absolute: relative paths in it are meant from there."""
        return self._document.folders[0]

    @property
    def folders(self) -> list[Path]:
        """Those of all files, absolute; modules in them are found."""
        return self._document.folders

    @property
    def files(self) -> list[Path]:
        """All that it is made of, absolute, each laid over those before it."""
        return [file.resolve() for file in self._document.files]

    @property
    def component_names(self) -> list[str]:
        """All processes of the experiment: translator, scheduler and recorder too, in the order of the file."""
        self.resolved  # noqa: B018  (adds what is part of every experiment)
        return [part.name for part in self.parts.components]

    @property
    def keys_folder(self) -> Path | None:
        """The folder of [security] keys, absolute; None: no keys are used."""
        return self.resolved.keys_folder

    @property
    def recorders(self) -> list[str]:
        """Those who keep the record of a run: by default one."""
        return self.resolved.saying(RECORDS)

    def check(self, only: Collection[str] = (), without: Collection[str] = ()) -> list[Finding]:
        """Return everything that is wrong or doubtful: errors first, then by line. Nothing is started.

        Args:
            only, without: as for `launches`; what is started elsewhere need not be installed here.

        Raises:
            ConfigError: `only` or `without` names no component.
        """
        from afspm.experiment import process_starts

        chosen = process_starts.chosen_names(self.resolved, only, without)
        missing = process_starts.not_installed(self.resolved, chosen)
        return Findings([*self._document.findings.found, *missing]).ordered()

    @cached_property
    def resolved(self) -> ResolvedExperiment:
        """Classes imported, settings in SI, sections parsed, sockets connected."""
        from afspm.experiment import structure_checks
        from afspm.experiment.resolution import resolve

        resolved = resolve(self.parts, self._document)
        if self._document.is_whole:  # what is missing may be in a file that can't be read, which has been reported
            structure_checks.check(resolved)
        return resolved

    def require_valid(self, only: Collection[str] = (), without: Collection[str] = ()) -> None:
        """Raises ConfigError that lists all errors, if there are any."""
        errors = [finding for finding in self.check(only, without) if finding.is_error]
        if errors:
            raise ConfigError("\n".join(map(str, errors)), hint="afspm check shows what is wrong")

    def launches(
        self,
        *,
        take_address: Callable[[], str],
        only: Collection[str] = (),
        without: Collection[str] = (),
        clock: Table | None = None,
        run: str = "",
        simulated: bool = False,
        run_dir: str = "",
        state_dir: str = "",
        log_level: str = "INFO",
    ) -> list[ProcessStart]:
        """Return what is to be started: translator and scheduler first.

        Args:
            take_address: gives a free loopback address for each that the file leaves open.
            only: names of those to start here (empty: all); the addresses between them and the others must be in the
                file, since nobody else would know one that is chosen here.
            without: names of those not to start here.
            simulated: whether the microscope is known to be simulated even where its translator is not started here.

        Raises:
            ConfigError: the file has errors, a name is unknown, or an address is missing for a piecemeal start.
        """
        from afspm.experiment import process_starts

        self.require_valid(only, without)
        starts = process_starts.starts(self.resolved, take_address, only, without)
        knowing = process_starts.knowing_the_run(self.resolved)
        return [
            replace(
                start,
                launch=replace(
                    start.launch,
                    clock=dict(clock or {}),
                    run=run if start.launch.name in knowing else "",
                    simulated=start.launch.simulated or (simulated and start.role is not Role.TRANSLATOR),
                    run_dir=run_dir,
                    state_dir=state_dir,
                    log_level=log_level,
                ),
            )
            for start in starts
        ]

    def simulated(self, only: Collection[str] = (), without: Collection[str] = ()) -> bool:
        """Return whether the microscope is simulated for certain, where these parts are started here."""
        from afspm.experiment import process_starts

        return self.resolved.simulated_with(process_starts.chosen_names(self.resolved, only, without))

    def ends_idle(self, names: Collection[str]) -> bool:
        """Return whether a run of these processes ends when nothing that acts is left."""
        from afspm.experiment import process_starts

        return process_starts.ends_idle(self.resolved, names)

    def asking(self, names: Collection[str]) -> Launch | None:
        """Return a launch line by which `names` ask a scheduler that is started elsewhere; None: nobody can."""
        from afspm.experiment import process_starts

        return process_starts.asking(self.resolved, names)

    def planned_work(self) -> dict[str, PlannedWork | None]:
        """Return the planned work of each component that acts on its own; None: no estimate."""
        plans = self.resolved.plans
        speed_m_s = next((plan.scan_speed_m_s for plan in plans.values() if plan.scan_speed_m_s), None)
        acting = [
            name for name, process in self.resolved.processes.items() if process.acts and process.role is Role.COMPONENT
        ]
        works = {name: plans[name].work if name in plans else None for name in acting}
        return {name: work and work(speed_m_s) for name, work in works.items()}

    def clock(self) -> ExperimentClock:
        """Return the clock of a run that begins now, from [clock]."""
        settings = self.resolved.sections.clock
        return ExperimentClock.starting_now(settings.start.timestamp() if settings.start else None, settings.speed)

    def expanded(self, *, secrets: bool = True) -> str:
        """Return the whole experiment as one TOML text: references replaced, defaults filled in."""
        from afspm.experiment.toml_writer import to_toml

        return to_toml(self, secrets=secrets)


def load_expanded(path: Path, homes: Sequence[Path], *overlays: Path) -> Experiment:
    """Read the experiment file of a run, as it was expanded, and lay others over it.

    Args:
        homes: the folders of the files that it was made of (`Experiment.folders`).
    """
    return Experiment(documents.read([path, *overlays], homes))


def load(path: str | Path, *overlays: str | Path) -> Experiment:
    """Read an experiment file, and lay others over it: tables merge key by key, of anything else the later file wins.

    Nothing is raised for what is wrong in the files: `Experiment.check` tells it all at once.
    """
    return Experiment(documents.read([Path(path), *map(Path, overlays)]))
