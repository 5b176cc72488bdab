"""Builds and judges the clients in other languages: `make test-clients`, or one of them with CLIENTS=rust.

Each folder in `clients/` has a `conformance.toml`: the programs that it `needs`, the `headers` with their compilers,
what to `install` if they are missing, the commands that `build` and test it, and its conformance `programs`, each of
them judged by `afspm test-client`.
Its `samples` are laid over `experiments/other_language/experiment.toml`, and run.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RUNS = ROOT / "build" / "clients"
SAMPLES = ROOT / "experiments" / "other_language"


def say(line: str) -> None:
    """Print a line at once: programs print between."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main(names: list[str]) -> int:
    """Judge the clients of these names, or all; return how many are not as they should be."""
    files = sorted((ROOT / "clients").glob("*/conformance.toml"))
    unknown = set(names) - {file.parent.name for file in files}
    if unknown:
        say(f"there is no client {', '.join(sorted(unknown))}: {', '.join(file.parent.name for file in files)}")
        return 1
    found = {file.parent.name: judged(file) for file in files if not names or file.parent.name in names}
    say("")
    for name, outcome in found.items():
        say(f"{name:12} {outcome or 'as it should be'}")
    skipped = [outcome for outcome in found.values() if outcome.startswith("SKIPPED")]
    if len(skipped) == len(found):
        say("no client was judged: install what is named above")
        return 0 if os.environ.get("AFSPM_LACKING") == "passes" else len(skipped)
    return sum(bool(outcome) for outcome in found.values()) - len(skipped)


def judged(file: Path) -> str:
    """Build and judge one; return what is wrong, or why it was skipped. Empty if it is as it should be."""
    client, folder = tomllib.loads(file.read_text(encoding="utf-8")), file.parent
    say(f"\n== {folder.name}")
    missing = [program for program in client["needs"] if shutil.which(program) is None]
    if not missing:
        missing = [header for header, compiler in client.get("headers", {}).items() if not has(header, compiler)]
    if missing:
        return f"SKIPPED: there is no {' and no '.join(missing)} on this computer; install {client['install']}"
    for command in client["build"]:
        say(f"$ {' '.join(command)}")
        if subprocess.run(resolved(command), cwd=folder, check=False).returncode:
            return f"not built: {' '.join(command)}"
    wrong = [name for name, command in client["programs"].items() if not passes(name, command, folder)]
    wrong += [file for file in client.get("samples", {}).values() if not runs_to_its_end(file)]
    return f"not as it should be: {', '.join(wrong)}" if wrong else ""


def has(header: str, compiler: str) -> bool:
    """Return whether a compiler finds a header of a library."""
    command = [compiler, "-fsyntax-only", "-include", header, "-x", "c++" if "++" in compiler else "c", os.devnull]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def passes(name: str, command: list[str], folder: Path) -> bool:
    """Judge a conformance program."""
    say(f"\n-- {name}: {' '.join(command)}")
    options = ["--runs", str(RUNS), "--report", str(RUNS / f"{name}.json")]
    return afspm("test-client", *options, "--", *command, folder=folder)


def runs_to_its_end(file: str) -> bool:
    """Run the sample of a client."""
    say(f"\n-- sample {file}")
    return afspm("run", str(SAMPLES / "experiment.toml"), str(SAMPLES / file), "--runs", str(RUNS), "--no-report")


def afspm(*arguments: str, folder: Path = ROOT) -> bool:
    """Run a command of afspm; True if it succeeds."""
    environment = {**os.environ, "PYTHONUTF8": "1"}
    command = [sys.executable, "-m", "afspm", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, check=False).returncode == 0


def resolved(command: list[str]) -> list[str]:
    """Return a command with the whole path of its program, which Windows needs for mvn.cmd."""
    return [shutil.which(command[0]) or command[0], *command[1:]]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
