"""One trial: the sealed experiment, the agent's process, the end, and the verdict."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import secrets
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Final
from urllib.parse import urlsplit

import afspm
from afspm import Scope
from afspm.basics import AfspmError, ExperimentClock, NoResponse, PlainMapping, python_command, python_environment
from afspm.client import guest_of
from afspm.experiment import toml_text
from afspm.model import ControlMode, ScopeState, names
from afspm.record import latest_run
from afspm.supervisor import FreePorts
from afspm_bench.agent_files import AgentFiles
from afspm_bench.agent_folder import MOST_BYTES, remove, require_bounds, watched
from afspm_bench.cassette import REPORT_CALL, ToolCall, recording
from afspm_bench.evidence import Evidence, Report, read_report
from afspm_bench.judging import TrialVerdict, judge
from afspm_bench.kept_clock import keeping
from afspm_bench.sealing import Seal
from afspm_bench.session import REPORT_FILE
from afspm_bench.tasks import BenchTask

AGENT: Final = "agent"
MCP: Final = "mcp"
JOINED_WITHIN_S: Final = 60.0
RETRY_S: Final = 0.05
KILLED_WITHIN_S: Final = 10.0
_LAST_WORDS_S: Final = 2.0
_LAST_LINES, _LAST_BYTES, _LONGEST_LINE = 3, 500, 64
ENDED_WITHIN_S: Final = 60.0
GRANT_MARGIN_S: Final = 3600.0
"""Experiment time added to the duration of a grant, for the start and end of the processes."""
_FINAL: Final = (names.SCAN_SPEED, names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT)


_log = logging.getLogger(__name__)


class TrialFailed(AfspmError):
    """Error: a trial could not be run: it ended before the agent's process was started."""

    code = "trial-failed"


class AgentFailed(AfspmError):
    """Error: an agent's process did not get ready for its task."""

    code = "agent-failed"


@dataclass(frozen=True)
class AgentSpec:
    """An agent to be tested.

    Attributes:
        name: name in the table.
        python: "module:Class"; empty for a command.
        command: program and arguments of an agent that joins over HTTP or MCP.
        sees_truth: whether the agent may read the truth, like the oracle.
        import_from: folders with the agent's Python modules.
    """

    name: str
    python: str = ""
    command: tuple[str, ...] = ()
    sees_truth: bool = False
    import_from: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrialOutcome:
    """Verdict and circumstances of one finished trial.

    Attributes:
        ended: end of the agent's process: "ended", "failed" (exit code not 0), or "time" if it was stopped; "error" if
            the trial ended in an error afterwards, so that it is not judged, but has failed.
        sealed: whether the agent's process could open only the files that it needs.
    """

    verdict: TrialVerdict
    ended: str
    sealed: bool
    real_s: float
    experiment_s: float
    report: PlainMapping = field(default_factory=dict)


def run_trial(
    task: BenchTask,
    agent: AgentSpec,
    folder: Path,
    own: Path,
    *,
    files: AgentFiles | None,
    patience_s: float,
    keep: bool,
    calls: list[ToolCall] | None = None,
) -> TrialOutcome:
    """Run one trial of a task in a new folder, and return its verdict.

    Args:
        folder, own: new folders of the experiment and of the agent.
        files: the files that the agent's process may read; None: the agent is not sealed off.
        patience_s: real time for the start of the agent's process, and again for its work, after which it is stopped.
        keep: keep both folders.
        calls: receives the agent's tool calls over MCP, and its report as the last entry.

    Raises:
        TrialFailed: the trial ended before the agent's process was started.
    """
    modules = own.parent / f"{own.name}-modules"
    started_s, agent_started = time.monotonic(), threading.Event()
    try:
        for made in (folder, own):
            made.mkdir(parents=True, mode=0o700)
        require_bounds(own)
        if files is not None:
            files.link_modules(modules)
        with _experiment(task, agent, folder) as running, contextlib.ExitStack() as proxy:
            if calls is not None and running.mcp_url:
                # the proxy listens at once, and the server behind it may not yet
                await_listener(running.mcp_url, JOINED_WITHIN_S)
                running.mcp_url = proxy.enter_context(recording(running.mcp_url, task.full_prompt(), calls))
            allowed = None if files is None else _Allowed(files, modules)
            ended = _with_agent(running, task, agent, own, agent_started, allowed=allowed, patience_s=patience_s)
        verdict, report, end_ns = _judged(task, running, own)
        if calls is not None and report is not None:
            calls.append(ToolCall(task.full_prompt(), REPORT_CALL, answer=report.handed_in))
        plain = {} if report is None else report.as_plain()
        real_s, experiment_s = time.monotonic() - started_s, (end_ns - running.began_ns) * 1e-9
        return TrialOutcome(verdict, ended, files is not None, real_s, experiment_s, plain)
    except Exception as error:  # an agent may cause any error after its start, and no error spares it a failed trial
        if not agent_started.is_set():
            if isinstance(error, OSError | AfspmError) and not isinstance(error, TrialFailed):
                raise TrialFailed(str(error)) from error
            raise
        if not isinstance(error, AfspmError):
            _log.exception("%s ended in an error of the bench, and counts as failed", task.name)
        why = f"the trial ended in an error: {type(error).__name__}: {error}"
        verdict = TrialVerdict(solved=False, harmless=False, honest=False, why=(why,))
        return TrialOutcome(verdict, "error", files is not None, time.monotonic() - started_s, 0.0)
    finally:
        for made in (modules,) if keep else (folder, own, modules):
            remove(made)


@dataclass(frozen=True)
class _Allowed:
    """The files that a sealed agent may read, and the folder with links to its modules."""

    files: AgentFiles
    modules: Path


@dataclass
class _Running:
    """A running experiment, and the bench's own connection to it.

    Attributes:
        url: address of the gateway; mcp_url: address of the agent server, empty if the extra `agent` is not installed.
    """

    run: Path
    scope: Scope
    clock: ExperimentClock
    hold: _Hold
    name: str
    url: str
    mcp_url: str
    began_ns: int = 0
    final: dict[str, float] = field(default_factory=dict)


class _Hold:
    """A hold of the experiment clock at real speed, while the processes start."""

    def __init__(self, clock: ExperimentClock) -> None:
        self._clock = clock
        self._released = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="hold", daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Let the experiment time run at full speed. Safe to repeat."""
        self._released.set()
        self._thread.join()

    def _keep(self) -> None:
        with self._clock.late():
            self._released.wait()


@contextlib.contextmanager
def _experiment(task: BenchTask, agent: AgentSpec, folder: Path) -> Iterator[_Running]:
    name = f"bench-{secrets.token_hex(4)}"
    tables, url, mcp_url = task.tables(name), "", ""
    if agent.command:
        ports = FreePorts()
        port = ports.take()
        tables["gateway"] = {"component": True, "class": "Gateway", "port": port}
        url = f"http://127.0.0.1:{port}"
        if find_spec("mcp") is not None:
            port = ports.take()
            tables[MCP] = {"component": True, "class": "Agent", "port": port}
            mcp_url = f"http://127.0.0.1:{port}/mcp"
    file, runs = folder / "experiment.toml", folder / "runs"
    file.write_text(toml_text(tables), encoding="utf-8")
    # without a process for `name`: the bench itself joins under this name
    command = [*python_command("afspm"), "run", str(file), "--no-report", "--runs", str(runs), "--without", name]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder,
        encoding="utf-8", errors="replace", env={**os.environ, **python_environment()},
    )  # fmt: skip
    lines: deque[str] = deque(maxlen=_LAST_LINES)
    rest: threading.Thread | None = None
    try:
        run = _run_folder(process, runs, lines)
        rest = threading.Thread(target=_drain, args=(process.stdout, lines), daemon=True)
        rest.start()
        clock = ExperimentClock.from_dict(guest_of(run, name).clock)
        hold = _Hold(clock)
        try:
            running = _Running(run, _joined(run, name), clock, hold, name, url, mcp_url)
            with running.scope:
                yield running
                with contextlib.suppress(AfspmError):  # it may have ended already; its exit is awaited below
                    running.scope.end_experiment()
        finally:
            hold.release()
        process.wait(ENDED_WITHIN_S)
    except subprocess.TimeoutExpired as error:
        raise TrialFailed(f"the experiment did not end within {ENDED_WITHIN_S:g} s", where=str(folder)) from error
    except AfspmError as error:
        last = " | ".join(line.strip() for line in lines)
        raise TrialFailed(f"{task.name}: {error}; the run wrote: {last}", where=str(folder)) from error
    finally:
        if process.poll() is None:  # its own children end with it
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(ENDED_WITHIN_S)
            process.kill()
            process.wait()
        if rest is not None:
            rest.join()
        if process.stdout is not None:
            process.stdout.close()


def _run_folder(process: subprocess.Popen[str], runs: Path, lines: deque[str]) -> Path:
    # the folder is whole before the run writes its first line
    assert process.stdout is not None
    for line in process.stdout:
        lines.append(line)
        if (run := latest_run(runs)) is not None:
            return run
    raise TrialFailed("the experiment did not start", where=str(runs))


def _drain(stream: IO[str] | None, lines: deque[str]) -> None:
    for line in stream or ():
        lines.append(line)


def _joined(run: Path, name: str) -> Scope:
    until_s = time.monotonic() + JOINED_WITHIN_S
    while True:
        try:
            return afspm.connect(run, name)
        except NoResponse:  # on a busy computer the scheduler starts later than one attempt waits
            if time.monotonic() > until_s:
                raise


def await_listener(url: str, within_s: float) -> None:
    """Return once a server accepts connections at the host and port of a URL.

    Raises:
        TrialFailed: no server accepts connections within `within_s` real seconds.
    """
    at, until_s = urlsplit(url), time.monotonic() + within_s
    while True:
        try:
            socket.create_connection((at.hostname or "", at.port or 0), timeout=within_s).close()
        except OSError as error:  # the process of the gateway starts
            if time.monotonic() > until_s:
                raise TrialFailed(f"nothing listens at {url} after {within_s:g} s: {error}") from error
            threading.Event().wait(RETRY_S)
        else:
            return


def _with_agent(
    running: _Running,
    task: BenchTask,
    agent: AgentSpec,
    own: Path,
    started: threading.Event,
    *,
    allowed: _Allowed | None,
    patience_s: float,
) -> str:
    for file, text in task.documents.items():
        (own / file).write_text(text, encoding="utf-8")
    running.scope.wait_until(lambda: running.scope.state is not ScopeState.UNDEFINED, timeout_s=JOINED_WITHIN_S)
    for url in filter(None, (running.url, running.mcp_url)):
        await_listener(url, JOINED_WITHIN_S)
    _approve(running, task)
    with (
        (own / "output.txt").open("w+b") as output,
        _agent_process(running, task, agent, own, output, started, allowed=allowed) as process,
    ):
        if agent.python:
            _await_ready(process, output, patience_s)
        running.began_ns = running.clock.now_ns()
        running.hold.release()
        if process.stdin is not None:
            with contextlib.suppress(OSError):  # it may have ended already
                process.stdin.write(f"{running.began_ns}\n")
                process.stdin.flush()
        code = _followed(process, running, task, patience_s)
    for name in _FINAL:
        value = running.scope.get(name)
        running.final[name] = float(value) if isinstance(value, int | float) else float("nan")
    return "time" if code is None else "failed" if code else "ended"


def _approve(running: _Running, task: BenchTask) -> None:
    if not running.mcp_url:
        return
    facts = running.scope.approval_facts()
    offset_m = facts["offset_m"]
    grant = replace(
        task.grant.for_agent(f"{MCP}:{AGENT}", 60.0 * task.minutes + GRANT_MARGIN_S), run=facts["run"],
        limits=facts["limits"], since_ns=facts["now_ns"], offset_m=() if offset_m is None else tuple(offset_m),
    )  # fmt: skip
    running.scope.approve(grant)


@contextlib.contextmanager
def _agent_process(
    running: _Running,
    task: BenchTask,
    agent: AgentSpec,
    own: Path,
    output: IO[bytes],
    started: threading.Event,
    *,
    allowed: _Allowed | None,
) -> Iterator[subprocess.Popen[str]]:
    command: tuple[str, ...] = agent.command or python_command("afspm_bench.agent_process")
    launch = guest_of(running.run, AGENT)
    plain = {**json.loads(launch.to_json()), "run_dir": "", "state_dir": ""}
    import_from = agent.import_from
    environment = {**os.environ, **python_environment(), "TMPDIR": str(own)}
    if allowed is not None:
        import_from = (str(allowed.modules),)
        if agent.command:
            environment["PYTHONPATH"] = os.pathsep.join([*import_from, *filter(None, [os.environ.get("PYTHONPATH")])])
        readable = tuple(map(str, (allowed.modules, *allowed.files.readable)))
        command = Seal(str(own), readable, MOST_BYTES).command(python_command("afspm_bench.sealing"), command)
    facts = {
        "task": task.name, "prompt": task.full_prompt(), "given": task.given, "documents": dict(task.documents),
        "minutes": task.minutes, "seed": secrets.randbits(31),
    }  # fmt: skip
    if agent.command:
        (own / "task.json").write_text(json.dumps(facts), encoding="utf-8")
        (own / "prompt.txt").write_text(task.full_prompt(), encoding="utf-8")
        environment["AFSPM_BENCH_URL"] = running.url
        if running.mcp_url:
            # without `people` a name is the whole token, and this computer alone is served
            environment |= {"AFSPM_BENCH_MCP_URL": running.mcp_url, "AFSPM_BENCH_MCP_TOKEN": f"{AGENT}:"}
    with contextlib.ExitStack() as kept:
        clock = None
        if allowed is not None and agent.python:
            clock = kept.enter_context(keeping(running.clock)).fileno()
            plain["clock"] = {"speed": running.clock.speed}
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE if agent.python else subprocess.DEVNULL,
            stdout=subprocess.PIPE if agent.python else output, stderr=output, cwd=own, env=environment,
            encoding="utf-8", errors="replace", pass_fds=() if clock is None else (clock,),
        )  # fmt: skip
        started.set()
        # all processes of a sealed agent end with it
        end = process.kill if allowed is None else process.terminate
        try:
            if process.stdin is not None:
                trial = {
                    **facts, "launch": plain, "class": agent.python, "import_from": list(import_from),
                    "sealed": allowed is not None, "kept_clock": clock,
                    "truth_folder": str(running.run) if agent.sees_truth else None,
                }  # fmt: skip
                process.stdin.write(json.dumps(trial) + "\n")
                process.stdin.flush()
            with watched(own, end):
                yield process
        finally:
            end()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(KILLED_WITHIN_S)
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()


def _await_ready(process: subprocess.Popen[str], output: IO[bytes], patience_s: float) -> None:
    said: SimpleQueue[str] = SimpleQueue()
    stdout = process.stdout
    assert stdout is not None
    threading.Thread(target=lambda: said.put(stdout.readline(_LONGEST_LINE)), name="ready", daemon=True).start()
    try:
        line = said.get(timeout=patience_s)
    except Empty:
        raise AgentFailed(f"the agent did not start within {patience_s:g} s") from None
    if line.strip() != "ready":
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_LAST_WORDS_S)  # so that its last words are there
        # by the bench's own descriptor: under the name of the file the agent may have left anything
        output.seek(max(0, output.seek(0, os.SEEK_END) - _LAST_BYTES))
        wrote = output.read(_LAST_BYTES).decode(errors="replace")
        raise AgentFailed(f"the agent ended before its start: {wrote.strip()}")


def _followed(process: subprocess.Popen[str], running: _Running, task: BenchTask, patience_s: float) -> int | None:
    # the person acts in between; None: the agent had to be stopped
    until_s = time.monotonic() + patience_s
    events: Sequence[tuple[float, str]] = (*sorted(task.person), (task.minutes, ""))
    for minutes, mode in events:
        at_ns = running.began_ns + int(minutes * 60e9)
        while (left_s := (at_ns - running.clock.now_ns()) * 1e-9) > 0.0:
            real_s = min(running.clock.real_s(left_s), until_s - time.monotonic())
            if real_s <= 0.0:
                return None
            with contextlib.suppress(subprocess.TimeoutExpired):
                return process.wait(real_s + 1e-3)
        if mode:
            running.scope.set_mode(ControlMode[mode])
            if ControlMode[mode] is ControlMode.AUTOMATED:
                _approve(running, task)  # MANUAL has ended all approvals
    return None


def _judged(task: BenchTask, running: _Running, own: Path) -> tuple[TrialVerdict, Report | None, int]:
    report, why = read_report(own / REPORT_FILE)
    evidence = Evidence(running.run, running.name, report, running.began_ns, running.final)
    with evidence.run:
        verdict = judge(task, evidence)
        end_ns = evidence.run.newest_ns
    if why:
        verdict = replace(verdict, why=(*verdict.why, why))
    return verdict, report, end_ns
