"""Flags a problem once, after the second scan, as a person would who sees it."""

from afspm import Component, Scan


class Finder(Component):
    """A component that flags a problem once, as a person would who sees it in the second scan."""

    flags = ("tip-shape-changed", "feedback-non-optimal")
    listens = ("Scan2d",)

    def __init__(self, problem: str) -> None:
        self.problem = problem

    def on_scan(self, scan: Scan) -> None:
        times = {*self.memory.get("times", []), scan.time_ns}
        self.memory["times"] = sorted(times)
        if len(times) >= 3 and not self.memory.get("flagged"):
            self.memory["flagged"] = True
            self.memory.save()
            self.scope.flag(self.problem)
