"""The documents of the gateway, in SI units: answers and request bodies. They define the OpenAPI description.

Ids are texts with times in nanoseconds, because not every language has exact 64-bit numbers in JSON.
"""

from __future__ import annotations

from enum import Enum
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

from afspm import wire
from afspm.model import LONGEST_NOTE
from afspm.plugins.web.gateway.problems import RefusalModel

LONGEST_LEASE_S = 3600.0


def _no_truth(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError("a number, not true or false")  # Python would take them for 1 and 0
    return value


NUMERIC = BeforeValidator(_no_truth)  # last: later validators are missing in the description
NUMBER = Annotated[float, Field(allow_inf_nan=False), NUMERIC]
PLACE = Annotated[float, Field(ge=-1.0, le=1.0), NUMERIC]
LENGTH = Annotated[float, Field(gt=0.0, le=1.0), NUMERIC]
ANGLE = Annotated[float, Field(ge=-6.3, le=6.3), NUMERIC]
SECONDS = Annotated[float, Field(ge=1.0, le=LONGEST_LEASE_S), NUMERIC]
PIXELS = Annotated[int, Field(ge=1, le=16384), NUMERIC]
TWO = Field(min_length=2, max_length=2)
PlacePair = Annotated[list[PLACE], TWO]
LengthPair = Annotated[list[LENGTH], TWO]
PixelPair = Annotated[list[PIXELS], TWO]
Pair = Annotated[list[float], TWO]
Shape = Annotated[list[int], TWO]
TEXT = r"^[^\x00-\x08\x0b-\x1f\x7f-\x9f]*[^\s\x00-\x1f\x7f-\x9f][^\x00-\x08\x0b-\x1f\x7f-\x9f]*$"
ID = Annotated[str, Field(pattern=r"^[0-9]{1,20}$", examples=["1795320000000000000"])]
KEY = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9._-]{1,64}$", examples=["tile-3"], description="makes it happen once in this run")
]
TIME = Annotated[str, Field(description="UTC, ISO 8601", examples=["2026-11-22T04:00:00.000000Z"])]
PARAMETER = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
VALUE = NUMBER | bool | Annotated[str, Field(min_length=1, max_length=100)]
SETTINGS = Annotated[
    dict[Annotated[str, Field(pattern=PARAMETER)], VALUE],
    Field(
        max_length=100,
        description="values of parameters for this measurement alone: numbers in SI, or text with a unit",
        examples=[{"tip-bias-voltage": "0.5 V"}],
        json_schema_extra={"additionalProperties": False},
    ),
]


class _Answer(BaseModel):
    model_config = ConfigDict(frozen=True)


class _Asked(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RegionModel(_Asked):
    """A rectangle rotated about its centre; x to the right, y upwards."""

    center_m: PlacePair = Field(description="(x, y)", examples=[[0.0, 0.0]])
    size_m: LengthPair = Field(description="(width, height)", examples=[[1e-6, 1e-6]])
    angle_rad: ANGLE = Field(default=0.0, description="counter-clockwise")


class MicroscopeModel(_Answer):
    """The activity of the microscope. None: not published yet."""

    state: str = Field(examples=["FREE"])
    region: RegionModel | None = Field(default=None, description="of the next scan")
    shape: Shape | None = Field(default=None, description="(rows, columns) of the next scan")
    probe_m: Pair | None = Field(default=None, description="(x, y) where the probe stands")
    feedback_on: bool | None = None
    setpoint: float | None = Field(default=None, description="in the unit of the operating mode")


class StateModel(_Answer):
    """The state of the experiment."""

    experiment: str
    simulated: bool
    time: TIME
    mode: str = Field(examples=["AUTOMATED"])
    holder: str | None = Field(description="who is in control")
    problems: list[str] = Field(description="that are flagged")
    microscope: MicroscopeModel
    you: str | None = Field(description="the name that the scheduler knows you by; None: you only look")
    in_control: bool = Field(description="you are the holder")
    ended: bool
    silent_s: float = Field(description="real seconds since the last message of the experiment")
    last_event: str | None = Field(description="id of the newest event, for Last-Event-ID")


class ParameterModel(_Answer):
    """A parameter with its value in force."""

    name: str = Field(examples=["scan-speed"])
    value: float | str | bool | None = Field(examples=[2e-6])
    unit: str = Field(description="SI where it has one", examples=["m/s"])


class ParameterChange(_Asked):
    """A value to set. A number without a unit is in SI; text may carry its unit, as "0.5 V"."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"value": 0.5, "unit": "V"}, {"value": "500 mV"}]})

    value: VALUE
    unit: str | None = Field(default=None, min_length=1, max_length=30)


class ChannelModel(_Answer):
    """A channel of a scan."""

    name: str = Field(examples=["Height"])
    unit: str = Field(examples=["m"])


class ScanModel(_Answer):
    """A scan, without its values."""

    id: ID
    number: int = Field(description="in the run, from 1, as far as the gateway has seen it")
    began: TIME | None
    finished: TIME
    region: RegionModel
    shape: Shape = Field(description="(rows, columns)")
    channels: list[ChannelModel]
    holder: str | None = Field(description="who was in control")
    interrupted: bool
    file: str = Field(description="where the controller saved it; empty if it did not")


class VariableModel(ChannelModel):
    """A variable of a spectrum."""

    role: str = Field(description="the quantity, alike on all microscopes; may be empty", examples=["force, retrace"])


class SpectrumModel(_Answer):
    """A spectrum, without its values."""

    id: ID
    finished: TIME
    kind: str = Field(examples=["IV"])
    position_m: Pair | None
    variables: list[VariableModel]
    holder: str | None


class ValueFormat(Enum):
    """The formats of values."""

    NPY = "npy"
    PNG = "png"
    BASE64 = "base64"


class ArrayModel(_Answer):
    """Values as text: float64, little endian, row after row; of a scan the first row is the lowest.

    NaN means not measured.
    """

    shape: Shape = Field(description="of a scan (rows, columns), of a spectrum (points, variables)")
    dtype: Literal["<f8"] = "<f8"
    units: list[str]
    base64: str


class SpectrumFormat(Enum):
    """The formats of the values of a spectrum."""

    NPY = "npy"
    BASE64 = "base64"


class LeaseModel(_Asked):
    """The real seconds for which you keep control without a command or a renewal, also during a measurement."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"lease_s": 60}]})

    lease_s: SECONDS = 60.0


class ControlAsked(LeaseModel):
    """A request for control."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"lease_s": 60}, {"lease_s": 120, "solving": "tip-shape-changed"}]}
    )

    solving: str | None = Field(default=None, max_length=100, description="the flagged problem that you will solve")


class ControlModel(_Answer):
    """Your control of the experiment, with its lease."""

    holder: str
    lease_s: float = Field(description="renew it in half of that")


class ScanAsked(_Asked):
    """A scan to take. Omitted fields stay as they are set."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"region": {"center_m": [0, 0], "size_m": [1e-6, 1e-6]}, "shape": [64, 64], "key": "tile-3"},
                {"settings": {"tip-bias-voltage": "0.5 V", "scan-speed": 2e-6}},
                {},
            ]
        }
    )

    region: RegionModel | None = None
    shape: PixelPair | None = Field(default=None, description="(rows, columns)")
    settings: SETTINGS | None = None
    key: KEY | None = None


class SpectrumAsked(_Asked):
    """A spectrum to take. Omitted fields stay as they are set."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"position_m": [0, 0], "key": "iv-1"}, {}]})

    position_m: PlacePair | None = Field(default=None, description="(x, y) that the probe is moved to")
    settings: SETTINGS | None = None
    key: KEY | None = None


class MeasurementState(Enum):
    """The states of a measurement."""

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


class MeasurementModel(_Answer):
    """A requested scan or spectrum."""

    id: KEY = Field(description="its key; one is made up where none was given")
    kind: Literal["scan", "spectrum"]
    state: MeasurementState
    result: ID | None = Field(default=None, description="id of the scan or spectrum, when it is done")
    refusal: RefusalModel | None = Field(default=None, description="why it failed")


class ActionModel(_Answer):
    """An action of the microscope."""

    name: str = Field(examples=["x-retract"])


class ProblemModel(_Answer):
    """A problem of the experiment, flagged or not."""

    name: str = Field(examples=["tip-shape-changed"])
    flagged: bool


class ModeModel(_Asked):
    """The control mode."""

    mode: Literal["MANUAL", "AUTOMATED"]


class NoteAsked(_Asked):
    """A remark for the record."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"text": "the light was on"}]})

    text: Annotated[str, Field(pattern=TEXT, max_length=LONGEST_NOTE)]
    scan: ID | None = Field(default=None, description="that it belongs to")


class DoneModel(_Answer):
    """The answer to a request that was carried out."""

    done: Literal[True] = True


MISSED, END = "missed", "end"
"""Events of the gateway itself."""


def event_kinds() -> tuple[str, ...]:
    """Return the kinds of events: the kinds of declared messages, then the gateway's own."""
    return (*(message.event for message in wire.declared() if message.event), MISSED, END)


def _known(kind: str) -> str:
    if kind not in event_kinds():
        raise ValueError(f"no kind of events: one of {', '.join(event_kinds())}")
    return kind


EventKind = Annotated[str, AfterValidator(_known), WithJsonSchema({"type": "string", "enum": list(event_kinds())})]


class EventModel(_Answer):
    """The data of an event. A `missed` event has `after` and `until`: events between these ids were left out."""

    time: TIME | None
    data: dict[str, object]
