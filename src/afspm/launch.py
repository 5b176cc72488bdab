"""What a process is told when it starts: one JSON line on its standard input.

The same line goes to Python components (`python -m afspm.process.host`) and to commands in any other
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
from typing import Any

from afspm.errors import ConfigError


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
    """All that a process needs to know to take part in an experiment. Values are JSON's own types."""

    name: str
    class_: str = ""
    """"package.module.Name" of a Python class; empty for a command of another language."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Keyword arguments of the constructor."""
    sockets: Sockets = Sockets()
    envelopes: tuple[str, ...] | None = None
    """Prefixes of the envelopes subscribed to; None: all."""
    clock: Mapping[str, Any] = field(default_factory=dict)
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
    keys: Mapping[str, Any] | None = None
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
    """Whether places are those of the sample, which the scheduler maps to those of the tip."""
    retracts: bool = False
    """Of a translator: whether it retracts the tip when its standard input ends and a request of the run has switched
    the feedback off."""

    def to_json(self) -> str:
        """One line, without the newline at its end."""
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


_STRINGS = {"name", "class_", "run", "controller", "beat_token", "run_dir", "state_dir", "log_level"}
_NUMBERS = {"beat_period_s", "request_timeout_s", "request_retries"}
_TABLES = {"settings", "clock", "problems"}
_LISTS = {"subscribe", "envelopes", "messages"}


def _fields(cls: type[Any], plain: Any, where: str) -> dict[str, Any]:
    """The values of `plain` as arguments of the dataclass `cls`, each of the JSON type that belongs there."""
    if not isinstance(plain, dict):
        raise ConfigError(f"expected a JSON object, got {type(plain).__name__}", where=where)
    names = {f.name for f in dataclasses.fields(cls)}
    if cls is Launch and not plain.get("name"):
        raise ConfigError("the process has no name", where=where)
    values: dict[str, Any] = {}
    for key, value in plain.items():
        if key not in names:
            near = difflib.get_close_matches(key, names, n=1)
            raise ConfigError(f"unknown entry {key!r}", where=where, hint=f"did you mean {near[0]!r}?" if near else "")
        values[key] = _checked(cls, key, value, where)
    return values


def _checked(cls: type[Any], key: str, value: Any, where: str) -> Any:
    """`value`, lists made tuples; refused if its type can't be right for the field `key`."""
    if key in _LISTS and isinstance(value, list):
        if not all(isinstance(item, str) for item in value):
            raise ConfigError(f"{key!r} must be a list of strings", where=where)
        return tuple(value)
    if key in _LISTS:
        fits = value is None and key == "envelopes"
    elif cls is Sockets:
        fits = isinstance(value, str) or value is None
    elif key in _STRINGS:
        fits = isinstance(value, str)
    elif key in _NUMBERS:
        fits = isinstance(value, int | float) and not isinstance(value, bool) and value >= 0
    elif key in _TABLES:
        fits = isinstance(value, dict)
    else:
        fits = value is None or isinstance(value, dict | bool)
    if not fits:
        raise ConfigError(f"{key!r} can't be {value!r}", where=where)
    return value
