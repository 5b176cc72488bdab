"""`ShadowDriver`: a maker's driver without the parts that command the controller, for a run beside a person's work.

**Theory of operation.** A shadow must not change the controller, even by a mistake of afspm. So two walls stand between
them, and neither is a setting that code asks for:

    the class     methods that set or act are removed when the class is made: the process has none to call
    the link      a connection that sends the questions of a list only; anything else raises before a byte leaves

A maker's module `shadow` holds both: the class, with this mixin first, and the list of questions. A fact that can't be
read without a side effect is not read there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, ClassVar

from afspm.basics.errors import Refused
from afspm.model import ControlResponse
from afspm.translator.driver_base import DriverBase
from afspm.translator.parameters import Value

_REMOVED = ("set", "write", "write_rows", "command", "pulse_bias", "move_z")


class ShadowDriver(DriverBase):
    """Mixin that removes all methods of a driver that set parameters or execute actions.

    Write it before the maker's driver: `class MineShadow(ShadowDriver, Mine)`.
    """

    only_reads = True
    watches: ClassVar[type[DriverBase]]
    """The maker's driver, with all that a run could ask of it."""

    @classmethod
    def once(cls, **settings: Any) -> ShadowDriver:
        """Create a shadow that only asks, and need not see when measurements begin and end."""
        asking: type[ShadowDriver] = type(cls.__name__, (cls,), {"asks_once": True, "__module__": cls.__module__})
        return asking(**settings)

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        cls.watches = next(
            one for one in cls.__mro__ if issubclass(one, DriverBase) and not issubclass(one, ShadowDriver)
        )
        acting = [name for name in dir(cls) if hasattr(getattr(cls, name, None), "_afspm_action")]
        for name in (*_REMOVED, *acting):
            setattr(cls, name, None)

    def put_in_force(self, values: Mapping[str, Value]) -> None:
        raise refusal(", ".join(values))


class NotSent(Refused):
    """The refusal of everything that is no question."""


def refusal(what: str) -> NotSent:
    """Return the refusal of everything that is no question."""
    reason = f"{what}: not sent, since a shadow only reads the controller"
    return NotSent(ControlResponse.ACTION_NOT_SUPPORTED, reason)


def require_question(what: str, questions: Collection[str]) -> None:
    """Raise NotSent unless the name of a call is in the list of questions."""
    if what not in questions:
        raise refusal(what)
