"""Grid of settings: the values to try for each name, from a command line or a TOML file."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from afspm.basics import ConfigError, FileError
from afspm_lab.study.settings import PARTS, NightSettings


@dataclass(frozen=True)
class SettingsGrid:
    """All combinations of the values of some settings.

    Attributes:
        values: values to try, by name; see `NightSettings.of`. Settings of a tracker that a combination does not use
            (such as "paper.queue" with the bank tracker) add no combinations.
    """

    values: Mapping[str, tuple[object, ...]]

    @classmethod
    def of(cls, given: Sequence[str]) -> SettingsGrid:
        """Read a grid from a command line: files ending in .toml, and NAME=VALUE[,VALUE…].

        A later argument overrides the values of earlier arguments.

        Raises:
            ConfigError: an argument has another form, or the TOML is invalid. FileError: the file can't be read.
        """
        values: dict[str, tuple[object, ...]] = {}
        for text in given:
            name, equals, listed = text.partition("=")
            if equals:
                values[name.strip()] = tuple(_value(one.strip()) for one in listed.split(","))
            elif text.endswith(".toml"):
                values.update(_flat(_read(Path(text))))
            else:
                raise ConfigError(
                    f"{text!r} is not a setting", hint="e.g. tracker=bank,paper, or a file ending in .toml"
                )
        return cls(values)

    @property
    def varied(self) -> tuple[str, ...]:
        """Names with more than one value."""
        return tuple(name for name, values in self.values.items() if len(values) > 1)

    def settings(self) -> Iterator[tuple[str, NightSettings]]:
        """Yield each combination once, labelled by its varied settings.

        The first combination has the defaults of all varied settings.

        Raises:
            ConfigError, InvalidValue: as `NightSettings.of`; or no night uses the estimator or tracker of a setting.
        """
        fixed = {name: values[0] for name, values in self.values.items() if len(values) == 1}
        nights = [(chosen, NightSettings.of(fixed | chosen)) for chosen in [{}, *self._combinations()]]
        for name in self.values:
            if not any(_is_in_force(name, settings) for _, settings in nights):
                part = name.rpartition(".")[0]
                raise ConfigError(
                    f"{name} has no effect: no night has an estimator or tracker {part!r}",
                    hint='name it as well, e.g. tracker = "paper" and paper.queue = 5',
                )
        varied: list[NightSettings] = []
        for chosen, settings in nights:
            in_force = [name for name in chosen if _is_in_force(name, settings)]
            label = " ".join(f"{name}={chosen[name]}" for name in in_force) or "defaults"
            if settings not in varied:
                varied.append(settings)
                yield label, settings

    def _combinations(self) -> Iterator[dict[str, object]]:
        lists = [self.values[name] for name in self.varied]
        for combination in itertools.product(*lists) if lists else ():
            yield dict(zip(self.varied, combination, strict=True))


def _is_in_force(name: str, settings: NightSettings) -> bool:
    classes = tuple(f"{getattr(settings, one)['class']}." for one in PARTS)
    return "." not in name or name.startswith(classes)


def _value(text: str) -> object:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _read(path: Path) -> Mapping[str, object]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"can't be read: {error}", where=str(path)) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is not TOML: {error}", where=str(path)) from error


def _flat(table: Mapping[str, object], before: str = "") -> dict[str, tuple[object, ...]]:
    found: dict[str, tuple[object, ...]] = {}
    for name, value in table.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{before}{name}.")
        else:
            found[before + name] = tuple(value) if isinstance(value, list) else (value,)
    return found
