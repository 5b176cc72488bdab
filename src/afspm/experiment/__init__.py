"""The experiment file: read, checked, expanded, and made into the launch lines of processes.

**Theory of operation.** TOML files are laid over each other (`document`), references replaced, defaults filled in
(`resolution`), classes found by entry points (`class_loader`), and everything checked before a process starts.

    comes in      TOML files
    state         none: an `Experiment` is frozen
    goes out      launch lines; findings, each with file, line, and what to write instead
    always holds  all findings are reported at once; an experiment with an error never starts
"""

from afspm.experiment.experiment import Experiment, load, load_expanded
from afspm.experiment.findings import Finding, Level, SourceLocation
from afspm.experiment.process_starts import ProcessStart
from afspm.model import Role

__all__ = ["Experiment", "Finding", "Level", "ProcessStart", "Role", "SourceLocation", "load", "load_expanded"]
