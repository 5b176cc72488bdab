"""The launch line: one JSON line on standard input from which a process learns its part in an experiment.

The same line goes to Python components (`python -m afspm.supervisor.host`) and to commands in any other
language. Standard input then stays open: its end means that the parent is gone or wants us to stop.

On the heartbeat socket a process sends `[beat, age, longest, token]`: the byte 0 (alive) or 1 (closing on purpose),
for how many seconds the current step has been running (ASCII; 0 when idle), how long a step may take (ASCII), and
`beat_token`. All but the first are optional. The second and third tell busy from frozen; once the fourth has come,
nobody else can beat for the process.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import NoneType

from afspm.basics.errors import ConfigError
from afspm.basics.plain_data import Plain, PlainMapping


@dataclass(frozen=True)
class Sockets:
    """The addresses of one process. Absent ones are not used."""

    publish: str | None = None
    """Bound: where we publish."""
    subscribe: tuple[str, ...] = ()
    """Connected: the publishers we listen to."""
    serve: str | None = None
    """Bound: where we answer requests."""
    control: str | None = None
    """Connected: whom we send requests to."""
    heartbeat: str | None = None
    """Connected: where the supervisor listens for our beats."""


@dataclass(frozen=True)
class Launch:
    """A process's part in an experiment, in JSON's own types."""

    name: str
    class_: str = ""
    """"package.module.Name" of a Python class; empty for a command of another language."""
    settings: PlainMapping = field(default_factory=dict)
    """Keyword arguments of the constructor."""
    sockets: Sockets = Sockets()
    envelopes: tuple[str, ...] | None = None
    """Prefixes of the envelopes subscribed to; None: all."""
    clock: PlainMapping = field(default_factory=dict)
    """`ExperimentClock.as_dict()`; empty: real time."""
    problems: Mapping[str, int] = field(default_factory=dict)
    """Problems named in the experiment file."""
    run_dir: str = ""
    state_dir: str = ""
    """Where to keep what must survive a restart; empty: nothing is kept."""
    beat_period_s: float = 1.0
    beat_token: str = ""
    """To be sent with each heartbeat: the supervisor knows by it who beats."""
    request_timeout_s: float = 5.0
    request_retries: int = 3
    log_level: str = "INFO"
    keys: PlainMapping | None = None
    """The own CURVE pair, and whose key to expect where, see `transport.keys.from_launch`; None: no encryption."""
    messages: tuple[str, ...] = ()
    """Python modules, or .proto files, with message types of the user."""
    run: str = ""
    """The identity of the run, random; empty: it is not known."""
    simulated: bool = False
    """True only where the microscope is simulated for certain: by its translator itself, or by `controller`."""
    controller: str = ""
    """Of a translator: the name of the emulator of this run that it talks to, and to nobody else; empty: none."""
    sample_coordinates: bool = False
    """Places are those of the sample, which the scheduler maps to those of the tip."""
    retracts: bool = False
    """Of a translator: it retracts the tip when its standard input ends and a request of the run has switched the
    feedback off."""
    adjustable: tuple[str, ...] = ()
    """Of a translator: parameters that are set during a scan, too."""
    solved: tuple[str, ...] = ()
    """Of a scheduler: the problems that components of the run solve."""

    def to_json(self) -> str:
        """Return one line, without the newline at its end."""
        plain = dataclasses.asdict(self)
        plain["class"] = plain.pop("class_")
        return json.dumps(plain, ensure_ascii=False, allow_nan=False, separators=(",", ":"))

    @classmethod
    def from_json(cls, line: str | bytes) -> Launch:
        """Read what `to_json` wrote. Raises ConfigError naming what is wrong."""
        try:
            plain = json.loads(line)
        except ValueError as error:
            raise ConfigError(
                f"the launch line is not JSON: {error}",
                where="standard input",
                hint="this program is started by `afspm run`; see the reference on launching components",
            ) from error
        if not isinstance(plain, dict):
            raise ConfigError("the launch line is not a JSON object", where="standard input")
        if "class" in plain:
            plain["class_"] = plain.pop("class")
        sockets = plain.pop("sockets", None) or {}
        values = _fields(cls, plain, "launch line")
        return cls(**values, sockets=Sockets(**_fields(Sockets, sockets, "launch line, sockets")))


_JSON_TYPES: Mapping[str, tuple[type, ...]] = {
    "str": (str,),
    "str | None": (str, NoneType),
    "int": (int, float),
    "float": (int, float),
    "bool": (bool,),
    "PlainMapping": (dict,),
    "Mapping[str, int]": (dict,),
    "PlainMapping | None": (dict, NoneType),
    "tuple[str, ...]": (list,),
    "tuple[str, ...] | None": (list, NoneType),
}
"""By the annotation of a field."""


def _fields(cls: type[Launch | Sockets], plain: object, where: str) -> Plain:
    """Return the values of `plain` as arguments of the dataclass `cls`, each of the JSON type that belongs there."""
    if not isinstance(plain, dict):
        raise ConfigError(f"expected a JSON object, got {type(plain).__name__}", where=where)
    if cls is Launch and not plain.get("name"):
        raise ConfigError("the process has no name", where=where)
    kinds = {field.name: str(field.type) for field in dataclasses.fields(cls)}
    for key in plain.keys() - kinds.keys():
        near = difflib.get_close_matches(key, kinds, n=1)
        raise ConfigError(f"unknown entry {key!r}", where=where, hint=f"did you mean {near[0]!r}?" if near else "")
    return {key: _checked(key, value, kinds[key], where) for key, value in plain.items()}


def _checked(key: str, value: object, kind: str, where: str) -> object:
    fits = isinstance(value, _JSON_TYPES[kind]) and (kind == "bool" or not isinstance(value, bool))
    if isinstance(value, int | float):
        fits = fits and value >= 0
    if isinstance(value, list):
        fits = fits and all(isinstance(item, str) for item in value)
    if not fits:
        raise ConfigError(f"{key!r} can't be {value!r}", where=where)
    return tuple(value) if isinstance(value, list) else value
