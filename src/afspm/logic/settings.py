"""The settings of a scheduler, from the experiment file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.logic.arbitration import Rules
from afspm.logic.envelopes import Envelopes
from afspm.logic.limits import ExperimentLimits
from afspm.logic.watchdog import WatchdogSettings


@dataclass(frozen=True)
class SchedulerSettings:
    """The settings of a scheduler's decisions.

    Attributes:
        rules: roles and problems.
        grace_s: how long (real) a holder that is gone stays in control.
        restart_grace_s: the same for one that has not been heard of since the scheduler itself was restarted.
        lease_s: how long (experiment) a holder may do nothing while the microscope is free; None: as it likes.
        request_timeout_s: within which (real) a request to the translator is answered, by us if it must be.
        patience_s: how much longer the line to the translator is kept for an answer that is overdue.
        longest_queue: how many requests may wait for the translator.
        takeover_s: see `Sessions`.
        cache_bytes: how much is cached at most.
        catch_up_s: how long (real) a scheduler waits at its start for what the translator has published before.
        malfunction_after_s: how long (real) the microscope may be lost before that is flagged as a malfunction.
        clock: `ExperimentClock.as_dict()`, to be told to those who ask; empty: real time.
        run: the identity of the run, which is told with it; empty: it has none.
        simulated: whether the microscope is, which is told with it.
        versions: of the programs on this computer, which are told with it, too.
    """

    rules: Rules = field(default_factory=Rules)
    grace_s: float = 10.0
    restart_grace_s: float = 30.0
    lease_s: float | None = None
    request_timeout_s: float = 5.0
    patience_s: float = 5.0
    longest_queue: int = 64
    takeover_s: float = 3.0
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)
    limits: ExperimentLimits = field(default_factory=ExperimentLimits)
    envelopes: Envelopes = field(default_factory=Envelopes)
    cache_bytes: int = 512 * 2**20
    catch_up_s: float = 1.0
    malfunction_after_s: float = 5.0
    clock: Mapping[str, float] = field(default_factory=dict)
    run: str = ""
    simulated: bool = False
    versions: Mapping[str, str] = field(default_factory=dict)
