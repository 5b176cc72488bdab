"""Whether the microscope can be trusted: SS_UNDEFINED is said of one whose controller is gone or makes no sense."""

from __future__ import annotations

from afspm.model import ScopeState

TRANSLATOR = "translator"
"""Who flags the problem: the translator asks for nothing, so it is done in its name."""


class ControllerTimeout:
    """Knows since when the microscope has not been trusted.

    A controller that is lost and found again within `patience_s` costs nothing: what runs there goes on.

    Args:
        patience_s: so long, real time, it may be lost before that is a problem.
    """

    def __init__(self, patience_s: float) -> None:
        self._patience_s = patience_s
        self._lost_since_s: float | None = None

    @property
    def lost(self) -> bool:
        """The last that was heard of the microscope is that nothing is known of it."""
        return self._lost_since_s is not None

    def scope_is(self, state: ScopeState, now_s: float) -> None:
        """The translator said this."""
        if state is not ScopeState.UNDEFINED:
            self._lost_since_s = None
        elif self._lost_since_s is None:
            self._lost_since_s = now_s

    def due_s(self) -> float | None:
        """When it has been lost for too long, real time; None: it is not lost."""
        return None if self._lost_since_s is None else self._lost_since_s + self._patience_s
