"""Diagnoses from the measurements of `afspm doctor`: each problem in plain terms, with its remedy.

A refused connection comes from the other computer; silence means a firewall or a computer that is off; a wrong greeting
means another program. The scheduler's authenticator refuses an unknown key with a reason; a wrong public key of the
scheduler ends the key exchange without one. `afspm doctor` needs no service on the other computers, which could not be
reached when the network fails.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

from afspm.basics.entry_points import DeclaredName
from afspm.basics.formatting import duration_text


class Severity(Enum):
    """The weight of a diagnosis: an ERROR keeps the experiment from working."""

    FINE = "fine"
    WARNING = "warning"
    ERROR = "error"


class Reach(Enum):
    """The outcome of an attempt to connect to an address."""

    OPEN = "open"
    OTHER_PROGRAM = "other-program"
    """A program answers, but not with ZeroMQ's protocol."""
    NO_GREETING = "no-greeting"
    """A program accepts the connection, but sends nothing."""
    REFUSED = "refused"
    SILENT = "silent"
    """The connection is neither accepted nor refused."""
    NO_ROUTE = "no-route"
    UNKNOWN_NAME = "unknown-name"


class Handshake(Enum):
    """The outcome of the key exchange on an open connection."""

    DONE = "done"
    KEY_REFUSED = "key-refused"
    FAILED = "failed"
    SILENT = "silent"


@dataclass(frozen=True)
class Diagnosis:
    """The result of one check of `afspm doctor`, with its severity.

    Attributes:
        code: identifier for programs.
        where: the address, file or computer.
        remedy: the remedy; empty if nothing is wrong.
    """

    code: str
    severity: Severity
    where: str
    what: str
    remedy: str = ""


@dataclass(frozen=True)
class Versions:
    """Versions of the programs on one computer."""

    afspm: str
    python: str
    libzmq: str


def of_packages(declared: Iterable[DeclaredName]) -> Iterator[Diagnosis]:
    """Yield a warning for each unusable name, then the names that each package adds to afspm, one line per group.

    An unusable name is no error: only an experiment with this name fails.
    """
    usable: dict[tuple[str, str], list[str]] = {}
    for one in declared:
        if one.problem:
            what = f"{one.group} {one.name}: {one.problem}" if one.name else one.problem
            yield Diagnosis("package", Severity.WARNING, one.package, what, "mend or uninstall the package")
        else:
            usable.setdefault((one.package, one.group.removeprefix("afspm.")), []).append(one.name)
    for (package, group), names in usable.items():
        yield fine("package", package, f"{group} {', '.join(names)}")


def fine(code: str, where: str, what: str) -> Diagnosis:
    return Diagnosis(code, Severity.FINE, where, what)


_UNREACHED: Mapping[Reach, tuple[str, str]] = {
    Reach.OTHER_PROGRAM: (
        "another program has this port: what answers does not speak ZeroMQ",
        "end that program, or give the experiment another port",
    ),
    Reach.NO_GREETING: (
        "the connection is accepted, but nothing is sent: that process hangs, or is another program",
        "look which program has this port; a process of the experiment that hangs is restarted by itself",
    ),
    Reach.SILENT: (
        "no answer at all: a firewall drops the messages, the cable is out, or that computer is off",
        "check that it is on and has this address; then let its firewall accept this port",
    ),
    Reach.NO_ROUTE: (
        "this computer has no way to that network",
        "plug in the cable, or correct the address: both computers belong to one network",
    ),
    Reach.UNKNOWN_NAME: (
        "this name leads to no address",
        "correct it, write it into the hosts file of this computer, or use the number instead",
    ),
}


def of_address(owner: str, address: str, reach: Reach, *, is_here: bool, expected: bool) -> Diagnosis:
    """Return the diagnosis of an address at which `owner` listens.

    Args:
        is_here: whether the address belongs to this computer.
        expected: whether the experiment is running, so that `owner` should listen.
    """
    where = f"{owner} at {address}"
    if reach is Reach.OPEN:
        return fine("reached", where, "it listens")
    if reach is not Reach.REFUSED:
        what, remedy = _UNREACHED[reach]
        return Diagnosis(reach.value, Severity.ERROR, where, what, remedy)
    if is_here and not expected:
        return fine("free", where, "the port is free: it is not started yet")
    what = "that computer is there, and nothing listens at this port"
    remedy = f"start {owner} there, or correct the address; a firewall that refuses looks the same"
    return Diagnosis(reach.value, Severity.ERROR if expected else Severity.WARNING, where, what, remedy)


def of_handshake(address: str, handshake: Handshake, key: str, server: str) -> Diagnosis:
    """Return the diagnosis of a key exchange at an address of the process `server`.

    Args:
        key: owner of the key of this computer's connection; empty without keys.
    """
    code = f"key-{handshake.value}"
    if handshake is Handshake.DONE:
        return fine(code, address, f"the key of {key} is accepted" if key else "no key is needed")
    if handshake is Handshake.KEY_REFUSED:
        what = f"{server} does not know the key of {key}"
        return Diagnosis(
            "key-unknown", Severity.ERROR, address, what, f"copy keys/public/{key}.key to the computer of {server}"
        )
    what = f"the connection stands, but keys do not fit: perhaps keys/public/{server}.key here is of another process"
    remedy = f"copy keys/public of the computer of {server} to this one"
    return Diagnosis("key-mismatch", Severity.ERROR, address, what, remedy)


MOST_AHEAD_S = 1.0


def of_clock(ahead_s: float, uncertain_s: float) -> Diagnosis:
    """Return the diagnosis of the difference between this computer's clock and the scheduler's clock.

    Args:
        ahead_s: lead of this computer's clock over the scheduler's clock.
        uncertain_s: uncertainty of the measured lead.
    """
    where = "the clock of this computer"
    if abs(ahead_s) <= MOST_AHEAD_S + uncertain_s:
        return fine("clock", where, f"agrees with the scheduler's clock to {abs(ahead_s) + uncertain_s:.2f} s")
    way = "ahead of" if ahead_s > 0.0 else "behind"
    what = f"is {duration_text(abs(ahead_s))} {way} the scheduler's clock"
    remedy = "let both computers take their time from the network (NTP): files and logs have times that do not fit"
    return Diagnosis("clock", Severity.WARNING, where, what, remedy)


def of_versions(ours: Versions, theirs: Versions | None) -> Diagnosis:
    """Return the diagnosis of the versions on this computer and on the scheduler's computer; None: unknown there."""
    here = f"afspm {ours.afspm}, Python {ours.python}, libzmq {ours.libzmq}"
    if theirs is None or theirs == ours:
        return fine("versions", "this computer", here)
    there = f"afspm {theirs.afspm}, Python {theirs.python}, libzmq {theirs.libzmq}"
    what = f"{here}; the scheduler's computer: {there}"
    if theirs.afspm == ours.afspm:
        return fine("versions", "this computer", what)
    remedy = f"install the same on both: afspm {theirs.afspm}"
    return Diagnosis("versions", Severity.WARNING, "this computer", what, remedy)


LEAST_FREE_BYTES, SMALL_FREE_BYTES = 1 << 30, 10 << 30
LEAST_BYTES_PER_S = 20e6


def of_disk(folder: str, free_bytes: int, bytes_per_s: float) -> Iterator[Diagnosis]:
    """Yield the diagnoses of free space and writing speed (bytes/s) of the disk with the run folders."""
    free = f"{free_bytes / 1e9:.1f} GB free"
    if free_bytes < SMALL_FREE_BYTES:
        severity = Severity.ERROR if free_bytes < LEAST_FREE_BYTES else Severity.WARNING
        yield Diagnosis("disk-space", severity, folder, free, "make room, or choose another disk with --runs")
    else:
        yield fine("disk-space", folder, free)
    speed = f"writes {bytes_per_s / 1e6:.0f} MB/s"
    if bytes_per_s < LEAST_BYTES_PER_S:
        remedy = "keep runs on a disk of this computer, and copy them in the morning"
        yield Diagnosis("disk-speed", Severity.WARNING, folder, speed, remedy)
    else:
        yield fine("disk-speed", folder, speed)


LEAST_MEMORY_BYTES = 1 << 30


def of_memory(available: int, used: Mapping[str, int]) -> Diagnosis:
    """Return the diagnosis of this computer's memory.

    Args:
        available: free memory in bytes.
        used: memory of each process of the experiment, in bytes.
    """
    largest = sorted(used.items(), key=lambda one: -one[1])[:5]
    users = "".join(f", {name} {size / 1e6:.0f} MB" for name, size in largest)
    what = f"{available / 1e9:.1f} GB available{users}"
    if available >= LEAST_MEMORY_BYTES:
        return fine("memory", "this computer", what)
    return Diagnosis("memory", Severity.WARNING, "this computer", what, "close other programs")


@dataclass(frozen=True)
class Heard:
    """The packets received under one envelope: their number, and their size in bytes."""

    envelope: str
    count: int
    size: int
    listened_s: float

    @property
    def rate_hz(self) -> float:
        return self.count / self.listened_s

    @property
    def bytes_per_s(self) -> float:
        return self.size / self.listened_s


def of_publisher(address: str, heard: Iterable[Heard], *, caught_up: bool) -> Diagnosis:
    """Return the diagnosis of the packets received from the scheduler's publisher.

    Args:
        caught_up: whether all cached packets have arrived.
    """
    count = sum(one.count for one in heard)
    if caught_up:
        return fine("heard", address, f"{count} packets while listening, after all that was cached")
    what = "the publisher is connected, but sends nothing"
    remedy = "wait a moment; if it stays so, the link is too slow for the scans that are cached, or the scheduler hangs"
    return Diagnosis("silent-publisher", Severity.ERROR, address, what, remedy)


def is_well(found: Iterable[Diagnosis]) -> bool:
    """Return whether no diagnosis is an error."""
    return all(one.severity is not Severity.ERROR for one in found)
