from afspm import Component, Region
from afspm.basics import Count, NotClear


class Sites(Component):
    """A scan at each of several sites in a row; a killed one goes on where it was."""

    needs_actions = ("start-scan", "x-retract", "x-approach", "x-coarse-away", "x-coarse-right")

    def __init__(self, sites: Count) -> None:
        self.sites = sites

    def run(self) -> None:
        with self.scope.control():
            for site in range(self.sites):
                if site > self.memory.get("site", 0):
                    self.go_to_the_next()
                    self.memory["site"] = site
                self.scope.scan(Region((0, 0), (500e-9, 500e-9)), shape=(64, 64), key=f"site-{site}")
                self.scope.progress(site + 1, self.sites)
        self.scope.end_experiment()

    def go_to_the_next(self) -> None:
        while True:
            self.scope.withdraw(*["x-coarse-away"] * 5)
            try:
                self.scope.action("x-coarse-right")
                break
            except NotClear as error:  # a person has had the microscope since the steps, or contact was lost
                self.log.warning("the steps away are made again: %s", error.reason)
        self.scope.approach(timeout_s=300)
