"""`afspm doctor` on one of four hosts names what is wrong with the network, the keys, or the other hosts."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tests.system.hosts.hosts_lab import AFSPM, TILERS, HostsLab
from tests.system.hosts.namespaced_host import interrupt

from afspm.transport.keys import generate

Lab = Callable[..., HostsLab]


def doctor(hosts: HostsLab, name: str) -> tuple[int, dict[str, Any]]:
    """Return the exit code, and what was said in JSON."""
    told = hosts.hosts[name].run(*AFSPM, "doctor", "experiment.toml", "--json", "--listen", "1")
    assert told.stdout, told.stderr
    return told.returncode, json.loads(told.stdout)


def codes(hosts: HostsLab, name: str = "left") -> set[str]:
    """Return the codes of what is not fine."""
    return {one["code"] for one in doctor(hosts, name)[1]["found"] if one["severity"] != "fine"}


@contextmanager
def removed(hosts: HostsLab, name: str) -> Iterator[None]:
    """Leave a key out of those of `left` while in the block."""
    file = hosts.folder / "left" / "keys" / name
    shutil.move(file, file.with_suffix(".away"))
    yield
    shutil.move(file.with_suffix(".away"), file)


def test_each_fault_is_named(lab: Lab) -> None:
    hosts = lab(scans=1000, clocks_ahead_s={"right": 3600.0})
    assert codes(hosts) == {"refused"}  # nothing has been started
    hosts.start()
    hosts.wait(lambda: min(map(hosts.tiles, TILERS)) >= 1, "scans")

    code, told = doctor(hosts, "left")
    assert (code, codes(hosts)) == (0, set()), told
    assert any(one["envelope"].startswith("Scan2d") and one["rate_hz"] > 0 for one in told["heard"])
    assert codes(hosts, "right") == {"clock"}

    with hosts.network.cut(("left", "sched")):
        assert codes(hosts) == {"silent"}
    keys = hosts.folder / "left" / "keys"
    (keys / "private" / "left.key_secret").chmod(0o644)
    assert codes(hosts) == {"key-file"}
    (keys / "private" / "left.key_secret").chmod(0o600)
    with removed(hosts, "public/scheduler.key"):
        assert "key-missing" in codes(hosts)
        generate(hosts.folder / "other", ["scheduler"])
        shutil.copy2(hosts.folder / "other" / "public" / "scheduler.key", keys / "public")
        assert "key-mismatch" in codes(hosts)
    with removed(hosts, "public/supervisor.key"), removed(hosts, "private/supervisor.key_secret"):
        generate(keys, ["supervisor"])  # which the scheduler does not know
        assert "key-unknown" in codes(hosts)
    hosts.hosts["left"].resolve({"left": hosts.known["left"], "micro": hosts.known["micro"]})
    assert "unknown-name" in codes(hosts)
    hosts.hosts["left"].resolve(hosts.known)
    hosts.hosts["micro"].lose_power()
    assert codes(hosts) == {"silent"}


SERVER = """
import socket
server = socket.create_server(("", 29001))
print("up", flush=True)
while True:
    server.accept()[0].send(b"HTTP")
"""


def test_a_port_that_another_program_has_is_named(lab: Lab) -> None:
    hosts = lab()
    with hosts.hosts["sched"].popen(["python3", "-c", SERVER]) as other:
        assert other.stdout is not None
        other.stdout.readline()
        assert "other-program" in codes(hosts, "sched")
        assert "other-program" in codes(hosts, "left")
        interrupt(other)
