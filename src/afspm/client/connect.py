"""`afspm.connect`: connects a script or notebook to a running experiment."""

from __future__ import annotations

import dataclasses
import json
import logging
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.basics.argument_checks import PATH, TEXT, checked
from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError, FileError, NoResponse
from afspm.basics.launch import Launch, Sockets
from afspm.basics.plain_data import Plain, from_json
from afspm.basics.toml import parse_toml
from afspm.client.experiment_link import ExperimentLink
from afspm.model import Frame, ProblemNames
from afspm.model.events import is_process_name
from afspm.record import cut_off_message, goes_on, latest_run, read_run_json
from afspm.record.run_json import RUN_FILE, STATE_DIR, run_json_or_empty
from afspm.record.run_lock import is_locked
from afspm.transport.process.context import new_session
from afspm.transport.zmq_port import open_port
from afspm.wire.message_types import register_all

if TYPE_CHECKING:
    from afspm.client.scope import Scope

GUEST = "guest"
GUEST_KEYS = "guest.keys"
"""The file with the keys of guests, in the state folder of the run; see `supervisor.key_handout`."""
JOINED_WITHIN_S = 5.0  # real time, where no run holds its lock on this computer
STARTED_WITHIN_S = 60.0
"""Limit for a run that holds its lock on this computer: a busy one takes long to start its scheduler."""
HEARD_WITHIN_S = 30.0  # the cache may hold many large scans


@checked({"where": PATH, "name": TEXT})
def connect(where: str | Path = "runs", name: str = "notebook", *, messages: Sequence[str] = ()) -> Scope:
    """Join a running experiment; use the returned scope like `self.scope` in a component.

        with afspm.connect("runs/my_experiment-20261120-040000") as scope:
            scope.scan(afspm.Region((0, 0), (2e-6, 2e-6)))

    Args:
        where: the folder of the run, the folder of all runs (for the newest), or the experiment file (for its newest
            run, in the folder `runs` here or beside it). If several of these runs go on, name the folder of one.
        name: name of this program in the experiment, shown as the holder of control. Two programs need two names.
        messages: modules and .proto files with message types of your own, as in the experiment file. Only these are
            imported, not the run's own list, since its folder may come from another person.

    Raises:
        FileError: there is no such run, or several go on.
        ConfigError: the run has no scheduler to connect to, `messages` can't be imported, or `name` can't be a name.
        NoResponse: the scheduler does not answer within 5 s (60 s if the run is going on on this computer), or its
            cached packets do not arrive within 30 s.
        ExperimentEnded: the experiment has just ended.
    """
    if not is_process_name(name):
        hint = "letters, digits, - and _, with spaces and dots between them"
        raise ConfigError(f"{name!r} can't be the name of a program", where="connect", hint=hint)
    return join(find_one_run(Path(where)), name, messages)


def join(folder: Path, name: str, messages: Sequence[str] | None = None) -> Scope:
    """Join the run in a folder. Arguments and errors as of `connect`.

    The name may also be "terminal:ada", for a person, who takes no keyed measurements.

    Args:
        messages: None: the program reads no message types of the laboratory, so no warning names them.
    """
    from afspm.client.scope import Scope  # imported late: who only follows a run needs none

    launch = guest_of(folder, name)
    log = _log_of(name)
    register_all(messages or ())
    if messages is not None and (unread := set(map(_stem, launch.messages)) - set(map(_stem, messages))):
        log.warning("messages of %s are not read: name it in connect(messages=[…])", ", ".join(sorted(unread)))
    clock = ExperimentClock.from_dict(launch.clock)
    port = open_port(launch, clock)
    link = ExperimentLink.of_launch(launch, port, new_session(launch.run), log=log)
    try:
        is_joined = link.wait(lambda: link.connected, link.until(JOINED_WITHIN_S))
        if not is_joined and is_locked(folder):
            log.info("%s is still starting …", folder)
            is_joined = link.wait(lambda: link.connected, link.until(STARTED_WITHIN_S - JOINED_WITHIN_S))
        if not is_joined:
            hint = cut_off_message(folder) or "is the experiment still running?"
            raise NoResponse("the scheduler does not answer", where=str(folder), hint=hint)
        link.wait_caught_up(link.until(HEARD_WITHIN_S))  # so that the scope shows the present state at once
        frame = Frame.SAMPLE if launch.sample_coordinates else Frame.TIP
        scope = Scope(link, ProblemNames(launch.problems), folder / STATE_DIR, frame=frame)
    except BaseException:  # also Ctrl-C in a notebook: an open connection would keep the name in use
        port.close()
        raise
    weakref.finalize(scope, port.close)
    return scope


def _stem(source: str) -> str:
    return Path(source).name  # a file may be in the folder of the experiment file or in the current one


def _log_of(name: str) -> logging.Logger:
    # waiting must be visible in a terminal, unless the program has set up logging itself
    log = logging.getLogger(f"afspm.{name}")
    if not log.hasHandlers():
        log.addHandler(logging.StreamHandler())
        log.setLevel(logging.INFO)
    return log


def guest_facts(launch: Launch) -> Plain:
    """Return the entry for guests in run.json: a component's launch line without class, settings and envelopes."""
    # the scheduler's publisher is the first, and the only one whose address a guest needs
    sockets = Sockets(subscribe=launch.sockets.subscribe[:1], control=launch.sockets.control)
    guest = dataclasses.replace(launch, name=GUEST, class_="", settings={}, sockets=sockets, envelopes=None)
    facts: Plain = json.loads(guest.to_json())
    return facts


def guest_of(folder: Path, name: str) -> Launch:
    """Return the launch line of a guest that joins the run in `folder`.

    Raises:
        FileError: run.json, or the key of the run, can't be read.
        ConfigError: there is no scheduler to connect to, or other users may read the key.
    """
    if not (folder / RUN_FILE).exists():
        raise FileError("there is no run in this folder", where=str(folder), hint="name a folder with a run.json")
    guest = read_run_json(folder).get(GUEST)
    if not isinstance(guest, dict):
        raise ConfigError(
            "no component of this run is on this computer, so nothing can be joined here",
            where=str(folder / RUN_FILE),
            hint="connect on the computer where components run",
        )
    launch = Launch.from_json(json.dumps({**guest, "name": name, **_keys_in(folder)}))
    if not launch.sockets.subscribe or launch.sockets.control is None:
        raise ConfigError("this experiment has no scheduler to connect to", where=str(folder / RUN_FILE))
    return launch


def _keys_in(folder: Path) -> Plain:
    # nothing if the run has no keys
    from afspm.transport.keys import require_private

    file = folder / STATE_DIR / GUEST_KEYS
    try:
        text = file.read_bytes()
        require_private(file)
        return {"keys": from_json(text)}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise FileError(
            f"the key of this run can't be read: {error}", where=str(file), hint="join it as the user who started it"
        ) from error


def find_run(where: Path) -> Path:
    """Return the folder of a run: `where` itself, or the newest run of a folder of runs or an experiment file.

    Raises:
        FileError: there is no such run.
    """
    if where.suffix == ".toml" and (where.parent / RUN_FILE).is_file():  # the expanded file of a run
        return where.parent
    if where.suffix == ".toml":
        found = [runs for runs in _of_experiment(where) if runs]
        if not found:
            raise FileError("no run of this experiment is found", where=str(where), hint="start it with `afspm run`")
        return max(found[0], key=_started)
    if (where / RUN_FILE).is_file():
        return where.resolve() if where.is_symlink() else where
    if (latest := latest_run(where)) is not None:
        return latest
    hint = "start one: afspm run experiment.toml; or name the folder of a run, e.g. runs/…"
    raise FileError("there is no run here", where=str(where), hint=hint)


def find_one_run(where: Path) -> Path:
    """Return the run that `find_run` returns, for a program that acts on it.

    Raises:
        FileError: there is no such run, or it is one of several that go on: another one may be meant.
    """
    folder = find_run(where)
    if goes_on(folder):
        require_no_others(where, folder, others_running(where, folder))
    return folder


def require_no_others(where: Path, chosen: Path, others: Sequence[Path]) -> None:
    """Raise FileError if `where` may mean one of `others` as well as `chosen`."""
    if others:
        hint = f"name the folder of the one that you mean, for example {others[0]}"
        raise FileError(several_run(chosen, others), where=str(where), hint=hint)


def others_running(where: Path, chosen: Path) -> list[Path]:
    """Return the runs that go on on this computer and that `where` may mean, too, if `find_run` returned `chosen`."""
    if where.suffix == ".toml" and not (where.parent / RUN_FILE).is_file():
        runs = [run for found in _of_experiment(where) for run in found]
    elif chosen.resolve() == where.resolve():
        return []
    else:
        runs = _runs_in(where)
    there = {run.resolve(): run for run in runs}
    return [run for place, run in there.items() if place != chosen.resolve() and is_locked(run)]


def several_run(newest: Path, others: Sequence[Path]) -> str:
    """Return the message that `newest` and others go on."""
    return f"several experiments run here, {' and '.join(run.name for run in [*others, newest])}"


def _of_experiment(file: Path) -> Iterator[list[Path]]:
    # the runs in the folder here, then those in the folder beside the file
    home = file.resolve().parent
    name = _name_in(file) or (home.name if file.stem == "experiment" else file.stem)
    for folder in (Path("runs"), home / "runs"):
        yield [run for run in _runs_in(folder) if run_json_or_empty(run).get("name") == name]


def _runs_in(folder: Path) -> list[Path]:
    runs = (file.parent for file in sorted(folder.glob(f"*/{RUN_FILE}")))
    return [run for run in runs if not run.is_symlink()]


def _started(run: Path) -> tuple[float, int]:
    # the origin of its clock, else the time of run.json
    clock = run_json_or_empty(run).get("clock") or {}
    return float(clock.get("origin_s", 0.0)), (run / RUN_FILE).stat().st_mtime_ns


def _name_in(file: Path) -> str | None:
    try:
        # editors of Windows write a byte-order mark
        name = parse_toml(file.read_text(encoding="utf-8-sig")).get("name")
    except (OSError, ValueError) as error:
        raise FileError(f"can't be read: {error}", where=str(file)) from error
    return name if isinstance(name, str) and name else None
