"""The experiment file: read, checked, expanded, and made into the launch lines of processes.

**Theory of operation.** A file passes through six functions, in this order, before a process starts:

    document.read              TOML files laid over each other, with the line of each key
    parts.sort                 tables by kind, references replaced, files of another form converted
    resolution.resolve         classes found (`class_loader`), settings in SI (`component_settings`), sections parsed
    implied_parts.complete     recorder and notifier added, unless the file has them
    wiring.wire                sockets connected, open addresses left for the start
    structure_checks.check     what only all parts together show: roles, names, problems, needs, handlers

`resolve` calls `complete` and `wire`; all results stand in one `ResolvedExperiment`.

    comes in      TOML files
    state         none: an `Experiment` is frozen
    goes out      launch lines; findings, each with file, line, and what to write instead
    always holds  all findings are reported at once; an experiment with an error never starts
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.experiment.class_loader import importing_from
    from afspm.experiment.experiment import Experiment, load
    from afspm.experiment.process_starts import ProcessStart
    from afspm.experiment.toml_writer import dumps as toml_text
    from afspm.model import Role

if TYPE_CHECKING:  # one page or command has it, and another may
    from afspm.experiment.experiment import load_expanded
    from afspm.experiment.findings import Finding
    from afspm.experiment.process_starts import DASHBOARD

__all__ = [
    "DASHBOARD",
    "Experiment",
    "Finding",
    "ProcessStart",
    "Role",
    "importing_from",
    "load",
    "load_expanded",
    "toml_text",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.experiment.class_loader": "importing_from",
            "afspm.experiment.experiment": "Experiment load load_expanded",
            "afspm.experiment.findings": "Finding",
            "afspm.experiment.process_starts": "ProcessStart DASHBOARD",
            "afspm.model": "Role",
        },
        toml_text="afspm.experiment.toml_writer.dumps",
    )
