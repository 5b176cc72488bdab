"""The errors of afspm: each states what happened, where, and the remedy."""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Final

_PACKAGE: Final = str(Path(__file__).parents[1])
_LIBRARIES: Final = "site-packages"
# IPython's names of the files that cells pretend to be
_CELLS: Final = ("<ipython-input", "ipykernel_")


class AfspmError(Exception):
    """Base of all errors that afspm raises on purpose.

    Args:
        what: what happened, in words a physicist understands.
        where: the file, component, parameter … where the error occurred.
        hint: the remedy.
    """

    code: ClassVar[str] = "error"

    def __init__(self, what: str, *, where: str = "", hint: str = "") -> None:
        super().__init__(what, where, hint)
        self.what = what
        self.where = where
        self.hint = hint

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        return f"{text} ({self.hint})" if self.hint else text

    def _render_traceback_(self) -> list[str]:
        # IPython calls this and shows the lines in place of the traceback
        return rendered(self, str(self))


class Interrupted(KeyboardInterrupt):
    """An interrupt by Ctrl-C, or by a notebook's stop button, during a call of afspm."""

    def _render_traceback_(self) -> list[str]:
        return rendered(self, "nothing is left half done")


def rendered(error: BaseException, text: str) -> list[str]:
    """Return an error's text and the traceback lines of the user's code, without lines of afspm and libraries."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [one for one in frames if not one.filename.startswith(_PACKAGE) and _LIBRARIES not in one.filename]
    own = [one for one in own if one.line]
    return [f"\x1b[31m{type(error).__name__}\x1b[0m: {text}", *map(_place, own)]


def _place(frame: traceback.FrameSummary) -> str:
    where = "the cell" if any(cell in frame.filename for cell in _CELLS) else frame.filename
    return f"  line {frame.lineno} of {where}: {frame.line}"


class ConfigError(AfspmError):
    """An error in the experiment file, or in a setting of a component."""

    code = "config"


class ConfigErrors(ConfigError):
    """Several wrong settings.

    Attributes:
        errors: one error for each setting, in the order of discovery.
    """

    def __init__(self, errors: Sequence[AfspmError]) -> None:
        super().__init__("; ".join(map(str, errors)))
        self.errors = tuple(errors)


class ErrorCollector:
    """A collector of errors, which are raised together so that a user sees all mistakes at once::

        errors = ErrorCollector()
        for name in names:
            with errors:
                check(name)
        errors.raise_all()

    An AfspmError ends its block, and the code after the block still runs. Other exceptions pass.
    """

    def __init__(self) -> None:
        self.errors: list[AfspmError] = []

    def add(self, error: AfspmError) -> None:
        self.errors += individual_errors(error)

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if isinstance(error, AfspmError):
            self.add(error)
            return True
        return False

    def raise_all(self) -> None:
        """Raise the collected error, or ConfigErrors for several; do nothing without errors."""
        if self.errors:
            raise self.errors[0] if len(self.errors) == 1 else ConfigErrors(self.errors)


def individual_errors(error: AfspmError) -> tuple[AfspmError, ...]:
    """Return the single errors of a ConfigErrors; for any other error, only that error."""
    return error.errors if isinstance(error, ConfigErrors) else (error,)


class InvalidValue(AfspmError, ValueError):
    """A value that has no meaning here: NaN, an empty region, a shape that does not fit …"""

    code = "invalid-value"


class NoSuchItem(AfspmError, KeyError, IndexError):
    """A name, key or number that does not exist."""

    code = "no-such-item"


class UnitError(AfspmError, ValueError):
    """An unknown unit, or a unit of the wrong dimension."""

    code = "unit"


class WireError(AfspmError):
    """Bytes from a peer that violate the wire format.

    Args:
        response: the number of the ControlResponse that answers the request, if the bytes were a request.
    """

    code = "wire"

    def __init__(self, what: str, *, where: str = "", hint: str = "", response: int = 1) -> None:
        super().__init__(what, where=where, hint=hint)
        self.response = response


class TransportError(AfspmError):
    """An unusable address, or keys that are missing or don't fit."""

    code = "transport"


class NoThread(AfspmError):
    """Error: the system starts no further thread for this process."""

    code = "no-thread"


class FileError(AfspmError):
    """A file that can't be read or written, or whose content does not match its name."""

    code = "file"


class RequestError(AfspmError):
    """Base of the errors of a request to the microscope."""

    code = "request"


class Refused(RequestError):
    """A refusal of a request by the scheduler, a limit or the microscope.

    Args:
        response: the number of the ControlResponse.
        reason: the refusing process's reason, as text for people.
        again_ns: the experiment time at which a limit on time may allow it; None if time does not lift the refusal.
    """

    code = "refused"

    def __init__(
        self, response: int, reason: str, *, where: str = "", hint: str = "", again_ns: int | None = None
    ) -> None:
        super().__init__(reason, where=where, hint=hint)
        self.response = response
        self.reason = reason
        self.again_ns = again_ns


class NotClear(Refused):
    """A refusal of a lateral move: others may have used the coarse motor since the run's steps away. New ones count."""


class NoResponse(RequestError):
    """A request without an answer in time, which may or may not have been carried out."""

    code = "no-response"


class MeasurementFailed(NoResponse):
    """A scan or spectrum that failed repeatedly for an unknown reason, so that a person must look."""

    code = "measurement-failed"


class ControlLost(RequestError):
    """Missing control: not given in time, lost in an unbroken block, or without the problem to solve."""

    code = "control-lost"


class ExperimentEnded(AfspmError):
    """End of the experiment: the microscope takes no more requests."""

    code = "ended"
