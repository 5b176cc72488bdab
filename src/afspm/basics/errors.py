"""The errors of afspm: each says what happened, where, and what to do about it."""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Final

_PACKAGE: Final = str(Path(__file__).parents[1])
_LIBRARIES: Final = "site-packages"
_CELLS: Final = ("<ipython-input", "ipykernel_")


class AfspmError(Exception):
    """Base of all errors that afspm raises on purpose.

    Args:
        what: what happened, in words a physicist understands.
        where: the file, component, parameter … that it happened at.
        hint: what to do about it.
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
        """Return the lines that IPython shows in place of the traceback: the error, and the caller's own lines."""
        return rendered(self, str(self))


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, or the stop button of a notebook, during a call of afspm."""

    def _render_traceback_(self) -> list[str]:
        return rendered(self, "nothing is left half done")


def rendered(error: BaseException, text: str) -> list[str]:
    """Return an error and the caller's own lines, without those of afspm and of libraries."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [one for one in frames if not one.filename.startswith(_PACKAGE) and _LIBRARIES not in one.filename]
    own = [one for one in own if one.line]
    return [f"\x1b[31m{type(error).__name__}\x1b[0m: {text}", *map(_place, own)]


def _place(frame: traceback.FrameSummary) -> str:
    where = "the cell" if any(cell in frame.filename for cell in _CELLS) else frame.filename
    return f"  line {frame.lineno} of {where}: {frame.line}"


class ConfigError(AfspmError):
    """The experiment file, or a setting of a component, is wrong."""

    code = "config"


class ConfigErrors(ConfigError):
    """Several settings are wrong.

    Attributes:
        errors: one for each, in the order in which they were found.
    """

    def __init__(self, errors: Sequence[AfspmError]) -> None:
        super().__init__("; ".join(map(str, errors)))
        self.errors = tuple(errors)


class ErrorCollector:
    """Errors that are raised together at the end, so that whoever mends one hears of all::

        errors = ErrorCollector()
        for name in names:
            with errors:
                check(name)
        errors.raise_all()

    An error of ours ends its block and not what comes after it.
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
        """Raises ConfigErrors; the only one as it is; nothing if there are none."""
        if self.errors:
            raise self.errors[0] if len(self.errors) == 1 else ConfigErrors(self.errors)


def individual_errors(error: AfspmError) -> tuple[AfspmError, ...]:
    """Return the errors that one stands for: those that it gathers, or itself."""
    return error.errors if isinstance(error, ConfigErrors) else (error,)


class InvalidValue(AfspmError, ValueError):
    """A value that has no meaning here: NaN, an empty region, a shape that does not fit …"""

    code = "invalid-value"


class NoSuchItem(AfspmError, KeyError, IndexError):
    """There is nothing by this name, key or number."""

    code = "no-such-item"


class UnitError(AfspmError, ValueError):
    """An unknown unit, or one of the wrong dimension."""

    code = "unit"


class WireError(AfspmError):
    """Bytes from a peer that are not what the wire format says.

    Args:
        response: the number of the ControlResponse to answer a request with, if it was one.
    """

    code = "wire"

    def __init__(self, what: str, *, where: str = "", hint: str = "", response: int = 1) -> None:
        super().__init__(what, where=where, hint=hint)
        self.response = response


class TransportError(AfspmError):
    """An address that can't be used, keys that are missing or don't fit."""

    code = "transport"


class FileError(AfspmError):
    """A file that can't be read or written, or is not what its name says."""

    code = "file"


class RequestError(AfspmError):
    """Base of what may come of a request to the microscope."""

    code = "request"


class Refused(RequestError):
    """A request was answered, and the answer is no.

    Args:
        response: the number of the ControlResponse.
        reason: why, in the words of the one who refused.
    """

    code = "refused"

    def __init__(self, response: int, reason: str, *, where: str = "", hint: str = "") -> None:
        super().__init__(reason, where=where, hint=hint)
        self.response = response
        self.reason = reason


class NoResponse(RequestError):
    """A request was not answered in time: it may or may not have been carried out."""

    code = "no-response"


class MeasurementFailed(NoResponse):
    """A scan or spectrum failed again and again, and nothing explains it: a person has to look."""

    code = "measurement-failed"


class ControlLost(RequestError):
    """Control was taken away and the caller asked not to wait for it."""

    code = "control-lost"


class ExperimentEnded(AfspmError):
    """The experiment has ended: nothing more can be asked of the microscope."""

    code = "ended"
