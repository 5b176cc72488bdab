"""Notifications of people outside the experiment, by a command or a webhook."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

from afspm.basics import utc_time
from afspm.basics.errors import AfspmError, ConfigError

END: Final = "end"
UNSOLVED: Final = "unsolved-problem"
GIVEN_UP: Final = "given-up"
CRITICAL: Final = "critical"
BY_HAND: Final = "by-hand"
SOLVED: Final = "solved"
TEST: Final = "test"
"""Occasion of a test message."""
USUAL: Final = (END, UNSOLVED, GIVEN_UP, CRITICAL, BY_HAND)
"""The occasions without the key `on`."""
OCCASIONS: Final = (*USUAL, SOLVED)

TIMEOUT_S = 10.0  # of one attempt
FIRST_DELAY_S, LONGEST_DELAY_S = 2.0, 300.0  # between tries; each is twice the one before
MOST_TRIES = 12  # about 25 minutes, with the delays between them
# a webhook that is down all night must not fill the memory
MOST_WAITING = 50

Way = Literal["command", "webhook"]


class NotDelivered(AfspmError):
    """The error that a notification could not be delivered; the delivery may be retried."""


@dataclass(frozen=True)
class Notification:
    """A notification for people.

    Attributes:
        what: one of OCCASIONS, or TEST.
        experiment: name of the experiment.
        run: folder of the run.
        time_ns: experiment time.
        text: a sentence.
        simulated: whether the microscope is simulated.
    """

    what: str
    experiment: str
    run: str
    time_ns: int
    text: str
    simulated: bool = False

    def body(self) -> bytes:
        """Return the notification as JSON: what, experiment, run, time (ISO 8601, UTC), text, simulated."""
        time = utc_time(self.time_ns).isoformat()
        fields = {**asdict(self), "time": time}
        del fields["time_ns"]
        return json.dumps(fields, ensure_ascii=False).encode()


@dataclass(frozen=True)
class Targets:
    """The command and the webhook that get the notifications.

    Attributes:
        command: program and arguments; it gets the JSON on its standard input.
        webhook: address for a POST of the JSON, or "$NAME" of the environment variable that holds it. The address may
            be a secret: logs name only its host.
        folder: working directory of the command.
        timeout_s: limit of one attempt of the command.
    """

    command: Sequence[str] = ()
    webhook: str = ""
    folder: str = ""
    timeout_s: float = TIMEOUT_S

    @property
    def ways(self) -> tuple[Way, ...]:
        """The ways of delivery that have a target."""
        known: tuple[tuple[Way, object], ...] = (("command", self.command), ("webhook", self.webhook))
        return tuple(way for way, target in known if target)

    def deliver(self, notice: Notification, way: Way) -> None:
        """Deliver a notification, in one attempt.

        Raises:
            NotDelivered: the attempt failed; the error contains no secret.
            ConfigError: the address of the webhook is invalid, or its environment variable is not set.
        """
        if way == "command":
            _run(self.command, notice, self.folder, self.timeout_s)
        else:
            _post(address(self.webhook), notice)


def address(webhook: str, environment: Mapping[str, str] = os.environ, *, key: str = "webhook") -> str:
    """Return the address of a webhook or a ping, looked up in the environment for "$NAME".

    Args:
        key: the key in [notify] that holds the address.

    Raises:
        ConfigError: the environment variable is not set, or holds no address; the error contains no secret.
    """
    from urllib.parse import urlsplit

    where = f"[notify] {key}"
    # the experiment file is copied into each run folder, which is passed on: a secret belongs in the environment
    if webhook.startswith("$"):
        name = webhook[1:]
        where = f"{where} = {webhook!r}"
        webhook = environment.get(name, "")
        if not webhook:
            raise ConfigError(f"there is no environment variable {name!r}", where=where, hint="set it before the run")
    try:
        parts = urlsplit(webhook)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.username is None
    except ValueError:
        valid = False
    if not valid:
        raise ConfigError("it is not an address", where=where, hint='as in "https://chat.example.org/hooks/night"')
    return webhook


def _run(command: Sequence[str], notice: Notification, folder: str, timeout_s: float) -> None:
    program = Path(command[0]).name  # its arguments may hold a secret
    environment = {**os.environ, "AFSPM_WHAT": notice.what, "AFSPM_TEXT": notice.text, "AFSPM_RUN": notice.run}
    try:
        done = subprocess.run(
            list(command),
            input=notice.body(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=timeout_s,
            env=environment,
            cwd=folder or None,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise NotDelivered(f"{program} took longer than {timeout_s:g} s and was ended") from None
    except OSError as error:
        raise NotDelivered(f"{program} can't be run: {error.strerror or type(error).__name__}") from None
    if done.returncode:
        output = done.stderr.decode(errors="replace").strip().splitlines()
        raise NotDelivered(f"{program} ended with {done.returncode}{f': {output[-1][:200]}' if output else ''}")


def ping(url: str) -> None:
    """Send a bare GET request: it holds the address and the name afspm, and nothing of the experiment.

    Raises:
        NotDelivered: no success within `TIMEOUT_S`; the error contains no secret.
    """
    _request(url, None, {"User-Agent": "afspm"})


def _post(url: str, notice: Notification) -> None:
    headers = {"Content-Type": "application/json; charset=utf-8", "User-Agent": "afspm"}
    _request(url, notice.body(), headers)


def _request(url: str, body: bytes | None, headers: dict[str, str]) -> None:
    from http.client import HTTPException
    from urllib.error import HTTPError, URLError
    from urllib.parse import urlsplit
    from urllib.request import HTTPRedirectHandler, Request, build_opener

    class NoRedirect(HTTPRedirectHandler):
        """A redirect is an error: urllib would follow it by a GET, which leaves the message behind."""

        def redirect_request(self, *_: object) -> None:
            return None

    host = urlsplit(url).hostname
    try:
        request = Request(url, body, headers, method="GET" if body is None else "POST")
        with build_opener(NoRedirect).open(request, timeout=TIMEOUT_S) as answer:
            answer.read(1000)
    except HTTPError as error:
        error.close()
        moved = ", and leads to another address: is it https instead of http?" if 300 <= error.code < 400 else ""
        raise NotDelivered(f"{host} answers {error.code}{moved}") from None
    except URLError as error:
        raise NotDelivered(f"{host} can't be reached: {_reason_without_secret(error.reason)}") from None
    except (OSError, HTTPException, ValueError) as error:
        raise NotDelivered(f"{host} can't be reached: {_reason_without_secret(error)}") from None


def _reason_without_secret(reason: object) -> str:
    # the text of the error may hold the address of the webhook, which is a secret
    if isinstance(reason, OSError):
        return reason.strerror or type(reason).__name__
    return type(reason).__name__


def delay_s(tries: int) -> float:
    """Return the delay after a number of failed attempts, in seconds of real time."""
    return float(min(LONGEST_DELAY_S, FIRST_DELAY_S * 2 ** max(0, tries - 1)))
