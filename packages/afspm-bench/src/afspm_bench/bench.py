"""Bench run: trials of several agents in parallel, with one JSON line per trial."""

from __future__ import annotations

import json
import os
import secrets
import shlex
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from afspm.basics import ConfigError, FileError, python_command
from afspm_bench import sealing
from afspm_bench.agent_files import LINES_FILE, AgentFiles
from afspm_bench.agent_folder import remove
from afspm_bench.agents import SEES_TRUTH, SHIPPED
from afspm_bench.cassette import ToolCall, differences, read_calls, write_calls
from afspm_bench.seeds import PUBLIC_KEY, TRIALS, commitment, seed_of
from afspm_bench.tasks import FAMILIES, is_possible, task_names, task_of
from afspm_bench.trial import AgentSpec, TrialFailed, run_trial

KEY_FILE: Final = "key.txt"
Line = dict[str, Any]


@dataclass(frozen=True)
class BenchOptions:
    """Options of a bench.

    Attributes:
        output: folder for the lines, the key and the trials.
        trials: trials of each task.
        sealed_half: draw from the key in `output` (made if missing) instead of the public key.
        seal: seal agents off from the truth, and refuse to run where this is impossible.
        read: files and folders that a sealed agent may read, besides its own modules.
        jobs: number of parallel trials.
        patience_s: real time after which an agent is stopped.
        keep: keep the folders of the trials.
        speed: experiment seconds per real second; None: as each task defines.
        record: cassette to which the calls over MCP of all trials are appended.
        replay: cassette to compare the answers with.
    """

    output: Path
    tasks: Sequence[str]
    trials: int = TRIALS
    sealed_half: bool = False
    seal: bool = True
    read: Sequence[Path] = ()
    jobs: int = 1
    patience_s: float = 300.0
    keep: bool = False
    speed: float | None = None
    record: Path | None = None
    replay: Path | None = None


def agent_named(name: str) -> AgentSpec:
    """Return a shipped agent by name, or an agent class "module:Class", also from the current folder."""
    if name in SHIPPED:
        return AgentSpec(name, SHIPPED[name], sees_truth=name in SEES_TRUTH)
    if ":" not in name:
        raise ConfigError(f"there is no agent {name!r}", hint=f"{', '.join(SHIPPED)}, or a class as module:Class")
    return AgentSpec(name, name, import_from=(str(Path.cwd()),))


def agent_of_command(command: str) -> AgentSpec:
    """Return the agent of a command line. File names in the command are relative to the current folder."""
    words = shlex.split(command)
    if not words:
        raise ConfigError("the command is empty", where="--command")
    program = tuple(str(Path(word).absolute()) if Path(word).is_file() else word for word in words)
    scripts = [Path(word) for word in program if Path(word).is_file() and word.endswith(".py")]
    beside = tuple(dict.fromkeys(str(script.parent) for script in scripts))
    return AgentSpec(Path(program[0]).name, command=program, import_from=beside)


def agent_of_cassette(file: Path) -> AgentSpec:
    """Return an agent that repeats the calls of a cassette."""
    return AgentSpec("replay", command=(*python_command("afspm_bench.cassette"), str(file.resolve())))


def tasks_named(wanted: Sequence[str]) -> list[str]:
    """Return the tasks of the given families and task names; all tasks if none is given. Raises ConfigError."""
    known = task_names()
    for one in wanted:
        if one not in known and one not in FAMILIES:
            raise ConfigError(f"there is no family or task {one!r}", hint=f"{', '.join(FAMILIES)}; `afspm bench tasks`")
    return [name for name in known if not wanted or name in wanted or name.partition("/")[0] in wanted]


def run_bench(agents: Sequence[AgentSpec], options: BenchOptions, tell: Callable[[Line], None]) -> list[Line]:
    """Run all trials and return their lines; also append the lines to `trials.jsonl` in the output folder.

    A trial that ends in an error before its agent was started is tried a second time, after all others: an agent of
    another trial may have disturbed it. If it fails again, its line has an `error`. A later error is a failed trial.

    Raises:
        ConfigError: agents can't be sealed off here, a sealed agent could read the output of a bench, or a cassette
            needs the extra `agent`.
        FileError: the output folder can't be written, its key is malformed, or a file of `read` is missing.
    """
    if (options.record or options.replay) and find_spec("mcp") is None:
        hint = "pip install ./packages/afspm-agents in the folder of the clone"
        raise ConfigError("a cassette holds calls over MCP, which is not installed", hint=hint)
    seal = options.seal and any(not agent.sees_truth for agent in agents)
    if seal and (why := sealing.unavailable()):
        raise ConfigError(
            f"this computer can't seal an agent off from the truth: {why} (Linux 6.2 or later is needed)",
            hint="for development, --unsealed marks the lines as not sealed",
        )
    output, temporary = options.output.resolve(), Path(tempfile.gettempdir()).resolve()
    allowed: dict[str, AgentFiles] = {}
    for agent in agents:
        if seal and not agent.sees_truth:
            files = allowed[agent.name] = AgentFiles(agent.command, agent.import_from, options.read)
            files.require_no_output(output, temporary)
    try:
        output.mkdir(parents=True, exist_ok=True, mode=0o700)
        (output / LINES_FILE).touch()  # at once, since other benches know an output by it
        key = _key(output) if options.sealed_half else PUBLIC_KEY
    except OSError as error:
        raise FileError(f"can't be written: {error}", where=str(output)) from error
    writing, owns = threading.Lock(), Path(tempfile.mkdtemp(prefix="afspm-bench-", dir=temporary))

    def run(agent: AgentSpec, name: str, trial: int, *, again: bool = False) -> Line | None:
        line: Line = {
            "agent": agent.name, "half": "sealed" if options.sealed_half else "public", "commitment": commitment(key),
            "task": name, "family": name.partition("/")[0], "trial": trial,
        }  # fmt: skip
        here = f"{agent.name.replace(':', '.')}-{name.replace('/', '-')}-{trial}-{secrets.token_hex(3)}"
        seed = seed_of(key, name, trial)
        line["twin"] = line["family"] == "restraint" and is_possible(seed)
        try:
            task = task_of(name, seed)
            task = task if options.speed is None else replace(task, speed=options.speed)
            calls: list[ToolCall] | None = [] if options.record or options.replay else None
            outcome = run_trial(
                task, agent, output / "work" / here, owns / here, files=allowed.get(agent.name),
                patience_s=options.patience_s, keep=options.keep, calls=calls,
            )  # fmt: skip
            verdict = outcome.verdict
            line |= {"counts": verdict.counts, **asdict(verdict)}
            line |= {k: v for k, v in asdict(outcome).items() if k != "verdict"}
            if options.record is not None and calls is not None:
                with writing:
                    write_calls(options.record, calls)
                line["recorded"] = len(calls)
            if options.replay is not None and calls is not None:
                found = differences(read_calls(options.replay, task.full_prompt()), calls)
                line["differences"] = [asdict(one) for one in found]
        except TrialFailed as error:  # the other trials go on; the page lists this trial apart
            if options.jobs > 1 and not again:
                return None
            line["error"] = str(error)
        with writing, (output / LINES_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, default=float) + "\n")
        tell(line)
        return line

    todo = [(agent, name, trial) for agent in agents for name in options.tasks for trial in range(options.trials)]
    try:
        with ThreadPoolExecutor(max(1, options.jobs)) as pool:
            lines = list(pool.map(lambda one: run(*one), todo))
        found = [line or run(*one, again=True) for line, one in zip(lines, todo, strict=True)]
        return [line for line in found if line is not None]
    finally:
        if not options.keep:
            remove(owns)
            remove(output / "work")


def default_jobs() -> int:
    """Return the default number of parallel trials: half the number of processors, at least 1."""
    return max(1, (os.cpu_count() or 1) // 2)


def _key(output: Path) -> bytes:
    file = output / KEY_FILE
    if not file.exists():
        file.touch(mode=0o600)
        file.write_text(secrets.token_hex(32) + "\n", encoding="ascii")
    try:
        return bytes.fromhex(file.read_text(encoding="ascii").strip())
    except ValueError as error:
        raise FileError(f"is no key in hexadecimal: {error}", where=str(file)) from error


def read_lines(paths: Sequence[Path]) -> list[Line]:
    """Return the lines of trials in files, or in output folders of benches. Raises FileError."""
    found: list[Line] = []
    for path in paths:
        file = path / LINES_FILE if path.is_dir() else path
        try:
            found += [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
        except (OSError, ValueError) as error:
            raise FileError(f"can't be read: {error}", where=str(file)) from error
    return found
