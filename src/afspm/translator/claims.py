"""`Claims`: what the running measurement stands for, from the request that begins it to the verdict on its result."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from afspm.model import ActByHand, MeasurementConditions, Parameter, Request, ScopeState, TipStatus, names
from afspm.model.caption import BIAS_REFERENCE, captioned
from afspm.translator.driver_base import DriverBase
from afspm.translator.judge import Claim, ResultVerdict, Stated, Witness, judge
from afspm.translator.parameters import FEEDBACK_ON, Value
from afspm.translator.setting_groups import FRAME, POSITION, frame, frame_outside
from afspm.translator.state import KeptState

_PROVED_ELSEWHERE = frozenset((*FRAME, *POSITION, FEEDBACK_ON))
"""The frame and the place are compared with the result, and the feedback with the wish of the run."""


class Claims:
    """The claim of the running measurement, and the settings that the run makes for the next one.

    Args:
        kept: JSON values that outlive a kill.

    Attributes:
        repeated: the sentence of a contradiction that came twice in a row, until it is taken; empty: none.
    """

    def __init__(self, driver: DriverBase, kept: KeptState) -> None:
        self._driver = driver
        self._kept = kept.setdefault("claims", {"next": {}, "asked": None, "running": None, "contradicted": ""})
        self._end: dict[str, Value] = {}
        self._end_in_force: dict[str, Value] = {}
        self._tip: TipStatus | None = None
        self.repeated = ""
        self._beyond = ""

    @property
    def running(self) -> Claim | None:
        """The claim of the running measurement; None without a measurement."""
        kept = self._kept["running"]
        return None if kept is None else Claim.of(kept)

    @property
    def is_by_run(self) -> bool:
        """Whether a measurement runs that the run has asked for."""
        return bool(self._kept["running"] and self._kept["running"]["holder"])

    def is_set(self, read_back: Mapping[str, Value]) -> None:
        """Note settings that a request has made: the next measurement stands for them."""
        coming = self._kept["next"]
        if not read_back.keys().isdisjoint(FRAME):
            coming.pop(names.SCAN_SPEED, None)  # at a controller with a line rate the frame changes it
        table = self._driver.table
        own = {
            name: value
            for name, value in read_back.items()
            if name not in _PROVED_ELSEWHERE and not table[name].measured
        }
        kind = coming.get(names.SPEC_KIND, read_back.get(names.SPEC_KIND))
        if kind != read_back.get(names.SPEC_KIND, kind):  # each kind of curve has settings of its own
            for name in names.OF_CURVES:
                coming.pop(name, None)
        coming |= own
        if self._kept["running"] is not None:  # the run itself changes its running measurement
            for name in own:
                self._kept["running"]["values"].pop(name, None)

    def compared(self, claimed: Mapping[str, Value], others: Collection[str]) -> None:
        """Note what the next measurement stands for; it begins with these values, or not at all.

        Args:
            claimed: the values that it states, those in force alone.
            others: what was compared, and is not stated.
        """
        kept = self._kept
        for name in others:
            kept["next"].pop(name, None)
        kept["stated"] = [name for name in kept.get("stated", ()) if name not in others]
        kept["stated"] += [name for name in claimed if name not in kept["stated"]]
        self.is_set(claimed)

    def not_as_stated(self) -> str:
        """Return why a measurement may not begin: a value that it states is not in force. It is claimed no more."""
        asked = self._kept["asked"]
        if asked is None or not self._kept.get("stated"):
            return ""
        claim, stated = Claim.of(asked), set(self._kept["stated"])
        claim = replace(claim, values={name: value for name, value in claim.values.items() if name in stated})
        changed = self._differences(claim, {})
        for name in changed:
            self._kept["next"].pop(name, None)
            self._kept["asked"]["values"].pop(name, None)
            self._kept["stated"].remove(name)
        return "; ".join(changed.values())

    def asks(self, request: Request, values: Mapping[str, Value]) -> None:
        """Note the settings in force right before a measurement is asked for.

        Args:
            values: the settings just read.
        """
        holder = request.id.partition("/")[0] or "a program without a name"
        coming = dict(self._kept["next"])
        shown = self._of_caption(of_scan=request.subject == names.START_SCAN)
        claim = Claim(0, holder, values=coming, begin=self._read(coming), in_force=self._read_shown(shown))
        if request.subject == names.START_SCAN and values.keys() >= {*FRAME} - {names.SCAN_ANGLE}:
            region, shape = frame(values)
            claim = replace(claim, frame=region, shape=shape)
        self._kept["asked"] = claim.kept()

    def is_refused(self) -> None:
        """Note that the measurement asked for was not begun."""
        self._kept["asked"] = None

    def begin(self, began_ns: int, tip: TipStatus, doing: ScopeState, values: Mapping[str, Value]) -> None:
        """Note that a measurement has begun, perhaps asked for by an earlier process of this translator.

        Args:
            values: the settings at the last reading.
        """
        asked, self._kept["asked"] = self._kept["asked"], None
        claim = Claim(began_ns, tip=tip)
        if asked is not None:
            claim = replace(Claim.of(asked), began_ns=began_ns, tip=tip)
            self._kept["next"] = {}
            self._kept["stated"] = []
        else:  # at the panel; a spectrum sweeps its settings by now
            is_scan = doing is ScopeState.SCANNING
            known = values if is_scan else {}
            claim = replace(claim, in_force={name: known.get(name) for name in self._of_caption(of_scan=is_scan)})
        self._kept["running"] = claim.kept()

    def end(self) -> None:
        """Note that no measurement runs any more."""
        self._kept["running"] = None

    def verdict(self, tip: TipStatus | None, stated: Sequence[Stated], withdrew: str = "") -> ResultVerdict:
        """Return the verdict on the results of the measurement that has ended.

        Args:
            tip: at its end; None: its end was not seen, and the present settings prove nothing.
            withdrew: why the controller itself has withdrawn the tip, as it may after each scan; empty: it has not.
        """
        claim = self.running or Claim(0)
        self._tip, self._end = tip, {} if tip is None else self._read(claim.values)
        self._end_in_force = {} if tip is None else self._read_shown(claim.in_force)
        witness = Witness(None if withdrew else tip, self._differences(claim, self._end))
        verdicts = [judge(claim, witness, one) for one in stated or [Stated()]]
        found = next((one for one in verdicts if one.rule), verdicts[0])
        beyond = self._beyond_the_scanner(stated)  # before anything is kept, since the controller may be lost in it
        # by the rule alone, not by its numbers: a person who turns a knob gives another value each time
        again = bool(found.rule) and self._kept["contradicted"] == found.rule
        self.repeated, self._kept["contradicted"] = (found.sentence, "") if again else ("", found.rule)
        return replace(found, unproved=(*found.unproved, beyond)) if beyond else found

    def _beyond_the_scanner(self, stated: Sequence[Stated]) -> str:
        # a request for such a frame is refused; a person may set it, and many controllers take it and clip the voltages
        frames = [one.frame for one in stated if one.frame is not None]
        reach = self._driver.reach() if frames else {}
        beyond = next((why for one in frames if (why := frame_outside(one, reach))), "")
        if beyond and beyond != self._beyond:  # a panel may repeat the scan all night
            self._driver.log.warning("the scan may not show the place that it names: %s", beyond)
        self._beyond = beyond
        return beyond

    def conditions(
        self, time_ns: int, filename: str, acts: Sequence[ActByHand], unproved: Sequence[str]
    ) -> MeasurementConditions:
        """Return the conditions to publish beside a result, after its verdict."""
        claim = self.running or Claim(0)
        return MeasurementConditions(
            time_ns,
            filename,
            claim.tip,
            self._tip,
            tuple(acts),
            claim.began_ns or None,
            claim.holder,
            self._parameters({name: claim.begin.get(name, value) for name, value in claim.values.items()}),
            self._parameters(self._end),
            tuple(unproved),
            self._in_force({name: value for name, value in claim.in_force.items() if value is not None}),
            self._in_force(self._end_in_force),
        )

    def _in_force(self, values: Mapping[str, Value]) -> tuple[Parameter, ...]:
        shown, of = self._parameters(values), self._driver.bias.of
        return (*shown, Parameter(BIAS_REFERENCE, of)) if of and names.TIP_BIAS_VOLTAGE in values else shown

    def _of_caption(self, *, of_scan: bool) -> list[str]:
        return captioned(self._driver.table, of_scan=of_scan)

    def _read_shown(self, wanted: Collection[str]) -> dict[str, Value]:
        # a caption is no reason to refuse or lose a measurement
        return self._driver.reported(list(wanted))

    def _read(self, wanted: Mapping[str, Value]) -> dict[str, Value]:
        return self._driver.in_force(list(wanted)) if wanted else {}

    def _differences(self, claim: Claim, at_end: Mapping[str, Value]) -> dict[str, str]:
        found: dict[str, str] = {}
        for when, values in (("end", at_end), ("begin", claim.begin)):
            for name, value in claim.values.items():
                if name in values and not self._driver.same(name, values[name], value, values):
                    made, asked = (self._driver.table[name].quantity(one) for one in (values[name], value))
                    found[name] = f"{name} was {made} at its {when}, and the run had set it to {asked}"
        return found

    def _parameters(self, values: Mapping[str, Value]) -> tuple[Parameter, ...]:
        table = self._driver.table
        return tuple(Parameter(name, *table[name].for_peer(value)) for name, value in values.items())
