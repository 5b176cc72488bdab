"""`afspm` as a process of its own, with functions that wait for its output."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from pathlib import Path

from deadlines import DEADLINE_S
from systems import freeze, kill

AFSPM = (sys.executable, "-P", "-c", "from afspm.cli import main; main()")


class AfspmProcess:
    """A running `afspm` command, in its own process group, so that a Ctrl-C for it does not reach the tests."""

    def __init__(self, *arguments: str, folder: Path) -> None:
        self.process = subprocess.Popen(
            (*AFSPM, *arguments),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            cwd=folder,
        )
        self.lines: list[str] = []
        self._changed = threading.Condition()
        self._over = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as pipe:
            for line in pipe:
                with self._changed:
                    self.lines.append(line.decode(errors="replace").rstrip())
                    self._changed.notify_all()
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def said(self, *wanted: str) -> list[str]:
        """Return the lines so far that match all the patterns `wanted`."""
        return [line for line in self.lines if all(re.search(text, line) for text in wanted)]

    def wait_for(self, *wanted: str, count: int = 1) -> str:
        """Return the `count`-th line that matches all the patterns `wanted`."""
        with self._changed:
            self._changed.wait_for(lambda: len(self.said(*wanted)) >= count or self._over, DEADLINE_S)
            if len(found := self.said(*wanted)) < count:
                raise AssertionError(f"no line with {wanted} came:\n{self.output}")
            return found[count - 1]

    def read_to_the_end(self) -> str:
        """Return all that the command has written, once it has ended."""
        assert self.process.wait(DEADLINE_S) == 0, self.output
        self._reader.join(DEADLINE_S)
        return self.output

    def wait_for_next(self, *wanted: str) -> str:
        """Return the next such line after the present ones."""
        with self._changed:
            already = len(self.said(*wanted))
        return self.wait_for(*wanted, count=already + 1)

    @property
    def output(self) -> str:
        return "\n".join(self.lines)

    @property
    def folder(self) -> Path:
        return Path(self.wait_for("processes, into ").split(", into ")[1])

    def wait_for_url(self, what: str) -> str:
        """Return the printed address of the dashboard or the gateway."""
        (url,) = re.findall(r"https?://[^\s;]+", self.wait_for(f"the {what} is at "))
        return str(url)

    def pid(self, name: str) -> int:
        """Return the process id of the component's newest process."""
        self.wait_for(rf" {name} .*started, process")
        return int(self.said(rf" {name} .*started, process")[-1].rsplit(" ", 1)[1])

    def wait_up(self, name: str, times: int) -> None:
        """Wait until the component has started `times` times."""
        self.wait_for(rf" {name} .*is up$", count=times)

    def kill(self, name: str) -> None:
        """Kill the component's process."""
        kill(self.pid(name))

    def freeze(self, name: str) -> None:
        """Suspend the component's process."""
        freeze(self.pid(name))

    def end(self) -> int:
        """Wait for its end without a signal; return the exit code."""
        try:
            code = self.process.wait(DEADLINE_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"the run did not end:\n{self.output}") from None
        self._reader.join(DEADLINE_S)
        return code

    def close(self) -> None:
        """Kill it; its processes end with it."""
        self.process.kill()
        self.process.wait()
        self._reader.join(DEADLINE_S)
