"""Picture of an experiment: the scheduler as a bar, the translator below, the components above.

Every component has a column: envelopes go up from the bar to the component, requests go down. Envelopes between
components run in lanes above the components. No two lines share a path, so each can be followed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from afspm.experiment.parts import ExperimentPart
from afspm.experiment.svg import Svg, text_width
from afspm.model import Role

if TYPE_CHECKING:
    from afspm.experiment.experiment import Experiment
    from afspm.experiment.resolved_experiment import ResolvedExperiment

ENVELOPES, CONTROL, VENDOR = "#1f6fb2", "#c2570c", "#777777"
GREY, RED, GREEN = "#666666", "#a3241c", "#1d7a3e"
FILLS: Final = {
    Role.COMPONENT: ("#fffdf7", "#8a7a4d"),
    Role.SCHEDULER: ("#eaf1fa", "#3b5b8c"),
    Role.TRANSLATOR: ("#eaf6ee", "#2f7a4f"),
}

MARGIN, GAP, LANE, LINE = 36.0, 30.0, 30.0, 15.0
NAME_SIZE, TEXT_SIZE, LABEL_SIZE = 14.0, 11.0, 11.0
BAR_HEIGHT, ARROW_AT, MOST_LABELS = 62.0, 16.0, 7


@dataclass
class ProcessBox:
    """The drawn box of one process, and its column. Place and height follow from the widths of all boxes."""

    part: ExperimentPart
    lines: list[tuple[str, str]]
    labels: list[str]
    asks: bool
    x: float = 0.0
    y: float = 0.0
    height: float = 0.0

    @property
    def width(self) -> float:
        texts = [text_width(text, TEXT_SIZE) for text, _ in self.lines]
        return max([120.0, text_width(self.part.name, NAME_SIZE, bold=True) + 28, *(t + 28 for t in texts)])

    @property
    def _sides(self) -> tuple[float, float]:
        left = max([text_width(label, LABEL_SIZE) for label in self.labels], default=0.0)
        right = text_width("requests", LABEL_SIZE) if self.asks else 0.0
        return left + ARROW_AT + 8, right + ARROW_AT + 8

    @property
    def arrows_at(self) -> float:
        """Offset of the two arrows' midpoint from the middle of the box, since their labels differ in length."""
        left, right = self._sides
        most = self.width / 2 - ARROW_AT - 12
        return max(-most, min(most, (left - right) / 2))

    @property
    def column(self) -> float:
        left, right = self._sides
        return max(self.width, 2 * (left - self.arrows_at), 2 * (right + self.arrows_at))

    @property
    def own_height(self) -> float:
        return 34.0 + LINE * len(self.lines)


@dataclass(frozen=True)
class PublisherLane:
    """The drawn lane of the envelopes from one component to other components."""

    publisher: ProcessBox
    listeners: tuple[ProcessBox, ...]
    label: str


def draw(experiment: Experiment) -> str:
    return _Drawing(experiment.resolved, experiment.name).document()


class _Drawing:
    def __init__(self, resolved: ResolvedExperiment, name: str) -> None:
        self.resolved = resolved
        self.name = name
        self.svg = Svg()
        self.components_of_file = resolved.with_role(Role.COMPONENT)
        self.boxes = {part.name: self._box(part) for part in resolved.parts.components}
        self.components = [self.boxes[p.name] for p in self.components_of_file]
        self.lanes = self._lanes()
        self.bar_x, self.bar_y, self.bar_width = MARGIN, 0.0, 0.0

    def document(self) -> str:
        self._place()
        for box in self.components:
            self._component(box)
        for i, lane in enumerate(self.lanes):
            self._lane(lane, self._top() - LANE * (i + 0.75))
        for scheduler in self.resolved.with_role(Role.SCHEDULER)[:1]:
            self._scheduler(scheduler.part)
        bottom = self.bar_y + BAR_HEIGHT
        for part in self.resolved.with_role(Role.TRANSLATOR)[:1]:
            bottom = self._translator(self.boxes[part.name])
        self.svg.text(MARGIN, MARGIN + 8, self.name, size=18, anchor="start", bold=True)
        self._legend(bottom + 40)
        width = self.bar_width + 2 * MARGIN
        return self.svg.document(width, bottom + 66, self.name, (ENVELOPES, CONTROL, VENDOR))

    # --- contents ------------------------------------------------------------------------------------------

    def _box(self, part: ExperimentPart) -> ProcessBox:
        declared = self.resolved.processes[part.name].declared
        what = part.class_path.rpartition(".")[2] if part.class_path else " ".join(part.command)
        lines = [(what if len(what) <= 34 else what[:33] + "…", GREY)]
        lines += [(f"after {other}", GREY) for other in self.resolved.processes[part.name].after]
        lines += [(f"flags {problem}", RED) for problem in declared.flags]
        lines += [(f"solves {problem}", GREEN) for problem in declared.solves]
        labels = self._from_scheduler(part)
        if len(labels) > MOST_LABELS:
            labels = [*labels[: MOST_LABELS - 1], f"and {len(labels) - MOST_LABELS + 1} more"]
        written = "subscriber" in part.own and "control_client" not in part.own
        return ProcessBox(part, lines, labels, asks=not written)

    def _from_scheduler(self, part: ExperimentPart) -> list[str]:
        # KILL reaches every component, so no list is empty.
        prefixes = self.resolved.processes[part.name].envelopes
        if prefixes is None or "" in prefixes:
            return ["all envelopes"]
        others = {e for p in self.components_of_file for e in self.resolved.processes[p.name].declared.publishes}
        return [p for p in prefixes if not any(e.startswith(p) for e in others)] or ["KILL"]

    def _lanes(self) -> list[PublisherLane]:
        lanes = []
        for box in self.components:
            key = f"{box.part.name}/publish"
            slot = self.resolved.net.slots.get(key)
            if slot is None:
                continue
            listeners = tuple(
                other
                for other in self.components
                if any(s in (key, slot.address) for s in self.resolved.net.links[other.part.name].subscribe)
            )
            label = ", ".join(self.resolved.processes[box.part.name].declared.publishes) or "messages of its own"
            lanes.append(PublisherLane(box, listeners, f"{label} {_at(slot.address)}"))
        # short lanes near the boxes, long ones above them: fewer crossings
        return sorted(lanes, key=lambda lane: len(lane.listeners))

    # --- layout --------------------------------------------------------------------------------------------

    def _top(self) -> float:
        return MARGIN + 34 + LANE * len(self.lanes)

    def _place(self) -> None:
        height = max((box.own_height for box in self.components), default=0.0)
        columns = sum(box.column for box in self.components) + GAP * max(0, len(self.components) - 1)
        widest_lane = max((text_width(lane.label, LABEL_SIZE) for lane in self.lanes), default=0.0)
        self.bar_width = max(columns, 560.0, widest_lane, text_width(self.name, 18, bold=True))
        x = MARGIN + (self.bar_width - columns) / 2
        for box in self.components:
            box.x, box.y, box.height = x + box.column / 2, self._top(), height
            x += box.column + GAP
        labels = max((len(box.labels) for box in self.components), default=0)
        self.bar_y = self._top() + height + max(64.0, LINE * labels + 34.0)

    # --- drawing ----------------------------------------------------------------------------------------------------

    def _process(self, box: ProcessBox) -> None:
        fill, stroke = FILLS[self.resolved.processes[box.part.name].role]
        self.svg.box(box.x - box.width / 2, box.y, box.width, box.height, fill=fill, stroke=stroke)
        y = box.y + 22
        self.svg.text(box.x, y, box.part.name, size=NAME_SIZE, bold=True)
        for text, colour in box.lines:
            y += LINE
            self.svg.text(box.x, y, text, size=TEXT_SIZE, fill=colour)

    def _component(self, box: ProcessBox) -> None:
        self._process(box)
        top, bottom = box.y + box.height, self.bar_y
        if self._hears_scheduler(box):
            self._up(box.x + box.arrows_at - ARROW_AT, top, bottom, box.labels)
        if box.asks:
            self._down(box.x + box.arrows_at + ARROW_AT, top, bottom)

    def _hears_scheduler(self, box: ProcessBox) -> bool:
        sources = self.resolved.net.links[box.part.name].subscribe
        own = {f"{p.name}/publish" for p in self.resolved.with_role(Role.SCHEDULER)}
        own |= {slot.address for key, slot in self.resolved.net.slots.items() if key in own and slot.address}
        others = {f"{b.part.name}/publish" for b in self.components}
        others |= {self.resolved.net.slots[o].address or "" for o in others if o in self.resolved.net.slots}
        return any(source in own or source not in others for source in sources)

    def _up(self, x: float, top: float, bottom: float, labels: Sequence[str]) -> None:
        self.svg.line([(x, bottom), (x, top + 1)], stroke=ENVELOPES)
        y = (top + bottom) / 2 - LINE * (len(labels) - 1) / 2 + 4
        for label in labels:
            self.svg.text(x - 8, y, label, size=LABEL_SIZE, fill=ENVELOPES, anchor="end")
            y += LINE

    def _down(self, x: float, top: float, bottom: float) -> None:
        self.svg.line([(x, top), (x, bottom - 1)], stroke=CONTROL)
        self.svg.text(x + 8, (top + bottom) / 2 + 4, "requests", size=LABEL_SIZE, fill=CONTROL, anchor="start")

    def _lane(self, lane: PublisherLane, y: float) -> None:
        start = lane.publisher.x + lane.publisher.width / 4
        ends = [self._entry(lane, box) for box in lane.listeners]
        top = self._top()
        for x in ends:
            self.svg.line([(start, top), (start, y), (x, y), (x, top - 1)], stroke=ENVELOPES)
        if not ends:
            self.svg.line([(start, top), (start, y)], stroke=ENVELOPES)
        far = max(ends, key=lambda x: abs(x - start), default=start)
        half = text_width(lane.label, LABEL_SIZE) / 2
        middle = min(max((start + far) / 2, MARGIN + half), MARGIN + self.bar_width - half)
        self.svg.text(middle, y - 6, lane.label, size=LABEL_SIZE, fill=ENVELOPES, halo=True)

    def _entry(self, lane: PublisherLane, box: ProcessBox) -> float:
        arriving = [other for other in self.lanes if box in other.listeners]
        return box.x - box.width / 4 + arriving.index(lane) * min(14.0, box.width / 2 / (len(arriving) + 1))

    def _scheduler(self, part: ExperimentPart) -> None:
        fill, stroke = FILLS[Role.SCHEDULER]
        self.svg.box(self.bar_x, self.bar_y, self.bar_width, BAR_HEIGHT, fill=fill, stroke=stroke)
        middle = self.bar_x + self.bar_width / 2
        self.svg.text(middle, self.bar_y + 27, part.name, size=NAME_SIZE, bold=True)
        what = self.boxes[part.name].lines[0][0]
        self.svg.text(middle, self.bar_y + 27 + LINE, what, size=TEXT_SIZE, fill=GREY)
        self._addresses(part.name, self.bar_x + 14, self.bar_x + self.bar_width - 14, self.bar_y + 27)

    def _addresses(self, name: str, left: float, right: float, y: float) -> None:
        for use, label, x, anchor, colour in (
            ("publish", "publishes", left, "start", ENVELOPES),
            ("serve", "answers", right, "end", CONTROL),
        ):
            slot = self.resolved.net.slots.get(f"{name}/{use}")
            if slot is not None:
                self.svg.text(x, y, label, size=TEXT_SIZE, fill=colour, anchor=anchor)
                self.svg.text(x, y + LINE, _at(slot.address), size=TEXT_SIZE, fill=GREY, anchor=anchor)

    def _translator(self, box: ProcessBox) -> float:
        middle = self.bar_x + self.bar_width / 2
        top = self.bar_y + BAR_HEIGHT
        name = box.part.name
        slots = [self.resolved.net.slots.get(f"{name}/{use}") for use in ("publish", "serve")]
        sides = max(text_width(_at(slot.address), TEXT_SIZE) if slot else 0.0 for slot in slots)
        width = box.width + 2 * sides + 24
        box.x, box.y, box.height = middle, top + 64, max(box.own_height, 56.0)
        fill, stroke = FILLS[Role.TRANSLATOR]
        self.svg.box(middle - width / 2, box.y, width, box.height, fill=fill, stroke=stroke)
        self.svg.text(middle, box.y + 24, name, size=NAME_SIZE, bold=True)
        for i, (text, colour) in enumerate(box.lines, 1):
            self.svg.text(middle, box.y + 24 + LINE * i, text, size=TEXT_SIZE, fill=colour)
        self._addresses(name, middle - width / 2 + 12, middle + width / 2 - 12, box.y + 24)
        self._up(middle - ARROW_AT, top, box.y, ["all envelopes"])
        self._down(middle + ARROW_AT, top, box.y)
        below = box.y + box.height
        self.svg.line([(middle, below), (middle, below + 38)], stroke=VENDOR, start=True, dashed=True)
        label = "simulated microscope" if self.resolved.simulated else "microscope"
        half = text_width(label, TEXT_SIZE) / 2 + 18
        self.svg.box(middle - half, below + 38, 2 * half, 30, fill="#f6f6f6", stroke=VENDOR, dashed=True, corner=15)
        self.svg.text(middle, below + 57, label, size=TEXT_SIZE, fill="#444444")
        return below + 68

    def _legend(self, y: float) -> None:
        x = MARGIN
        for colour, label in ((ENVELOPES, "published envelopes"), (CONTROL, "requests, each with its response")):
            self.svg.line([(x, y - 4), (x + 34, y - 4)], stroke=colour)
            self.svg.text(x + 42, y, label, size=LABEL_SIZE, fill=GREY, anchor="start")
            x += 42 + text_width(label, LABEL_SIZE) + 30


def _at(address: str | None) -> str:
    return f"at {address}" if address else "at a free port"
