"""The experiment file: load it, check it, expand it, draw it, and say what is to be started."""

from afspm.experiment.experiment import Experiment, ProcessStart, load, load_expanded
from afspm.experiment.findings import Finding, Level, SourceLocation
from afspm.model import Role

__all__ = ["Experiment", "Finding", "Level", "ProcessStart", "Role", "SourceLocation", "load", "load_expanded"]
