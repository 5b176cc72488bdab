"""`afspm.connect`: a script or notebook joins an experiment that is running."""

from __future__ import annotations

import dataclasses
import json
import logging
import weakref
from collections.abc import Sequence
from pathlib import Path

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError, FileError, NoResponse
from afspm.basics.launch import Launch, Sockets
from afspm.basics.plain_data import Plain
from afspm.client.experiment_link import ExperimentLink
from afspm.client.scope import Scope
from afspm.model import Frame, ProblemNames
from afspm.record.run_json import RUN_FILE, STATE_DIR, latest_run, read_run_json, run_json_or_empty
from afspm.record.run_lock import cut_off_message
from afspm.transport.process.context import new_session
from afspm.transport.zmq_port import open_port
from afspm.wire.message_types import register_all

GUEST = "guest"
GUEST_KEYS = "guest.keys"
"""The file beside what the run keeps with the keys of those who join it; see `supervisor.key_ring`."""
JOINED_WITHIN_S = 5.0
HEARD_WITHIN_S = 30.0  # what is cached may be many large scans


def connect(where: str | Path = "runs", name: str = "notebook", *, messages: Sequence[str] = ()) -> Scope:
    """Join a running experiment; what is returned can be used like `self.scope` in a component.

        with afspm.connect("runs/my_experiment-20261120-040000") as scope:
            scope.scan(afspm.Region((0, 0), (2e-6, 2e-6)))

    Args:
        where: the folder of the run, the folder of all runs (its newest is meant), or the experiment file (its newest
            run is meant, in the folder `runs` here or beside it).
        name: what others see as the holder of control. Two that join need different names.
        messages: modules and .proto files with message types of your own, as in the experiment file. They are imported
            here; those that the run names are not, since its folder may come from another person.

    Raises:
        FileError: there is no such run.
        ConfigError: it has nobody to connect to; or `messages` can't be imported.
        NoResponse: its scheduler is not running, or nothing is heard of what it publishes.
        ExperimentEnded: it has just ended.
    """
    folder = find_run(Path(where))
    launch = guest_of(folder, name)
    log = _log_of(name)
    register_all(messages)
    if unread := set(map(_stem, launch.messages)) - set(map(_stem, messages)):
        log.warning("messages of %s are not read: name it in connect(messages=[…])", ", ".join(sorted(unread)))
    clock = ExperimentClock.from_dict(launch.clock)
    port = open_port(launch, clock)
    link = ExperimentLink.of_launch(launch, port, new_session(launch.run), log=log)
    try:
        if not link.wait(lambda: link.connected, link.until(JOINED_WITHIN_S)):
            hint = cut_off_message(folder) or "is the experiment still running?"
            raise NoResponse("the scheduler does not answer", where=str(folder), hint=hint)
        link.wait_caught_up(link.until(HEARD_WITHIN_S))  # so that the first look at the scope tells its state
        frame = Frame.SAMPLE if launch.sample_coordinates else Frame.TIP
        scope = Scope(link, ProblemNames(launch.problems), folder / STATE_DIR, frame=frame)
    except BaseException:  # Ctrl-C in a notebook, too: a connection that is left would keep the name
        port.close()
        raise
    weakref.finalize(scope, port.close)
    return scope


def _stem(source: str) -> str:
    return Path(source).name  # of a file: it may be beside the experiment file or here


def _log_of(name: str) -> logging.Logger:
    """Return the log of a guest; what it waits for goes to the terminal unless the program has set up logging."""
    log = logging.getLogger(f"afspm.{name}")
    if not log.hasHandlers():
        log.addHandler(logging.StreamHandler())
        log.setLevel(logging.INFO)
    return log


def guest_facts(launch: Launch) -> Plain:
    """Return the guest of run.json: the launch line of a component, without what is that component's own."""
    sockets = Sockets(subscribe=launch.sockets.subscribe[:1], control=launch.sockets.control)
    guest = dataclasses.replace(launch, name=GUEST, class_="", settings={}, sockets=sockets, envelopes=None)
    facts: Plain = json.loads(guest.to_json())
    return facts


def guest_of(folder: Path, name: str) -> Launch:
    """Return the launch line of a guest that joins the run in `folder`.

    Raises:
        FileError: run.json can't be read.
        ConfigError: there is no scheduler to connect to.
    """
    if not (folder / RUN_FILE).exists():
        raise FileError("there is no run in this folder", where=str(folder), hint="name a folder with a run.json")
    guest = read_run_json(folder).get(GUEST)
    if not isinstance(guest, dict):
        raise ConfigError(
            "this part of the experiment has no component that could be joined",
            where=str(folder / RUN_FILE),
            hint="connect on the computer where components run",
        )
    launch = Launch.from_json(json.dumps({**guest, "name": name, **_keys_in(folder)}))
    if not launch.sockets.subscribe or launch.sockets.control is None:
        raise ConfigError("this experiment has no scheduler to connect to", where=str(folder / RUN_FILE))
    return launch


def _keys_in(folder: Path) -> Plain:
    """Return the keys of this run's guests; nothing if none were made."""
    from afspm.transport.keys import require_private

    file = folder / STATE_DIR / GUEST_KEYS
    try:
        text = file.read_bytes()
        require_private(file)
        return {"keys": json.loads(text)}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise FileError(
            f"the key of this run can't be read: {error}", where=str(file), hint="join it as the user who started it"
        ) from error


def find_run(where: Path) -> Path:
    """Return the folder of the run that is meant. Raises FileError if there is none."""
    if where.suffix == ".toml":
        name = where.resolve().parent.name if where.stem == "experiment" else where.stem
        runs = (Path("runs"), where.resolve().parent / "runs")
        found = [run for folder in runs if (run := _newest(folder, name, where)) is not None]
        if not found:
            raise FileError("no run of this experiment is found", where=str(where), hint="start it with `afspm run`")
        return found[0]
    if (where / RUN_FILE).is_file():
        return where.resolve() if where.is_symlink() else where
    if (latest := latest_run(where)) is not None:
        return latest
    raise FileError("there is no run here", where=str(where), hint="name the folder of a run, e.g. runs/…")


def _newest(runs: Path, name: str, file: Path) -> Path | None:
    """Return the newest run of the experiment `name` in the folder `runs`."""
    name = _name_in(file) or name
    written = [run for run in runs.glob(f"*/{RUN_FILE}") if not run.parent.is_symlink()]
    found = [run for run in written if run_json_or_empty(run.parent).get("name") == name]
    return max(found, key=_started).parent if found else None


def _started(run: Path) -> tuple[float, int]:
    """Return when a run was started: when its clock was set, else when run.json was written."""
    clock = run_json_or_empty(run.parent).get("clock") or {}
    return float(clock.get("origin_s", 0.0)), run.stat().st_mtime_ns


def _name_in(file: Path) -> str | None:
    import tomllib

    try:
        name = tomllib.loads(file.read_text(encoding="utf-8-sig")).get("name")  # as editors of Windows write it
    except (OSError, ValueError) as error:
        raise FileError(f"can't be read: {error}", where=str(file)) from error
    return name if isinstance(name, str) and name else None
