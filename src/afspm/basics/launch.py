"""The launch line: one JSON line on standard input that gives a process its part in an experiment.

The same line goes to Python components (`python -m afspm.supervisor.host`) and to commands in any other
language. Standard input then stays open: its end means that the parent is gone, or stops the process.

On the heartbeat socket a process sends `[beat, age, longest, token]`: the byte 0 (alive) or 1 (closing on purpose),
the age of the current step in s (ASCII; 0 when idle), the longest duration of a step in s (ASCII), and
`beat_token`. All frames but the first are optional. The second and third distinguish a busy process from a frozen
process. After the first beat with the token, beats without the token are ignored, so that no other process can beat in
its place; for a process of a Python class the first beat already needs the token.
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
    """Socket addresses of one process; None for unused sockets."""

    publish: str | None = None
    """Bound: the process publishes here."""
    subscribe: tuple[str, ...] = ()
    """Connected: publishers that the process subscribes to."""
    serve: str | None = None
    """Bound: the process answers requests here."""
    control: str | None = None
    """Connected: the process sends requests here."""
    heartbeat: str | None = None
    """Connected: the supervisor listens for heartbeats here."""


@dataclass(frozen=True)
class Launch:
    """The launch line of a process: class, settings, sockets, clock and folders, in JSON's types."""

    name: str
    class_: str = ""
    """"package.module.Name" of a Python class; empty for a command of another language."""
    settings: PlainMapping = field(default_factory=dict)
    """Keyword arguments of the constructor."""
    sockets: Sockets = Sockets()
    envelopes: tuple[str, ...] | None = None
    """Prefixes of the envelopes (topics) to subscribe to; None: all."""
    clock: PlainMapping = field(default_factory=dict)
    """`ExperimentClock.as_dict()`; empty: real time."""
    problems: Mapping[str, int] = field(default_factory=dict)
    """Numbers of the problems that the experiment file names, by name."""
    run_dir: str = ""
    state_dir: str = ""
    """Folder for state that must survive a restart; empty: nothing is kept."""
    beat_period_s: float = 1.0
    beat_token: str = ""
    """Token in each heartbeat, which proves the sender's identity to the supervisor."""
    request_timeout_s: float = 5.0
    request_retries: int = 3
    log_level: str = "INFO"
    keys: PlainMapping | None = None
    """CURVE key pair of the process, and key owner of each address (`transport.keys.from_launch`); None: no keys."""
    messages: tuple[str, ...] = ()
    """Python modules, or .proto files, with the user's message types."""
    run: str = ""
    """The random identity of the run; empty: unknown."""
    simulated: bool = False
    """True only if the microscope is certainly simulated: by its translator, or by `controller`."""
    controller: str = ""
    """For a translator: the emulator of this run, as the only controller to connect to; empty: no emulator."""
    sample_coordinates: bool = False
    """Positions are sample coordinates, which the scheduler maps to tip coordinates."""
    retracts: bool = False
    """For a translator: retract the tip if standard input ends while a request of the run keeps the feedback off."""
    feedback_off: str = ""
    """For a translator: a text of its own for each start that a person makes with the feedback off by intention; the
    translator takes each text once."""
    adjustable: tuple[str, ...] = ()
    """For a translator: parameters that may be set during a scan."""
    solved: tuple[str, ...] = ()
    """For a scheduler: the problems that components of the run solve."""
    after: tuple[str, ...] = ()
    """Components that must be done before the script of this component begins."""
    keeps_requests: bool = False
    """Record inputs and requests of the process, for a replay by `afspm what-if`."""

    def to_json(self) -> str:
        """Return the launch line as JSON, without a newline at its end."""
        plain = dataclasses.asdict(self)
        plain["class"] = plain.pop("class_")
        return json.dumps(plain, ensure_ascii=False, allow_nan=False, separators=(",", ":"))

    @classmethod
    def from_json(cls, line: str | bytes) -> Launch:
        """Parse a launch line.

        Raises:
            ConfigError: the line is no JSON object, the name is missing, or an entry is unknown, negative or of the
                wrong type.
        """
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


# JSON has one type of number, and 1.0 may be written as 1
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
"""JSON types by the annotation of a field."""


def _fields(cls: type[Launch | Sockets], plain: object, where: str) -> Plain:
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
    # a bool is an int in Python
    fits = isinstance(value, _JSON_TYPES[kind]) and (kind == "bool" or not isinstance(value, bool))
    if isinstance(value, int | float):
        fits = fits and value >= 0
    if isinstance(value, list):
        fits = fits and all(isinstance(item, str) for item in value)
    if not fits:
        raise ConfigError(f"{key!r} can't be {value!r}", where=where)
    return tuple(value) if isinstance(value, list) else value
