"""Settings of a simulated night, from names in a command line or a TOML file."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field, fields

from afspm.basics import ConfigError, InvalidValue, Plain, PlainMapping
from afspm.plugins.drift.estimators import DEFAULT as DEFAULT_ESTIMATOR
from afspm.plugins.drift.pairs.overlap import F_RESCAN
from afspm.plugins.drift.track import DEFAULT as DEFAULT_TRACKER

Table = PlainMapping


@dataclass(frozen=True)
class NightSettings:
    """Settings of a simulated night: one region, scanned repeatedly while the sample drifts.

    Attributes:
        surface: kind of the sample, see `afspm.simulation`.
        size_m, pixels: side of the scanned square, in m and in pixels.
        every_s: time from the start of one scan to the start of the next.
        line_s: time of trace and retrace of one line together.
        hours: duration of the night.
        drift_m: total displacement by the slow relaxation (time constant 3 h). A fast relaxation of a fifth, a daily
            cycle of a tenth and a random walk are added; the seed determines all directions.
        rescan: rule for rescans, see `afspm.plugins.drift.pairs.overlap`: "tolerance", "paper" or "never".
        tolerance_m: tolerance of the rule "tolerance"; None: a tenth of the size.
        f_rescan: limit of the rule "paper".
        at_start: "up-down": the first scan is taken in both directions, as by the scheduler's default, if both scans
            fit into `every_s`; "nothing": in one direction only.
        estimator, tracker: tables of "class" and settings.
    """

    surface: str = "stamper"
    size_m: float = 2e-6
    pixels: int = 128
    every_s: float = 900.0
    line_s: float = 1.0
    hours: float = 8.0
    drift_m: float = 1.5e-6
    rescan: str = "tolerance"
    tolerance_m: float | None = None
    f_rescan: float = F_RESCAN
    at_start: str = "up-down"
    estimator: Table = field(default_factory=lambda: {"class": DEFAULT_ESTIMATOR})
    tracker: Table = field(default_factory=lambda: {"class": DEFAULT_TRACKER})

    def __post_init__(self) -> None:
        if self.rescan not in RULES:
            raise ConfigError(f"no rule {self.rescan!r} for rescans", hint=f"one of {', '.join(RULES)}")
        if self.at_start not in STARTS:
            raise ConfigError(f"no start {self.at_start!r} of a night", hint=f"one of {', '.join(STARTS)}")
        if self.pixels * self.line_s > self.every_s:
            raise InvalidValue(
                f"a scan of {self.pixels * self.line_s:g} s does not fit into {self.every_s:g} s",
                hint="fewer pixels, a shorter line_s or a longer every_s",
            )
        if self.scans < 2:
            raise InvalidValue(f"{self.hours:g} h with a scan every {self.every_s:g} s are not two scans")

    @property
    def scans(self) -> int:
        return int(self.hours * 3600.0 / self.every_s + 1e-9)

    @classmethod
    def of(cls, names: Table) -> NightSettings:
        """Return the settings from a table of values by name.

        Names are fields, or such as "paper.queue" for a setting of the chosen tracker or estimator. Settings of other
        trackers and estimators are ignored.

        Raises:
            ConfigError: a name, rule or start is unknown. InvalidValue: values contradict each other.
        """
        plain: Plain = {name: value for name, value in names.items() if "." not in name}
        known = [one.name for one in fields(cls)]
        for name in plain:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"
                raise ConfigError(f"a night has no setting {name!r}", hint=hint)
        for part in PARTS:
            table = plain.get(part, {})
            table = {"class": table} if isinstance(table, str) else dict(table)
            table.setdefault("class", _DEFAULTS[part])
            plain[part] = table | _settings_of(table["class"], names)
        return cls(**plain)


PARTS = ("estimator", "tracker")
RULES = ("tolerance", "paper", "never")
STARTS = ("up-down", "nothing")
_DEFAULTS = {"estimator": DEFAULT_ESTIMATOR, "tracker": DEFAULT_TRACKER}


def _settings_of(name: str, names: Table) -> dict[str, object]:
    before = f"{name}."
    return {key.removeprefix(before): value for key, value in names.items() if key.startswith(before)}
