"""The makers with emulated controllers, found by the packages' declarations, so that no test lists them."""

from __future__ import annotations

import inspect
import tomllib
from dataclasses import dataclass
from pathlib import Path

from afspm.basics import entry_points
from afspm.driver import Driver

VENDORS = Path(__file__).parents[1] / "plugins"


@dataclass(frozen=True)
class Maker:
    """The facts about a maker for the tests of all makers, from `maker.toml` in the folder of the maker's own tests.

    Attributes:
        name: as of `afspm emulate`; driver: the short name of the driver's class.
        heights: a channel with heights.
        address: of the controller at a "{port}" of this computer.
        files: the settings that a replay needs, as of the folder of the files, "{here}" in place of "{there}".
        transports: of the emulator, beside the usual one.
    """

    name: str
    driver: str
    heights: str
    address: str
    files: str
    transports: tuple[str, ...] = ()

    @property
    def emulated(self) -> Path:
        """Return the second file of an experiment, with the driver and the emulator."""
        folder = entry_points.folder(entry_points.DRIVERS, self.driver)
        assert folder is not None
        return folder / "emulated.toml"

    def takes(self, setting: str) -> bool:
        """Return whether the driver has a setting."""
        driver: type[Driver] = entry_points.load(entry_points.DRIVERS, self.driver)
        return setting in inspect.signature(driver).parameters


def _makers() -> dict[str, Maker]:
    emulators = entry_points.names(entry_points.EMULATORS)
    found = {}
    for driver in entry_points.names(entry_points.DRIVERS):
        if f"{driver}Emulator" in emulators:
            name = driver.lower()
            facts = tomllib.loads((VENDORS / name / "maker.toml").read_text(encoding="utf-8"))
            found[name] = Maker(name, driver, **facts | {"transports": tuple(facts.get("transports", ()))})
    return found


MAKERS = _makers()
