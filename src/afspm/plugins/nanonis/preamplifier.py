"""The range of the preamplifier, which bounds the setpoint of a current.

A current beyond this range is never measured: the feedback drives the tip into the sample to reach it. Nanonis reports
the gains as labels ("LN 10^9"), which follow the preamplifier. (! gain-label) A label's power of ten is its gain in
V/A, and its output ends at 10 V: others report that the current of a 10^9 V/A stops at 10.004 nA.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from typing import Final, cast

from afspm.basics import quantity
from afspm.driver import refuse_value
from afspm.model import names
from afspm.plugins.nanonis.protocol import NanonisError

_LABEL: Final = re.compile(r"(?:[a-z]+ )?(?:10\^|1(?:\.0*)?e\+?)(\d{1,2})(?: ?V/A)?", re.IGNORECASE)
_OUTPUT_V: Final = 10.0


def range_a(label: str) -> float | None:
    """Return the largest current of a gain by its label, in A; None if the label does not state its gain."""
    match = _LABEL.fullmatch(label.strip())
    return None if match is None else _OUTPUT_V / 10.0 ** int(match[1])


class Preamplifier:
    """The preamplifier whose gain is in force.

    Args:
        given_a: its range by the experiment file, in A; None: Nanonis is asked.
    """

    def __init__(self, ask: Callable[..., tuple[object, ...]], given_a: float | None) -> None:
        self._ask, self._given_a = ask, given_a

    def look(self, log: logging.Logger) -> None:
        """Log the range, or that it is unknown."""
        most_a, by = self._known()
        if most_a is None:
            text = (
                "the preamplifier's range is unknown, so no setpoint is compared with it (set preamplifier_range): %s"
            )
            log.warning(text, by)
        else:
            log.info("the preamplifier's range is %s, by %s", quantity(most_a, "A"), by)

    def refuse_beyond(self, setpoint_a: float) -> None:
        """Raise Refused for a setpoint that the preamplifier can't show."""
        most_a, by = self._known()
        if most_a is not None and abs(setpoint_a) >= most_a:
            shown, most = quantity(setpoint_a, "A"), quantity(most_a, "A")
            what = f"{shown} is not below the preamplifier's range, {most} by {by}"
            why = "the feedback would drive the tip into the sample; choose another gain at Nanonis"
            raise refuse_value(names.ZCTRL_SETPOINT, f"{what}: {why}")

    def _known(self) -> tuple[float | None, str]:
        # the range in A, and what shows it, or why it is unknown
        if self._given_a is not None:
            return self._given_a, "preamplifier_range"
        try:
            labels, index, *_ = cast(tuple[Sequence[str], int], self._ask("Current.GainsGet"))
        except NanonisError as error:
            return None, str(error)
        if not 0 <= index < len(labels):
            return None, f"Nanonis reports gain {index} of {len(labels)}"
        found = range_a(labels[index])
        return found, f"its gain {labels[index]!r}" + (" does not state V/A" if found is None else "")
