"""The experiment file: load it, check it, expand it, draw it, and say what is to be started."""

from afspm.experiment.experiment import Experiment, Start, load, load_expanded
from afspm.experiment.findings import Finding, Level, Place
from afspm.experiment.parts import Role

__all__ = ["Experiment", "Finding", "Level", "Place", "Role", "Start", "load", "load_expanded"]
