"""Exceptions as text with the lines of the user's own code, and the file that reports a fault to the supervisor."""

from __future__ import annotations

import json
import logging
import sys
import traceback
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from afspm.basics import RequestError
from afspm.basics.errors import AfspmError, FileError, Refused, TransportError
from afspm.basics.own_fault import OwnFault
from afspm.model import ControlResponse
from afspm.storage.atomic import write_atomic


def write_fault(state_dir: Path, name: str, fault: OwnFault) -> None:
    with suppress(FileError):  # on a full disk the fault counts as an ordinary crash
        write_atomic(_path(state_dir, name), [json.dumps(asdict(fault)).encode()])


def take_fault(state_dir: Path, name: str) -> OwnFault | None:
    """Return the reported fault, and remove its file; None without a readable file."""
    try:
        fault = OwnFault(**json.loads(_path(state_dir, name).read_bytes()))
        _path(state_dir, name).unlink()
    except (OSError, ValueError, TypeError):
        return None
    return fault


def _path(state_dir: Path, name: str) -> Path:
    return state_dir / f"{name}.fault.json"


PACKAGE = Path(__file__).parents[2]  # not resolved, since tracebacks have unresolved paths
_BELOW_START = 2  # frames of runpy below a module run by `python -m`
_REFUSED_AGAIN = {
    ControlResponse.CMD_NOT_SUPPORTED,
    ControlResponse.PARAM_NOT_SUPPORTED,
    ControlResponse.PARAM_ERROR,
    ControlResponse.ACTION_NOT_SUPPORTED,
}
"""Refusals because of the request itself, e.g. by a limit: a repetition is refused again."""


def describe(error: BaseException, name: str = "", package: Path = PACKAGE) -> str:
    """Return the message of an exception, followed by the lines of code that led to it.

    Frames of afspm above the user's are left out; for a deliberate refusal also the frames below. An error from afspm's
    code alone is shown with all frames, unless it was foreseen.

    Args:
        name: name of the component, which is left out of the message.
        package: path of the folder with afspm's code.
    """
    trace = traceback.TracebackException.from_exception(error)
    if isinstance(error, AfspmError) and all(_is_passage(frame, package) for frame in trace.stack):
        return _words(error, name)  # no user code involved: afspm's own frames would not help
    is_chained = False
    link: traceback.TracebackException | None = trace
    seen: set[int] = set()
    while link is not None and id(link) not in seen:
        seen.add(id(link))
        kept = _kept(link.stack, package, is_foreseen=link is trace and _is_foreseen(error, link.stack, package))
        link.stack = traceback.StackSummary.from_list(kept)
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)
        is_chained = is_chained or link is not None
    what = _words(error, name) if isinstance(error, AfspmError) else "".join(trace.format_exception_only()).strip()
    where = trace.format() if is_chained else trace.stack.format()
    return "\n".join([what, *"".join(where).rstrip("\n").splitlines()])


def may_pass(error: BaseException) -> bool:
    """Return whether a retry may succeed: True after a controller's failure, for instance, False after a code fault."""
    if isinstance(error, Refused):
        return error.response not in _REFUSED_AGAIN
    return isinstance(error, (RequestError, FileError, TransportError, OSError, MemoryError))


def place_of(error: BaseException, package: Path = PACKAGE) -> str:
    """Return file and line of the user's code that raised an exception; of afspm's code if there is none."""
    frames = traceback.extract_tb(error.__traceback__)
    of_user = [frame for frame in frames if not _is_passage(frame, package)]
    last = (of_user or frames)[-1]
    return f"{Path(last.filename).name}:{last.lineno}"


def log(logger: logging.Logger, error: BaseException, name: str) -> None:
    logger.error("%s", describe(error, name))
    logger.debug("the full traceback", exc_info=error)


def where_now(thread_id: int, package: Path = PACKAGE) -> str:
    """Return the lines of code that a thread is running, starting with the user's own code."""
    frame = sys._current_frames().get(thread_id)
    stack = traceback.extract_stack(frame) if frame is not None else []
    return "".join(traceback.format_list(_kept(stack[_BELOW_START:], package, is_foreseen=False))).rstrip("\n")


def _is_foreseen(error: BaseException, frames: Sequence[traceback.FrameSummary], package: Path) -> bool:
    # raised on purpose, about an argument of the user: the message suffices
    last = frames[-1] if frames else None
    return isinstance(error, AfspmError) or (
        last is not None and _is_ours(last, package) and (last.line or "").startswith("raise ")
    )


def _words(error: AfspmError, name: str) -> str:
    said = str(error)
    return said.removeprefix(f"{name}: ") if name else said


def _kept(
    frames: Iterable[traceback.FrameSummary], package: Path, *, is_foreseen: bool
) -> list[traceback.FrameSummary]:
    everything = list(frames)
    first = next((i for i, frame in enumerate(everything) if not _is_passage(frame, package)), None)
    if first is None:
        return everything
    below = everything[first:]
    if not is_foreseen:
        return below
    last = max(i for i, frame in enumerate(below) if not _is_passage(frame, package))
    return [frame for frame in below[: last + 1] if not _is_ours(frame, package)]


def _is_ours(frame: traceback.FrameSummary, package: Path) -> bool:
    return frame.filename.startswith("<") or Path(frame.filename).is_relative_to(package)


def _is_passage(frame: traceback.FrameSummary, package: Path) -> bool:
    # afspm's frames, and library frames between two of them
    return _is_ours(frame, package) or Path(frame.filename).name == "contextlib.py"
