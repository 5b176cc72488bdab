"""Our own sections of the experiment file, as pydantic models. Only loaded where a file is checked or run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from functools import partial
from typing import Annotated, Literal, TypeVar, get_args

import pydantic
from pydantic import Field, StrictBool

from afspm.experiment.document import Document
from afspm.experiment.run_metadata import Orcid
from afspm.experiment.toml_lines import Settings
from afspm.experiment.validation_messages import report
from afspm.units import Duration


class Section(pydantic.BaseModel):
    """Base: an unknown key is an error."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, strict=False)


DangerousState = Literal["MOVING", "SCANNING", "COARSE_MOTOR", "BUSY_PARAM", "SPEC", "feedback-off"]
AdjustableParameter = Literal["zctrl-setpoint", "zctrl-pgain", "zctrl-igain", "tip-bias-voltage"]
"""What a person may be allowed to set while a component measures: none of it moves the tip elsewhere."""
PositiveDuration = Annotated[Duration, Field(gt=0)]


class ClockSection(Section):
    """[clock]: when the experiment's time begins and how fast it goes (simulated microscopes only)."""

    start: datetime | None = None
    speed: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    waits: StrictBool = True


class RolesSection(Section):
    """[control.roles]: who may do what concerns everyone; None: everyone may."""

    end_experiment: tuple[str, ...] | None = None
    set_mode: tuple[str, ...] | None = None
    clear_problems: tuple[str, ...] | None = None
    operate: tuple[str, ...] | None = None
    """Who may command the microscope in MANUAL mode; None: the components that are made for it, such as a dashboard."""
    restart: tuple[str, ...] | None = None


class ControlSection(Section):
    """[control]: how control is given and taken away."""

    lease: PositiveDuration | None = None
    grace: Annotated[Duration, Field(ge=0)] = 5.0
    stop_scan_on_problem: StrictBool = True
    stop_scan_on_manual: StrictBool = True
    request_timeout: PositiveDuration = 5.0
    request_retries: Annotated[int, Field(ge=0)] = 3
    malfunction_after: Annotated[Duration, Field(ge=0)] = 5.0
    """Real seconds that the microscope may be lost, before that is a malfunction and nobody stays in control."""
    idle: Literal["end", "stay"] = "end"
    """Whether the run ends when nothing that acts is left: no plan goes on, and no client is in control."""
    solved_by_hand: tuple[str, ...] = ("device-malfunction",)
    """Problems that a person puts right: they may be flagged though no component solves them."""
    end_on: tuple[str, ...] = ()
    """Problems that end the experiment when they are flagged."""
    retract: StrictBool = True
    """Whether the tip is retracted when control is left in a dangerous state, where the microscope can."""
    dangerous: tuple[DangerousState, ...] | None = None
    """Those states; None: what the watchdog takes for dangerous by itself."""
    adjustable: tuple[AdjustableParameter, ...] = ()
    """Parameters that who may operate sets in AUTOMATED mode, too, beside the component in control."""
    roles: RolesSection = RolesSection()


class SecuritySection(Section):
    """[security]: the folder of CURVE keys, or the spoken word that there are none."""

    keys: str | None = None
    plain: StrictBool = False
    """No keys are made for the run either: programs of this computer that know nothing of keys can join."""
    insecure: StrictBool = False


class RestartSection(Section):
    """[restart]: how patiently processes are watched, and how often they are started again. Real time."""

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
    """[record]: what is kept of a run, beside what components write."""

    on: StrictBool = True
    scans: StrictBool = True
    """Scans and spectra, too, each as a file."""


class MetadataSection(Section):
    """[metadata]: what is written into every file of the run; None: not known."""

    technique: Literal["STM", "STS", "AFM"] | None = None
    """STM, STS or AFM; of a microscope that is always the same, its class knows it."""
    sample: str | None = None
    person: str | None = None
    orcid: Orcid | None = None
    project: str | None = None
    microscope: str | None = None
    """The model, such as "Cypher S"."""
    vendor: str | None = None
    """Of the microscope; if it is not given, that of the controller."""


class NotifySection(Section):
    """[notify]: who is told, outside of the experiment, of what."""

    command: tuple[str, ...] = ()
    webhook: str = ""
    on: tuple[Literal["end", "unsolved-problem", "given-up", "critical"], ...] = (
        "end", "unsolved-problem", "given-up", "critical",
    )  # fmt: skip
    unsolved_after: PositiveDuration = 900.0
    """Experiment time for which a problem may be flagged before it counts as unsolved."""


class ExperimentSections(Section):
    """The sections that mean the same whatever components there are."""

    clock: ClockSection = ClockSection()
    control: ControlSection = ControlSection()
    security: SecuritySection = SecuritySection()
    restart: RestartSection = RestartSection()
    record: RecordSection = RecordSection()
    metadata: MetadataSection = MetadataSection()
    notify: NotifySection = NotifySection()


def read_sections(tables: Mapping[str, Settings], document: Document) -> ExperimentSections:
    """Read them all; what is wrong with one is reported, and its defaults taken."""
    return ExperimentSections.model_construct(
        **{
            name: parse(type(field.default), name, tables.get(name, {}), document)
            for name, field in ExperimentSections.model_fields.items()
        }
    )


S = TypeVar("S", bound=Section)


def parse(model: type[S], name: str, table: Settings, document: Document) -> S:
    """Return the section `[name]`; what is wrong with it is reported, and its defaults returned."""
    try:
        return model.model_validate(table)
    except pydantic.ValidationError as error:
        report(error, table, (name,), document, partial(_fields_at, model))
        return model()


def _fields_at(model: type[pydantic.BaseModel], location: tuple[str | int, ...]) -> tuple[str, ...]:
    """The names that are valid where an error occurred: those of the (sub)section around it."""
    here: type[pydantic.BaseModel] = model
    for part in location[:-1]:
        info = here.model_fields.get(str(part))
        here = next(_sections_in(info.annotation), here) if info else here
    return tuple(here.model_fields)


def _sections_in(annotation: object) -> Iterator[type[pydantic.BaseModel]]:
    """Return the sections that an annotation speaks of: itself, or within a union or a tuple."""
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _sections_in(inner)
