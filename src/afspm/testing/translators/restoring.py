"""What was in force before the checks, and putting it back."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.model import ControlRequest, Feedback, Parameter, ProbePosition, Region, ScanParameters, names
from afspm.testing.translators.bench import Bench, answer_in_words
from afspm.testing.translators.frames import Frame
from afspm.testing.translators.support import Support
from afspm.testing.translators.taking import number
from afspm.testing.translators.verdicts import Failed, Lost, near

_LAST = (names.SCAN_SPEED, names.MOVE_SPEED)
"""A frame may change them."""


@dataclass(frozen=True)
class Before:
    """What was in force."""

    frame: ScanParameters | None
    feedback: Feedback | None
    probe: ProbePosition | None
    parameters: dict[str, Parameter]
    support: Support

    @classmethod
    def of(cls, bench: Bench, support: Support) -> Before:
        """As it was told when the checks began."""
        return cls(
            bench.story.newest(ScanParameters),
            bench.story.newest(Feedback),
            bench.story.newest(ProbePosition),
            {name: value for name, value in support.parameters.items() if value and name != names.CONTROLLER},
            support,
        )

    def restore(self, bench: Bench) -> list[str]:
        """Stop what runs, and put everything back.

        Returns:
            what could not be, a line each.
        """
        wrong: list[str] = []
        try:
            bench.quiet()
            bench.come_to_rest()
            self._put_back_together(bench, wrong)
            ordered = sorted(self.parameters, key=lambda name: name in _LAST)
            for name in ordered:
                self._put_back(bench, name, wrong)
        except (Lost, Failed) as error:
            wrong.append(str(error))
        return wrong

    def _put_back_together(self, bench: Bench, wrong: list[str]) -> None:
        """What is told together is set together, lest it passes through what can't be."""
        story = bench.story
        settings = (
            (ControlRequest.SET_SCAN_PARAMS, story.newest(ScanParameters), self.frame, self._frame()),
            (
                ControlRequest.SET_ZCTRL_PARAMS,
                story.newest(Feedback),
                self.feedback,
                _changed(self.feedback, story.newest(Feedback)),
            ),
            (ControlRequest.SET_PROBE_POS, story.newest(ProbePosition), self.probe, self.probe),
        )
        for kind, now, before, subject in settings:
            if before is not None and now != before:
                mark = bench.story.mark()
                response = bench.ask(kind, subject)
                if not response.ok:
                    wrong.append(f"REQ_{kind.name}: {answer_in_words(response)}")
                bench.settled(mark)

    def _frame(self) -> ScanParameters | None:
        """What to ask for to have it again: of the angle nothing, where there is none."""
        before = self.frame
        if before is not None and isinstance(before.region, Region) and isinstance(before.shape, tuple):
            return Frame(before.region, before.shape).request(self.support)
        return before

    def _put_back(self, bench: Bench, name: str, wrong: list[str]) -> None:
        before, now = self.parameters[name], bench.get(name)
        if _same(before, now):
            return
        mark = bench.story.mark()
        response = bench.set(name, str(before.value), before.unit)
        bench.settled(mark)
        if not (response.ok and _same(before, bench.get(name))):
            was = f"{before.value} {before.unit or ''}".strip()
            wrong.append(f"{name} was {was}, and is {now.value}: {answer_in_words(response)}")


def _changed(before: Feedback | None, now: Feedback | None) -> Feedback:
    """What is to be put back of it: some may only be read."""
    fields = {} if before is None else vars(before)
    return Feedback(**{name: value for name, value in fields.items() if now is None or value != getattr(now, name)})


def _same(before: Parameter, now: Parameter) -> bool:
    if before.value == now.value and before.unit == now.unit:
        return True
    try:
        return near(number(before, before.unit or ""), number(now, before.unit or ""), 1e-6)
    except Failed:
        return False
