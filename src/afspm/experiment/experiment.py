"""An experiment in one or more TOML files: loaded, checked, and turned into processes to start."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError
from afspm.basics.formatting import quantity
from afspm.basics.launch import Launch
from afspm.experiment import document as documents
from afspm.experiment import forms, process_starts
from afspm.experiment import parts as sorting
from afspm.experiment.findings import Finding, Findings
from afspm.experiment.implied_parts import RECORDS
from afspm.experiment.planned_measurements import further_waits, with_waits
from afspm.experiment.process_starts import ProcessStart
from afspm.experiment.toml_lines import Table
from afspm.experiment.toml_writer import to_toml
from afspm.model import Role, names

if TYPE_CHECKING:
    from afspm.components import PlannedWork
    from afspm.experiment.resolved_experiment import ResolvedExperiment


class Experiment:
    """An experiment read from its files by `load`."""

    def __init__(self, document: documents.Document) -> None:
        self._document = document
        self._unreadable = () if document.is_whole else tuple(document.findings.found)
        installed, self._unusable_forms = forms.all_forms()
        self.parts = sorting.sort(document, installed)

    @property
    def name(self) -> str:
        """Name of the experiment: the variable `name`, else the folder of `experiment.toml`, else the file's name."""
        named = self.parts.variables.get("name")
        file = self._document.files[0].resolve()
        return (
            named if isinstance(named, str) and named else file.parent.name if file.stem == "experiment" else file.stem
        )

    @property
    def is_readable(self) -> bool:
        """Whether all files could be read as TOML."""
        return self._document.is_whole

    @property
    def folder(self) -> Path:
        """Folder of the first file, absolute; of the first original file, if this file is expanded."""
        return self._document.folders[0]

    @property
    def folders(self) -> list[Path]:
        """Folders of all files (the originals, if a file is expanded), absolute, in which modules are found."""
        return self._document.folders

    @property
    def files(self) -> list[Path]:
        """Files of the experiment, absolute; each file overrides the earlier files."""
        return [file.resolve() for file in self._document.files]

    @property
    def component_names(self) -> list[str]:
        """Names of all processes, in the order of the file, including translator, scheduler and recorder."""
        self.resolved  # noqa: B018  (adds the implied parts)
        return [part.name for part in self.parts.components]

    @property
    def keys_folder(self) -> Path | None:
        """Folder of [security] keys, absolute; None if no keys are used."""
        return self.resolved.keys_folder

    @property
    def recorders(self) -> list[str]:
        """Names of the recorders, by default one."""
        return self.resolved.declaring(RECORDS)

    def check(self, only: Collection[str] = (), without: Collection[str] = ()) -> list[Finding]:
        """Return all errors and warnings: errors first, then by file and line. No process is started.

        If a file can't be read, only that is returned: the other files may use names that it defines. With errors, a
        form of files that can't be loaded is a warning: the file may be of this form.

        Args:
            only, without: as for `launches`; classes of processes started elsewhere need not be installed here.

        Raises:
            ConfigError: `only` or `without` names no component.
        """
        from afspm.experiment.structure_checks import shared_files

        if self._unreadable:
            return Findings(list(self._unreadable)).ordered()
        chosen = process_starts.chosen_names(self.resolved, only, without)
        missing = process_starts.not_installed(self.resolved, chosen)
        findings = Findings([*self._document.findings.found, *missing, *shared_files(self.resolved, chosen)])
        if any(one.is_error for one in findings.found):
            for error in self._unusable_forms:
                hint = "if the file is of this form, mend the package"
                findings.warning(error.what, self._document.place(), hint)
        return findings.ordered()

    @cached_property
    def resolved(self) -> ResolvedExperiment:
        """The experiment with classes imported, settings in SI, sections parsed, sockets connected."""
        from afspm.experiment import structure_checks
        from afspm.experiment.resolution import resolve

        resolved = resolve(self.parts, self._document)
        if self._document.is_whole:  # else a missing part may be in the unreadable file, which has been reported
            structure_checks.check(resolved)
        return resolved

    def require_valid(self, only: Collection[str] = (), without: Collection[str] = ()) -> None:
        """Raise ConfigError with all errors, if there are any."""
        errors = [finding for finding in self.check(only, without) if finding.is_error]
        if errors:
            raise ConfigError("\n".join(map(str, errors)), hint="run afspm check for all faults of the file")

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
        """Return the processes to start: translator and scheduler first.

        Args:
            take_address: returns a free loopback address, for each socket that has no address in the file.
            only: names of processes to start here (empty: all). Addresses between these and other processes must be in
                the file, since processes elsewhere can't know an address chosen here.
            without: names of processes not to start here.
            simulated: whether the microscope is known to be simulated although its translator is not started here.

        Raises:
            ConfigError: the file has errors, a name is unknown, or an address is missing for a partial start.
        """
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
        """Return whether the microscope is certain to be simulated, if these processes are started here."""
        return self.resolved.simulated_with(process_starts.chosen_names(self.resolved, only, without))

    def ends_idle(self, names: Collection[str]) -> bool:
        """Return whether a run of these processes ends once no process with a plan is left; see `process_starts`."""
        return process_starts.ends_idle(self.resolved, names)

    def asking(self, names: Collection[str]) -> Launch | None:
        """Return a launch line for requests to a scheduler on another computer; the sender is the first of `names`.

        None if the scheduler's address is unknown, or if the scheduler is not afspm's.
        """
        return process_starts.asking(self.resolved, names)

    def order(self) -> dict[str, tuple[str, ...]]:
        """Return the components after which each component begins."""
        return {name: process.after for name, process in self.resolved.processes.items()}

    def planned_work(self) -> dict[str, PlannedWork | None]:
        """Return the planned work of each component that acts on its own; None: no estimate."""
        plans = self.resolved.plans
        microscope = next((plan for plan in plans.values() if plan.scan_speed_m_s), None)
        speed_m_s = None if microscope is None else microscope.scan_speed_m_s
        acting = [
            name for name, process in self.resolved.processes.items() if process.acts and process.role is Role.COMPONENT
        ]
        works = {name: plans[name].work if name in plans else None for name in acting}
        estimates = {name: work and work(speed_m_s) for name, work in works.items()}
        if microscope is not None and not microscope.sets(names.SCAN_SPEED):
            default = f"scan-speed is the simulator's default, {quantity(speed_m_s, 'm/s')}"
            for name, work in works.items():
                estimate, without = estimates[name], work and work(None)
                if estimate is not None and without is not None and estimate.duration_s != without.duration_s:
                    estimates[name] = replace(estimate, why="; ".join(filter(None, (estimate.why, default))))
        limits = self.resolved.limits
        return {name: one and with_waits(name, plans[name], one, limits) for name, one in estimates.items()}

    def notes(self) -> list[str]:
        """Return sentences for the person: the motor by hand, and limits on time besides those in `planned_work`."""
        limits, plans = self.resolved.limits, self.resolved.plans.items()
        by_hand = (
            "use the motors of [limits.movers] by hand in MANUAL alone (`afspm pause`): no controller shows it else"
        )
        notes = [by_hand] if limits.movers.movers else []
        return notes + [line for name, plan in plans for line in further_waits(name, plan, limits)]

    def clock(self) -> ExperimentClock:
        """Return the clock of a run that begins now, from [clock]."""
        settings = self.resolved.sections.clock
        return ExperimentClock.starting_now(settings.start.timestamp() if settings.start else None, settings.speed)

    def expanded(self, *, secrets: bool = True) -> str:
        """Return the whole experiment as one TOML text: references replaced, defaults filled in.

        Relative paths in overlays of other folders become absolute, since the text has only one folder.
        """
        return to_toml(self._anchored(), secrets=secrets)

    def _anchored(self) -> sorting.ExperimentParts:
        parts, resolved = self.parts, self.resolved
        # the values of other variables stand in their places already
        variables = {name: value for name, value in parts.variables.items() if name in sorting.KNOWN_VARIABLES}
        sections = dict(parts.sections)
        if self._is_elsewhere("messages"):
            variables["messages"] = list(resolved.messages)
        if resolved.keys_folder is not None and self._is_elsewhere("security", "keys"):
            sections["security"] = sections["security"] | {"keys": str(resolved.keys_folder)}
        components = []
        for part in parts.components:
            given, in_si = dict(part.settings), resolved.processes[part.name].settings
            given |= {
                key: _with_paths(value, in_si.get(key))
                for key, value in given.items()
                if self._is_elsewhere(part.name, key)
            }
            components.append(replace(part, settings=given))
        return replace(parts, variables=variables, sections=sections, components=components)

    def _is_elsewhere(self, *path: str) -> bool:
        return self._document.folder_of(*path) != self.folder


def _with_paths(given: Any, resolved: Any) -> Any:
    # `given` as in the file, with its relative paths as they were resolved
    if isinstance(given, dict) and isinstance(resolved, dict):
        return {key: _with_paths(value, resolved.get(key)) for key, value in given.items()}
    if isinstance(given, list) and isinstance(resolved, list) and len(given) == len(resolved):
        return [_with_paths(*pair) for pair in zip(given, resolved, strict=True)]
    is_path = isinstance(given, str) and isinstance(resolved, str) and Path(resolved).is_absolute()
    return resolved if is_path else given


def load_expanded(path: Path, homes: Sequence[Path], *overlays: Path) -> Experiment:
    """Read the expanded experiment file of a run, and merge overlays into it.

    Args:
        homes: folders of the original files (`Experiment.folders`).
    """
    return Experiment(documents.read([path, *overlays], homes))


def load(path: str | Path, *overlays: str | Path) -> Experiment:
    """Read an experiment file, and merge overlays: tables key by key; for any other value the last file wins.

    Errors in the files raise nothing here: `Experiment.check` returns them all.
    """
    return Experiment(documents.read([Path(path), *map(Path, overlays)]))
