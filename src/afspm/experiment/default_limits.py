"""Limits that come with a driver (`Driver.limits_file`), and their changes by the experiment file.

A file may tighten a default at any time. It loosens or drops one only by its name, in `[limits] loosen`: a limit that a
file sets for another reason never replaces a stricter one by accident.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from afspm.experiment import document as documents
from afspm.experiment.document import Document
from afspm.experiment.findings import nearest
from afspm.experiment.limits_section import LimitsReader
from afspm.experiment.toml_lines import Table
from afspm.scheduler import ExperimentLimits
from afspm.scheduler.safety.limits import Limit, bounds, limit_key


@dataclass(frozen=True)
class DefaultLimits:
    """The limits of a driver's `limits.toml`.

    Attributes:
        loosened: the names that the experiment file loosens.
    """

    limits: ExperimentLimits = field(default_factory=ExperimentLimits)
    loosened: tuple[str, ...] = ()

    def sources(self) -> dict[str, str]:
        """Return the place of each default, by the name that loosens it."""
        limits = self.limits
        places = {name: limit.source for name, limit in (*limits.parameters.items(), *limits.actions.items())}
        places |= {name: rule.source for name, rule in limits.forbid.items()}
        for name in bounds(ExperimentLimits):
            if getattr(limits, name) != getattr(ExperimentLimits, name):
                places[limit_key(name)] = str(getattr(limits, f"{name}_source"))
        return places

    def lines(self) -> Iterator[str]:
        """Yield a line about each default, for people."""
        for name, source in self.sources().items():
            yield f"{source}: limit of the driver: {name}{', loosened by the file' if name in self.loosened else ''}"


def read(file: Path, reader: LimitsReader, table: Table) -> DefaultLimits:
    """Return the defaults in a driver's file, whose errors are reported like those of the experiment file.

    Args:
        reader: the reader of the experiment file, whose section [limits] is `table`.
    """
    own = documents.read([file])
    limits = replace(reader, document=own, components=()).read(own.data.get("limits", {}))
    for finding in own.findings.found:
        (reader.document.findings.error if finding.is_error else reader.document.findings.warning)(
            finding.what, finding.place, finding.hint
        )
    loosen = table.get("loosen", ())
    return DefaultLimits(limits, tuple(map(str, loosen)) if isinstance(loosen, list) else ())


def merged(given: ExperimentLimits, defaults: DefaultLimits, table: Table, document: Document) -> ExperimentLimits:
    """Return the limits of the experiment file within the defaults; a default that is exceeded unnamed is an error."""
    known, loosen = defaults.sources(), table.get("loosen", ())
    for i, name in enumerate(loosen if isinstance(loosen, list) else ()):  # another kind of value is reported
        if name not in known:
            what = f"[limits] loosen: the driver has no default limit {name!r}"
            document.error(what, "limits", "loosen", i, hint=nearest(str(name), known))
    kept = known.keys() - set(defaults.loosened)
    base, merge = defaults.limits, _Merge(document)
    parameters, actions = dict(given.parameters), dict(given.actions)
    for name in kept & base.parameters.keys():
        parameters[name] = merge.limit(("limits", name), base.parameters[name], given.parameters.get(name))
    for name in kept & base.actions.keys():
        actions[name] = merge.limit(("limits", "actions", name), base.actions[name], given.actions.get(name))
    result = replace(given, parameters=parameters, actions=actions)
    for name, bound in bounds(ExperimentLimits).items():
        key = limit_key(name)
        if key not in kept:
            continue
        value, default = getattr(given, name), getattr(base, name)
        if key not in table or value is None:  # None: the value of the file is wrong, and reported
            result = replace(result, **{name: default, f"{name}_source": known[key]})
        elif not bound.is_within(value, default):
            merge.exceeds(("limits", key), key, known[key])
    return replace(result, forbid={**{name: base.forbid[name] for name in base.forbid if name in kept}, **given.forbid})


@dataclass(frozen=True)
class _Merge:
    document: Document

    def limit(self, path: tuple[str, ...], default: Limit, given: Limit | None) -> Limit:
        """Return the default, tightened by the limit of the file."""
        if given is None:
            return default
        sources = dict.fromkeys((given.source, default.source))
        tight = replace(given, source=", ".join(sources))
        if given.unit != default.unit:
            self.exceeds(path, path[-1], default.source, f"counts in {given.unit}, which is another unit")
            return default
        for key, bound in bounds(Limit).items():
            ours, theirs = getattr(given, key), getattr(default, key)
            if theirs is None:
                continue
            if ours is None:
                tight = replace(tight, **{key: theirs})
            elif not bound.is_within(ours, theirs):
                self.exceeds((*path, limit_key(key)), path[-1], default.source)
        return tight

    def exceeds(self, path: tuple[str, ...], name: str, source: str, how: str = "is looser") -> None:
        what = f"[{'.'.join(path[:-1])}] {path[-1]} {how} than the driver's limit ({source})"
        self.document.error(what, *path, hint=f'tighten it, or say that you mean it: [limits] loosen = ["{name}"]')
