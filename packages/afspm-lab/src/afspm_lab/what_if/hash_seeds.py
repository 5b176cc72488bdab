"""Replays in processes of their own, twice under one of Python's hash seeds and once under another.

If equal seeds differ, the component depends on its process; if only another seed differs, on the order of a set.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import zlib
from pathlib import Path

from afspm import open_run
from afspm.client import port_log
from afspm_lab.what_if import component_replay
from afspm_lab.what_if.port_replay import read_lives

_SEEDS = ("1", "1", "2")
_WITHIN_S = 600.0
_log = logging.getLogger("afspm.what_if")


def hazards(run: Path, name: str) -> list[str]:
    """Return a description if the outputs of an unchanged component depend on its process or on the hash seed.

    Empty if they do not, or if a replay fails.
    """
    command = [sys.executable, "-P", "-c", f"from {__name__} import main; main()", str(run), name]
    # the same modules as here; "" means the current folder, from which nothing else is imported
    path = os.pathsep.join(one or str(Path.cwd()) for one in sys.path)
    lines = []
    for seed in _SEEDS:
        try:
            done = subprocess.run(
                command,
                env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": path},
                capture_output=True,
                text=True,
                timeout=_WITHIN_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            _log.warning("%s was not replayed within %g s, to look for an order of sets", name, _WITHIN_S)
            return []
        if done.returncode:
            why = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            _log.warning(
                "%s could not be replayed in a process of its own, to look for an order of sets: %s", name, why
            )
            return []
        lines.append(done.stdout.splitlines())
    first, again, other = lines
    if first != again:
        what = "on its process, as by id() or os.getpid(): two processes give other outputs"
        return [f"depends {what}, first its output {_first_difference(first, again)}"]
    if first != other:
        what = "on the order of a set: two hash seeds give other outputs"
        return [f"depends {what}, first its output {_first_difference(first, other)}"]
    return []


def _first_difference(one: list[str], other: list[str]) -> int:
    differing = (number for number, pair in enumerate(zip(one, other, strict=False), 1) if pair[0] != pair[1])
    return next(differing, min(len(one), len(other)) + 1)


def main() -> None:
    """Print one line for each replayed output of a component."""
    run, name = sys.argv[1:]
    with open_run(run) as record:
        lives = read_lives(port_log.log_path(record.folder, name))
        made = component_replay.replay(lives, record.packet_lookup(), record.folder)
    for one in made.now:
        value = one.value if isinstance(one.value, bytes) else one.value.encode()
        sys.stdout.write(f"{one.message} {one.key} {zlib.crc32(value)} {one.packet} {one.life}\n")
