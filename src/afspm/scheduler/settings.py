"""The settings of a scheduler, each described once.

| class | settings |
| --- | --- |
| `ControlSettings`, `RoleTable` | the sections [control] and [control.roles] of the experiment file |
| `CacheSettings`, `CacheRule` | the section [cache] |
| `ExperimentLimits`, `Limit` | the section [limits], in the units of the microscope's parameters |
| `InstrumentSettings` | the section [conditions], and the names of the instruments |
| `Waits`, `RunFacts` | settings that no file holds |

The experiment file is checked against these classes, the tables of the reference are made of them, and a scheduler gets
them as plain data (`model.snapshot`). The key in the file is the name without its unit: `lease` for `lease_s`.

Two descriptions of one setting drift apart: the decisions once gave a lost holder 10 s, and the file 5 s. [limits] is
still read by a module of its own (`experiment.limits_section`), since only the driver knows the units of its
quantities.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from afspm.basics.frozen import replace
from afspm.basics.plain_data import SECTION, Switch, WholeNumber
from afspm.basics.units import Duration, PositiveDuration
from afspm.model import ProblemNames
from afspm.model.events import SUPERVISOR
from afspm.scheduler.control.arbitration import Cause, RoleTable, Rules
from afspm.scheduler.instruments.conditions import InstrumentSettings
from afspm.scheduler.publishing.envelopes import Envelopes
from afspm.scheduler.safety.limits import ExperimentLimits
from afspm.scheduler.safety.watchdog import WatchdogSettings

DangerousState = Literal["MOVING", "SCANNING", "COARSE_MOTOR", "BUSY_PARAM", "SPEC", "feedback-off"]
AdjustableParameter = Literal["zctrl-setpoint", "zctrl-pgain", "zctrl-igain", "tip-bias-voltage"]
"""Parameters that a person may set while a component measures, since none of them moves the tip elsewhere."""


@dataclass(frozen=True)
class ControlSettings:
    """The rules for giving control and taking it away.

    Attributes:
        lease_s: experiment time after which an idle holder loses control.
        grace_s: real time for which a holder whose connection is gone keeps control, if it will be restarted.
        malfunction_after_s: real time for which the microscope may be lost before `device-malfunction` is flagged; the
            flag is cleared when the microscope is back.
        stop_scan_on_problem: whether to stop a running scan when a flagged problem takes control from the holder.
        stop_scan_on_manual: whether to stop a running scan when the mode changes to MANUAL.
        stopped_by_hand: what follows a person's stop of a measurement at the microscope. `"pause"`: the mode becomes
            MANUAL, until a person lets the run continue; `"repeat"`: it is measured again.
        changed_by_hand: what follows a person's change of a setting at the microscope. `"tell"`: it is logged, and
            kept, also by a plan that states the parameter; `"pause"`: the mode becomes MANUAL, as it always does for
            a value outside `[limits]`.
        retract: whether to retract the tip, if the microscope can, when a holder loses control in a dangerous state.
            The tip is not retracted when the holder gives control back, or a person takes control.
        dangerous: list of the dangerous states: `MOVING`, `SCANNING`, `COARSE_MOTOR`, `BUSY_PARAM`, `SPEC`,
            `feedback-off`; without the key `COARSE_MOTOR` and `feedback-off`.
        request_timeout_s: real time after which a request counts as unanswered.
        request_retries: how often an unanswered request is sent again; it is never executed twice.
        settle_s: experiment time after a change of bias, setpoint or gains with the tip at the sample, before a
            measurement begins.
        return_after_s: experiment time for which the microscope may be free until settings of a measurement are set
            back to the values of before.
        adjustable: parameters that a person sets in AUTOMATED as well, beside the component in control, while no
            problem is flagged: any of `zctrl-setpoint`, `zctrl-pgain`, `zctrl-igain`, `tip-bias-voltage`. The
            translator sets them during a scan, too; they hold from the next line on.
        idle: the end of a run in which nothing is left to run: `"end"`, or `"stay"` until a person ends it.
        solved_by_hand: problems that a person solves: a component may flag them though no component solves them.
        end_on: problems that end the experiment as soon as they are flagged, such as `["tip-shape-changed"]` where no
            component repairs the tip.
        agents: components whose commands need the approval of a person; without the key: components of the class
            `Agent`.
        shadow: whether the run only watches a person's work. The mode is MANUAL from the start and stays so: no
            component gets control, a flagged problem is only noted, and nothing is sent. `afspm shadow` sets it.
        roles: see below.
    """

    lease_s: PositiveDuration | None = None
    grace_s: Duration = 5.0
    malfunction_after_s: Duration = 5.0
    stop_scan_on_problem: Switch = True
    stop_scan_on_manual: Switch = True
    stopped_by_hand: Literal["pause", "repeat"] = "pause"
    changed_by_hand: Literal["tell", "pause"] = "tell"
    retract: Switch = True
    dangerous: tuple[DangerousState, ...] | None = None
    request_timeout_s: PositiveDuration = 5.0
    request_retries: WholeNumber = 3
    settle_s: Duration = 0.5
    return_after_s: PositiveDuration = 600.0
    adjustable: tuple[AdjustableParameter, ...] = ()
    idle: Literal["end", "stay"] = "end"
    solved_by_hand: tuple[str, ...] = ("device-malfunction",)
    end_on: tuple[str, ...] = ()
    agents: tuple[str, ...] | None = None
    shadow: Switch = False
    roles: RoleTable = field(default_factory=RoleTable)

    __pydantic_config__: ClassVar[object] = SECTION

    def rules(self, problems: ProblemNames) -> Rules:
        """Return the settings that the arbitration table needs.

        Raises:
            InvalidValue: an unknown problem in `end_on`.
        """
        roles, end = self.roles, self.roles.end_experiment
        if end is not None:  # a supervisor ends the experiment when no component that can act is left
            roles = replace(roles, end_experiment=(*end, SUPERVISOR))
        return Rules(
            roles,
            problems,
            frozenset(self.adjustable),
            frozenset(map(problems.number, self.end_on)),
            frozenset(self.agents or ()),
            frozenset(problems[name] for name in self.solved_by_hand if name in problems),
            self.shadow,
        )

    def watchdog(self) -> WatchdogSettings:
        default = WatchdogSettings()
        spared = set[Cause]()
        if not self.stop_scan_on_problem:
            spared.add(Cause.PROBLEM)
        if not self.stop_scan_on_manual:
            spared.add(Cause.MANUAL)
        return WatchdogSettings(
            stop_when=frozenset(default.stop_when) - spared,
            dangerous=default.dangerous if self.dangerous is None else frozenset(self.dangerous),
            retract=default.retract if self.retract else None,
        )


@dataclass(frozen=True)
class Waits:
    """The scheduler's waits, in real time.

    Attributes:
        restart_grace_s: the time for which a holder stays in control without connecting after a restart of the
            scheduler.
        answer_s: the further time for which the line to the translator is kept for an overdue answer.
        takeover_s: see `model.sessions.SessionTable`.
        catch_up_s: the time that a starting scheduler waits for packets that the translator published before.
        longest_queue: the largest number of requests that wait for the translator.
    """

    restart_grace_s: float = 30.0
    answer_s: float = 5.0
    takeover_s: float = 3.0
    catch_up_s: float = 1.0
    longest_queue: int = 64


@dataclass(frozen=True)
class RunFacts:
    """The facts of a run in the scheduler's answer to `CLOCK_REQUEST`.

    Attributes:
        clock: `ExperimentClock.as_dict()`; empty: real time.
        name: the identity of the run; empty if unknown.
        simulated: whether the microscope is simulated.
        versions: the versions of the programs on this computer.
    """

    clock: Mapping[str, float] = field(default_factory=dict)
    name: str = ""
    simulated: bool = False
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SchedulerSettings:
    """The settings of a scheduler's decisions.

    Attributes:
        rules: `control.rules(problems)`.
        watchdog: `control.watchdog()`.
        cache_bytes: the largest size of the cache.
    """

    control: ControlSettings = field(default_factory=ControlSettings)
    rules: Rules = field(default_factory=Rules)
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)
    limits: ExperimentLimits = field(default_factory=ExperimentLimits)
    instruments: InstrumentSettings = field(default_factory=InstrumentSettings)
    envelopes: Envelopes = field(default_factory=Envelopes)
    cache_bytes: int = 512 * 2**20
    waits: Waits = field(default_factory=Waits)
    run: RunFacts = field(default_factory=RunFacts)
