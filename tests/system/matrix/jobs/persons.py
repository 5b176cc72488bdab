"""Persons in the laboratory: they end a run, spoil a gain, and look at the page."""

import base64
import json
import time
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

from afspm import Component
from afspm.model import ControlEvent, JournalEntries, Problem

WITHIN_S = 60.0  # real


class Goodnight(Component):
    """A person who ends the experiment when a component flags a problem, since nothing measures after it."""

    listens = ("JournalEntries",)

    def __init__(self, problem: str) -> None:
        self.problem = problem

    def on_message(self, envelope: str, message: object) -> None:
        assert isinstance(message, JournalEntries)
        number = self.scope.problems.number(self.problem)
        flags = [one for one in message.entries if one.event is ControlEvent.PROBLEM_FLAGGED and one.problem == number]
        if any(one.who != "translator" for one in flags):  # which looks for a controller that starts, and clears it
            self.scope.end_experiment()


class Spoiler(Component):
    """A person who sets the integral gain to a hundredth after two scans, and leaves two scans after it is tuned."""

    flags = ("tip-shape-changed",)
    solves = ("tip-shape-changed",)

    def run(self) -> None:
        self._scans(2)
        self.scope.flag(Problem.TIP_SHAPE_CHANGED)  # only a problem takes control from a series at once
        with self.scope.control(solving=Problem.TIP_SHAPE_CHANGED):
            feedback = self.scope.feedback
            assert feedback is not None
            assert feedback.integral_gain is not None
            self.scope.set_feedback(integral_gain=feedback.integral_gain / 100.0)
            self.scope.clear(Problem.TIP_SHAPE_CHANGED)
        self.scope.wait_until(lambda: self.scope.is_flagged(Problem.FEEDBACK_NON_OPTIMAL))
        self.scope.wait_until(lambda: not self.scope.is_flagged(Problem.FEEDBACK_NON_OPTIMAL))
        self._scans(2)
        self.scope.end_experiment()

    def _scans(self, count: int) -> None:
        ends = set[int]()
        for event in self.scope.events("Scan2d"):
            ends.add(event.message.time_ns)
            if len(ends) >= count:
                return


class Onlooker(Component):
    """A person who looks at the page and asks the gateway for each scan of a series, and then ends the experiment."""

    listens = ("Scan2d",)
    longest_step_s = 2 * WITHIN_S

    def __init__(self, scans: int) -> None:
        self.scans = scans

    def run(self) -> None:
        gateway, dashboard = self._url("gateway"), self._url("dashboard")
        until_s = time.monotonic() + WITHIN_S
        # a controller's channels come one by one, so the newest scan may lack the one to look at
        while len(known := self._known(gateway)) < self.scans and time.monotonic() < until_s:
            self.scope.sleep(1.0)
        seen = [self._look(gateway, dashboard, one, channel) for one, channel in known]
        (Path(self.run_dir) / "seen.json").write_text(json.dumps(seen), encoding="utf-8")
        self.scope.end_experiment()

    def _known(self, gateway: str) -> list[tuple[dict[str, Any], str]]:
        roles = self.scope.channels.names
        shown = roles.get("height") or roles["intensity"]
        scans = json.loads(_get(f"{gateway}/v1/scans"))
        channels = [next((one["name"] for one in scan["channels"] if one["name"] in shown), "") for scan in scans]
        return [known for known in zip(scans, channels, strict=True) if known[1]]

    def _look(self, gateway: str, dashboard: str, scan: dict[str, Any], channel: str) -> dict[str, str]:
        asked = urllib.parse.urlencode({"time": scan["id"], "channel": channel})
        found = {
            "values": f"{gateway}/v1/scans/{scan['id']}/values?channel={urllib.parse.quote(channel)}",
            "picture": f"{dashboard}/live/image?{asked}",
        }
        return {name: base64.b64encode(_get(url)).decode() for name, url in found.items()} | {"channel": channel}

    def _url(self, of: str) -> str:
        file = Path(self.run_dir) / "state" / f"{of}.json"
        until_s = time.monotonic() + WITHIN_S
        while not (file.exists() and "url" in (known := json.loads(file.read_text(encoding="utf-8")))):
            if time.monotonic() > until_s:
                raise RuntimeError(f"the {of} did not start")
            self.scope.sleep(1.0)
        return str(known["url"])


def _get(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=WITHIN_S) as answer:
        found: bytes = answer.read()
        return found
