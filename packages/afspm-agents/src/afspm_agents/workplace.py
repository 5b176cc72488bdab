"""Proposals and runs of agents, and their requests to the scheduler, each under its agent's name."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Protocol, TypeVar

from afspm import Memory, wire
from afspm.basics import Plain
from afspm.client import Target
from afspm.model import (
    LEASE_AT_ONCE_S,
    RELAY_REQUEST,
    STOPPED_BY_AGENT,
    Approvals,
    ControlRequest,
    ControlResponse,
    Frame,
    Proposal,
    RelayedMessage,
    Request,
    Response,
)
from afspm.model.grants import with_proposal
from afspm.model.microscope_status import feedback_of
from afspm.model.problems import STOPPER
from afspm.plugins.web.archive import Archive
from afspm.plugins.web.gateway.measurements import Measurement, Measurements
from afspm.plugins.web.gateway.models import MeasurementState
from afspm.plugins.web.gateway.problems import RefusalCode, RefusedRequest, of_error, refused
from afspm.plugins.web.person_commands import PersonCommands
from afspm.plugins.web.watch import Bell, Watch
from afspm.transport import StopRequested
from afspm_agents.plan import MoveStep, Plan, ScanStep, SetStep, SpectrumStep, Step, plan_of

LEASE_S = 30.0
"""Real seconds after which an agent whose process is gone loses control."""
RENEW_S = 10.0
STOP_ANSWERED_S = 5.0
STOP_AGAIN_S = 0.5
MOST_RUNS = 200
MOST_PROPOSALS = 200

T = TypeVar("T")
_log = logging.getLogger("afspm_agents")


class Requests(Protocol):
    """Sender of requests, each under its agent's name. `web.persons.Persons` implements it with network connections."""

    def name_of(self, person: str) -> str: ...

    def submit(self, person: str, action: Callable[[PersonCommands], T]) -> Future[T]:
        """Start an action in the thread that sends this agent's requests, and return its future."""


@dataclass
class PlanRun:
    """A plan or single measurement in progress or finished.

    Attributes:
        who: the agent's name, as the scheduler knows it.
        plan: id of the proposal; empty for a single measurement.
        state: "running", "done", "failed", "stopped", or "interrupted" by a restart of this process.
        step: number of the current step, from 1.
        results: ids of finished scans and spectra.
        refusal: why the run failed, with the fields of a `RefusalModel`.
    """

    id: str
    who: str
    plan: str
    steps: int
    state: str = "running"
    step: int = 0
    results: list[str] = field(default_factory=list)
    refusal: dict[str, object] | None = None


class Workplace:
    """State shared by all agents: the published experiment, proposals and runs. Runs belong to one event loop.

    Args:
        watch, archive: messages and record of the experiment so far.
        requests: sender of requests.
        file: file that keeps runs over a restart of this process; None: runs are not kept.

    Attributes:
        approvals: approvals in force, as last published by the scheduler.
    """

    def __init__(
        self,
        watch: Watch,
        bell: Bell,
        archive: Archive,
        measurements: Measurements,
        requests: Requests,
        frame: Frame,
        *,
        experiment: str,
        simulated: bool,
        run_dir: Path,
        file: Path | None = None,
    ) -> None:
        self.watch, self.bell, self.archive, self.measurements = watch, bell, archive, measurements
        self.requests, self.frame = requests, frame
        self.experiment, self.simulated, self.run_dir = experiment, simulated, run_dir
        self.approvals = Approvals()
        self.proposals: dict[str, Proposal] = {}
        # on the event loop, where `stop` must not wait for a hanging disk
        self._memory = Memory(file, synced=False)
        self.runs: dict[str, PlanRun] = {}
        self._saved: dict[str, dict[str, object]] = {}
        for facts in self._memory.get("runs", ()):
            run = PlanRun(**facts)
            # control has been lost with the process, and an approved plan is for one run
            run.state = "interrupted" if run.state == "running" else run.state
            self.runs[run.id], self._saved[run.id] = run, asdict(run)
        self._tasks: dict[str, asyncio.Task[None]] = {}

    # --- published messages: from the component's thread ---

    def take(self, thing: object, time_ns: int) -> None:
        """Process a published message."""
        self.measurements.on_packet(thing, time_ns)
        if isinstance(thing, Approvals):
            self.approvals = thing
        elif isinstance(thing, Proposal):
            # a new dict: the event loop reads the present one meanwhile
            self.proposals = with_proposal(self.proposals, thing, MOST_PROPOSALS)

    # --- requests ---

    async def do(self, person: str, action: Callable[[PersonCommands], T]) -> T:
        """Carry out an action under an agent's name. Raises RefusedRequest."""
        try:
            # shielded: a client that disconnects does not cancel its request to the scheduler
            future = self.requests.submit(person, action)
            return await asyncio.shield(asyncio.wrap_future(future))
        except (
            Exception,
            StopRequested,
        ) as error:  # any error becomes a refusal; StopRequested: the experiment ended meanwhile
            raise of_error(error) from error

    async def ask(self, person: str, action: Callable[[PersonCommands], Response]) -> Response:
        """Send a request to the scheduler, and return the response. Raises RefusedRequest for a refusal."""
        response = await self.do(person, action)
        if not response.ok:
            raise refused(response)
        return response

    # --- proposals ---

    def proposal(self, id_: str) -> tuple[Proposal, Plan]:
        """Return a proposal and its plan. Raises RefusedRequest for an unknown id."""
        found = self.proposals.get(id_)
        if found is None:
            raise RefusedRequest(RefusalCode.NOT_FOUND, f"there is no proposal {id_}")
        return found, plan_of(found.plan)

    async def publish(self, person: str, plan: Plan, preflight: str = "") -> Proposal:
        """Publish a proposal, for people and for the record."""
        first = self.proposals.get(plan.id)
        if first is not None and first.who != self.requests.name_of(person):
            raise RefusedRequest(RefusalCode.FORBIDDEN, "another agent has proposed the same plan: change its title")
        now_ns = self.watch.clock.now_ns()
        proposal = Proposal(now_ns, self.requests.name_of(person), plan.id, plan.canonical(), preflight)
        relayed = RelayedMessage(*wire.encode(proposal))
        await self.ask(person, lambda commands: commands.request(RELAY_REQUEST, relayed))
        self.take(proposal, now_ns)
        return proposal

    # --- runs ---

    def begin(self, person: str, plan: Plan, *, proposal: str) -> PlanRun:
        """Start to carry out a plan, and return at once. Raises RefusedRequest if this agent has a run in progress."""
        who = self.requests.name_of(person)
        if any(one.who == who and one.state == "running" for one in self.runs.values()):
            raise RefusedRequest(RefusalCode.NOT_FREE, "a run of yours goes on; wait for its end, or stop")
        number = max((int(one) for one in self.runs), default=0) + 1
        run = PlanRun(str(number), who, proposal, len(plan.steps))
        self.runs[run.id] = run
        self._save(run)
        self._tasks[run.id] = asyncio.ensure_future(self._carry_out(person, run, plan))
        self._tasks[run.id].add_done_callback(lambda _: self._tasks.pop(run.id, None))
        return run

    async def stop(self, person: str) -> bool:
        """Cancel the agent's runs and flag `stopped-by-agent`; return False if the flag is not accepted within 5 s.

        The request is then repeated in the background, until the scheduler accepts the flag or the experiment ends.
        """
        for run in self.runs.values():
            if run.who == self.requests.name_of(person) and (task := self._tasks.get(run.id)) is not None:
                task.cancel()
        flagging = asyncio.ensure_future(self._flag(f"{person}{STOPPER}"))
        self._tasks[f"stop {person}"] = flagging
        flagging.add_done_callback(lambda _: self._tasks.pop(f"stop {person}", None))
        await asyncio.wait({flagging}, timeout=STOP_ANSWERED_S)
        return flagging.done()

    async def _flag(self, person: str) -> None:
        number = self.watch.problems.number(STOPPED_BY_AGENT)
        while True:
            try:
                response = await self.do(person, lambda commands: commands.flag(number))
                if response.ok:
                    return
                why = response.reason
            except RefusedRequest as error:
                if error.model.code is RefusalCode.EXPERIMENT_ENDED:
                    return
                why = error.model.reason
            _log.warning("stop of %s is tried again: %s", person, why)
            await asyncio.sleep(STOP_AGAIN_S)

    async def _carry_out(self, person: str, run: PlanRun, plan: Plan) -> None:
        try:
            await self.ask(person, lambda commands: commands.request_control())
            await self._renew(person)
            for step in plan.steps:
                run.step += 1
                self._save(run)
                await self._step_when_allowed(person, run, step)
            run.state = "done"
        except RefusedRequest as error:
            run.state, run.refusal = "failed", error.model.model_dump(mode="json")
        except asyncio.CancelledError:
            run.state = "stopped"
        except Exception as error:  # of this program: the run has failed, and the agent must learn of it
            _log.exception("a run of %s failed", run.who)
            run.state, run.refusal = "failed", of_error(error).model.model_dump(mode="json")
        finally:
            self._save(run)
        try:
            if run.state == "failed" and _is_off_after(plan.steps[: run.step]):
                await self.do(person, lambda commands: commands.renew(LEASE_AT_ONCE_S))
            else:
                await self.do(person, lambda commands: commands.release_control())
        except RefusedRequest as error:  # control then ends with its lease
            _log.info("%s could not release control: %s", run.who, error.model.reason)

    async def _step_when_allowed(self, person: str, run: PlanRun, step: Step) -> None:
        # keeps control over the waits for limits: a plan is approved for one run without interruption
        while True:
            try:
                return await self._step(person, run, step)
            except RefusedRequest as error:
                if error.again_ns is None:
                    raise
                await self._wait_until(person, error.again_ns)

    async def _wait_until(self, person: str, time_ns: int) -> None:
        clock = self.watch.clock
        while (left_s := clock.real_s((time_ns - clock.now_ns()) * 1e-9)) > 0.0:
            await self._renew(person)
            await asyncio.sleep(min(left_s, RENEW_S))

    async def _step(self, person: str, run: PlanRun, step: Step) -> None:
        match step:
            case SetStep():
                await self.ask(person, lambda commands: commands.set(step.parameter, step.value))
            case MoveStep():
                refusal = await self.do(person, lambda commands: commands.prepare_spectrum(step.to_m))
                if refusal is not None:
                    raise refused(refusal)
            case ScanStep() | SpectrumStep():
                await self._measure(person, run, step.target(self.frame))

    async def _measure(self, person: str, run: PlanRun, target: Target) -> None:
        key = f"{run.id}-{run.step}"
        one: Measurement = await self.do(person, self.measurements.take(run.who, key, target))
        loop = asyncio.get_running_loop()
        renewed_s = loop.time()
        while one.state == MeasurementState.RUNNING.value:
            await self.bell.wait(1.0)
            if loop.time() - renewed_s >= RENEW_S:
                await self._renew(person)
                renewed_s = loop.time()
            one = self.measurements.find(run.who, key) or one
        model = one.model()
        if model.refusal is not None:
            raise RefusedRequest(model.refusal.code, model.refusal.reason)
        run.results.append(model.result or "")

    async def _renew(self, person: str) -> None:
        response = await self.do(person, lambda commands: commands.renew(LEASE_S))
        if not response.ok and response.code != ControlResponse.NO_RESPONSE:
            raise refused(response)

    def _save(self, changed: PlanRun) -> None:
        # only the changed run is turned into plain data: up to MOST_RUNS are kept, and each step of a run saves
        self._saved[changed.id] = asdict(changed)
        while len(self.runs) > MOST_RUNS:
            oldest = next((one for one in self.runs.values() if one.state != "running"), None)
            if oldest is None:
                break
            del self.runs[oldest.id]
            del self._saved[oldest.id]
        self._memory["runs"] = list(self._saved.values())
        self._memory.save(synced=False)


def _is_off_after(steps: Sequence[Step]) -> bool:
    # the last step has failed: it may have switched the feedback off, but not on
    is_off = False
    for step in steps:
        feedback = feedback_of(Request(ControlRequest.PARAM, step.wanted)) if isinstance(step, SetStep) else None
        if feedback is not None and not (feedback.on and step is steps[-1]):
            is_off = not feedback.on
    return is_off


def with_preflight(proposal: Proposal, preflight: Plain) -> Proposal:
    return replace(proposal, preflight=json.dumps(preflight, sort_keys=True))
