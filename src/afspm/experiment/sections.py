"""Sections of the experiment file as pydantic models. Loaded only when a file is checked or run."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from datetime import datetime
from functools import partial
from typing import Annotated, ClassVar, Final, Literal, TypeVar, get_args, get_origin, get_type_hints

import pydantic
from pydantic import Field, StrictBool

from afspm.basics import entry_points
from afspm.basics.plain_data import file_key
from afspm.basics.units import Duration, Period, PositiveDuration
from afspm.experiment.document import Document
from afspm.experiment.toml_lines import Settings
from afspm.experiment.validation_messages import report
from afspm.scheduler.settings import ControlSettings

_ORCID: Final = re.compile(r"(?:https://orcid\.org/)?(\d{4}-\d{4}-\d{4}-\d{3}[\dX])")


def _checked_orcid(text: str) -> str:
    # the last digit is a check digit after ISO 7064 (MOD 11-2)
    found = _ORCID.fullmatch(text)
    if found is None:
        raise ValueError("an ORCID iD looks like 0000-0002-1825-0097")
    digits = found[1].replace("-", "")
    total = 0
    for digit in digits[:-1]:
        total = (total + int(digit)) * 2
    if "0123456789X"[(12 - total % 11) % 11] != digits[-1]:
        raise ValueError("this is not an ORCID iD: its last digit does not match the others")
    return f"https://orcid.org/{found[1]}"


Orcid = Annotated[str, pydantic.AfterValidator(_checked_orcid)]


entry_points.unreadable()  # before the first model, which fails with an unreadable package unless it is found here


class Section(pydantic.BaseModel):
    """Base class of the file's sections: unknown keys are errors.

    Each field of a section read with `parse` has a default, since the defaults take the place of a faulty section.
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, strict=False)


class ClockSection(Section):
    """[clock]: start and speed of experiment time (simulated microscopes only)."""

    start: datetime | None = None
    speed: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    waits: StrictBool = True


class SecuritySection(Section):
    """[security]: the folder of CURVE keys, or consent to run without keys."""

    keys: str | None = None
    plain: StrictBool = False
    """Programs without keys may join through a bridge, which opens plain sockets; all other sockets stay private."""
    insecure: StrictBool = False
    tcp: StrictBool = False
    """Use TCP only, for programs whose library lacks unix sockets. Every socket then has keys."""

    @property
    def are_sockets_private(self) -> bool:
        """Whether sockets that the file leaves open are unix sockets, where the system has them."""
        return not (self.keys or self.insecure or self.tcp)


class RestartSection(Section):
    """[restart]: time limits and restarts of processes. Real time."""

    beat_period: PositiveDuration = 1.0
    missed_beats: Annotated[int, Field(ge=1)] = 3
    start: PositiveDuration = 30.0
    longest_step: PositiveDuration = 30.0
    closing: PositiveDuration = 5.0
    budget: Annotated[int, Field(ge=0)] = 10
    window: PositiveDuration = 600.0
    first_delay: Annotated[Duration, Field(ge=0)] = 0.25
    longest_delay: Annotated[Duration, Field(ge=0)] = 30.0
    healthy: PositiveDuration = 30.0


class RecordSection(Section):
    """[record]: choice of the data that afspm records; files that components write themselves are always kept."""

    on: StrictBool = True
    """Whether published packets are recorded."""
    scans: StrictBool = True
    """Whether each scan and spectrum is also written to a file."""
    requests: StrictBool = False
    """Whether inputs and requests of components and scheduler are recorded for `afspm what-if`; independent of `on`."""


class MetadataSection(Section):
    """[metadata]: entries written into every file of the run; None: unknown."""

    technique: Literal["STM", "STS", "AFM"] | None = None
    """STM, STS or AFM; filled in by the class of a microscope with one technique."""
    sample: str | None = None
    person: str | None = None
    orcid: Orcid | None = None
    project: str | None = None
    microscope: str | None = None
    """Model, such as "Cypher S"."""
    vendor: str | None = None
    """Vendor of the microscope; by default the controller's."""
    probe: str | None = None
    """The mounted probe or tip, such as "PPP-NCHR 12/7": `afspm probes` lists the history of each."""


class NotifySection(Section):
    """[notify]: targets and occasions of notifications."""

    command: tuple[str, ...] = ()
    webhook: str = ""
    on: tuple[Literal["end", "unsolved-problem", "given-up", "critical", "by-hand", "solved"], ...] = (
        "end", "unsolved-problem", "given-up", "critical", "by-hand",
    )  # fmt: skip
    unsolved_after: PositiveDuration = 900.0
    """Experiment time for which a problem may be flagged before it counts as unsolved."""
    ping: str = ""
    every: Period = 300.0
    """Real time between two pings."""


class ExperimentSections(Section):
    """Sections that do not depend on the components."""

    clock: ClockSection = ClockSection()
    control: ControlSettings = ControlSettings()
    security: SecuritySection = SecuritySection()
    restart: RestartSection = RestartSection()
    record: RecordSection = RecordSection()
    metadata: MetadataSection = MetadataSection()
    notify: NotifySection = NotifySection()


def read_sections(tables: Mapping[str, Settings], document: Document) -> ExperimentSections:
    """Read all sections; a faulty section is reported, and its defaults are used."""
    return ExperimentSections.model_construct(
        **{
            name: parse(type(field.default), name, tables.get(name, {}), document)
            for name, field in ExperimentSections.model_fields.items()
        }
    )


S = TypeVar("S")


def parse(kind: type[S], name: str, table: Settings, document: Document, path: tuple[str, ...] | None = None) -> S:
    """Return the section `[name]`, a model or a dataclass; report errors, and use the defaults of the wrong keys.

    Args:
        path: the path of the table in the file; None: (name,).

    Raises:
        TypeError: a field of the class has no default.
    """
    if required := _required(kind):
        # found at the first file, and not only at one with an error in this section
        raise TypeError(f"{kind.__name__}.{required[0]} needs a default, which takes the place of a faulty [{name}]")
    adapter = pydantic.TypeAdapter(kind)
    try:
        return adapter.validate_python(table)
    except pydantic.ValidationError as error:
        right = table
        for place in report(error, table, (name,), document, partial(_fields_at, kind), path):
            right = _without(right, place, kind)
    try:
        return adapter.validate_python(right)  # further checks see the right keys: all errors are found at once
    except pydantic.ValidationError:
        return kind()


def _without(table: Settings, place: Sequence[str | int], kind: type) -> Settings:
    # of a mapping the wrong entry is left out; a section within a section, and a list, are right as a whole or not
    key, *inside = place or (None,)
    below = table.get(key) if isinstance(key, str) else None
    if isinstance(below, dict) and inside and not any(_sections_in(keys_of(kind).get(str(key)))):
        return {**table, str(key): {name: value for name, value in below.items() if name != inside[0]}}
    return {name: value for name, value in table.items() if name != key}


def keys_of(kind: type) -> dict[str, object]:
    """Return the keys of a section in the file, with their annotations."""
    if isinstance(kind, type) and issubclass(kind, pydantic.BaseModel):
        return {name: field.annotation for name, field in kind.model_fields.items()}
    hints = get_type_hints(kind, include_extras=True)
    return {file_key(name): hint for name, hint in hints.items() if get_origin(hint) is not ClassVar}


def _required(kind: type) -> list[str]:
    parameters = inspect.signature(kind).parameters.values()
    return [one.name for one in parameters if one.default is one.empty and one.kind is not one.VAR_KEYWORD]


def _fields_at(kind: type, location: tuple[str | int, ...]) -> tuple[str, ...]:
    here = kind
    for part in location[:-1]:
        here = next(_sections_in(keys_of(here).get(str(part))), here)
    return tuple(keys_of(here))


def _sections_in(annotation: object) -> Iterator[type]:
    if isinstance(annotation, type) and (issubclass(annotation, pydantic.BaseModel) or is_dataclass(annotation)):
        yield annotation
    for inner in get_args(annotation):
        yield from _sections_in(inner)
