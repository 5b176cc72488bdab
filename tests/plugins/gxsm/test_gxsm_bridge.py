"""Attacks on the bridge from outside: by programs without its secret, and by slow ones."""

from __future__ import annotations

import ast
import json
import re
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
from deadlines import DEADLINE_S
from tests.plugins.gxsm.raw_clients import SocketClient

from afspm.driver import ControllerLost
from afspm.plugins.gxsm import bridge
from afspm.plugins.gxsm.bridge_client import BridgeLink

PROVES_S = 5.0


class Gxsm:
    """The part of the module `gxsm` that the bridge needs."""

    wanted = 1.0

    def get(self, ref: str) -> float:
        return self.wanted if ref == "script-control" else 400.0

    def get_slice(self, *_: int) -> np.ndarray:
        return np.zeros((1 << 13, 1 << 10))


@pytest.fixture
def serving(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], str]]:
    """Run bridges until the end of the test; deadlines of clients leave a busy computer time."""
    gxsm = Gxsm()
    for name, value in {"gxsm": gxsm, "PROVES_S": PROVES_S, "TAKES_S": DEADLINE_S, "LOOK_S": 0.02}.items():
        monkeypatch.setattr(bridge, name, value)
    threads, listeners = [], []

    def serve() -> str:
        listener = socket.create_server(("127.0.0.1", 0))
        served = bridge.Bridge(listener, bridge.secret())
        thread = Thread(target=served.serve)
        thread.start()
        threads.append((thread, served))
        listeners.append(listener)
        return "{}:{}".format(*listener.getsockname())

    yield serve
    gxsm.wanted = 0.0
    for thread, served in threads:
        thread.join()
        served.close()
    for listener in listeners:
        listener.close()


def connected(address: str) -> socket.socket:
    host, _, port = address.rpartition(":")
    return socket.create_connection((host, int(port)), DEADLINE_S)


def link(address: str) -> BridgeLink:
    host, _, port = address.rpartition(":")
    return BridgeLink((host, int(port)), DEADLINE_S, time.monotonic)


@contextmanager
def listening_in_its_place(answer: Callable[[bytes], bytes]) -> Iterator[tuple[str, bytearray]]:
    """Another user's program in place of the bridge; collects all received bytes."""
    received = bytearray()

    def listen(listener: socket.socket) -> None:
        client, _ = listener.accept()
        with client, client.makefile("rb") as lines, suppress(OSError):
            for line in lines:
                received.extend(line)
                client.sendall(answer(line))

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = Thread(target=listen, args=(listener,))
        thread.start()
        yield "{}:{}".format(*listener.getsockname()), received
        thread.join()


def test_listener_in_place_of_the_bridge_learns_nothing_useful(serving: Callable[[], str]) -> None:
    # Neither the secret, nor a line that the bridge would accept as a client's proof.
    address = serving()
    secret = bridge.secret()
    reply = json.dumps({"value": ["0" * 64, "1" * 64]}).encode() + b"\n"
    with (
        listening_in_its_place(lambda line: reply) as (fake, received),
        pytest.raises(ControllerLost, match="not know"),
    ):
        link(fake).call("get", "RangeX")
    assert secret not in received
    assert received.count(b"\n") == 1, "nothing after the challenge"
    with connected(address) as stranger, stranger.makefile("rb") as replies:
        stranger.sendall(bytes(received))
        assert len(json.loads(replies.readline())["value"]) == 2
        stranger.sendall(bytes(received) + b'["get", "RangeX"]\n')
        assert replies.readline() == b""


def test_a_program_between_client_and_bridge_is_refused(serving: Callable[[], str]) -> None:
    # A relay passes on every line, in order to call GXSM itself afterwards.
    with connected(serving()) as real, real.makefile("rb") as replies:

        def pass_on(line: bytes) -> bytes:
            real.sendall(line)
            return replies.readline()

        with listening_in_its_place(pass_on) as (fake, _), pytest.raises(ControllerLost, match="does not know") as lost:
            link(fake).call("get", "RangeX")
        assert "a tunnel needs the bridge's port number at both ends" in str(lost.value), "what it may be, too"
        real.sendall(b'["get", "RangeX"]\n')
        assert replies.readline() == b""


def test_a_proof_holds_for_one_connection_only(serving: Callable[[], str]) -> None:
    address = serving()
    nonce = "0" * 64
    with connected(address) as first, first.makefile("rb") as replies:
        first.sendall(json.dumps(["challenge", nonce]).encode() + b"\n")
        theirs, _ = json.loads(replies.readline())["value"]
        proof = bridge.proof(bridge.secret(), "client", address, nonce, theirs)
        response = json.dumps(["response", proof]).encode() + b"\n"
        first.sendall(response)
        assert json.loads(replies.readline()) == {"value": bridge.WELCOME}
    with connected(address) as again, again.makefile("rb") as replies:
        again.sendall(json.dumps(["challenge", nonce]).encode() + b"\n")
        replies.readline()
        again.sendall(response)
        assert replies.readline() == b""


def test_client_that_dribbles_its_first_line_is_dropped_without_blocking_others(serving: Callable[[], str]) -> None:
    address = serving()
    pace = Event()
    with connected(address) as slow:
        slow.sendall(b"[")
        client = SocketClient(address)
        assert client.call("get", "RangeX") == 400.0, "served meanwhile"
        until_s = time.monotonic() + DEADLINE_S
        with suppress(ConnectionError):
            while time.monotonic() < until_s:
                slow.sendall(b" ")
                pace.wait(PROVES_S / 10)
        assert time.monotonic() < until_s, "dropped, though it goes on sending"
        assert client.call("get", "RangeX") == 400.0, "which is not asked for proofs again"
        client.close()


def test_client_that_reads_no_answer_does_not_block_another(serving: Callable[[], str]) -> None:
    address = serving()
    one, other = SocketClient(address), SocketClient(address)
    one.send(b'["get_slice", 0, 0, 0, 0, 8192]\n')
    assert other.call("get", "RangeX") == 400.0
    assert one.reply().shape == (1 << 13, 1 << 10), "all of it is there when it is taken"
    one.close()
    other.close()


def test_strangers_leave_room_for_clients(serving: Callable[[], str]) -> None:
    address = serving()
    strangers = [connected(address) for _ in range(2 * bridge.MOST_STRANGERS)]
    client = SocketClient(address)
    assert client.call("get", "RangeX") == 400.0
    client.close()
    for stranger in strangers:
        stranger.close()


def test_one_client_too_many_is_refused_with_a_reason(serving: Callable[[], str]) -> None:
    address = serving()
    clients = [SocketClient(address) for _ in range(bridge.MOST_CLIENTS)]
    with pytest.raises(ControllerLost, match="the bridge serves 8 clients already") as refused:
        link(address).call("get", "RangeX")
    assert "bridge.py" not in str(refused.value), "another bridge would not help"
    assert [client.call("get", "RangeX") for client in clients] == [400.0] * len(clients)
    for client in clients:
        client.close()


def test_silent_client_is_replaced_by_a_new_one(serving: Callable[[], str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridge, "TAKES_S", 0.0)
    address = serving()
    clients = [SocketClient(address) for _ in range(bridge.MOST_CLIENTS + 1)]
    assert clients[-1].call("get", "RangeX") == 400.0
    assert clients[0].sent_away(b'["get", "RangeX"]\n')
    for client in clients:
        client.close()


def test_the_readme_describes_the_proofs_of_the_bridge() -> None:
    readme = (Path(bridge.__file__).parent / "README.md").read_text(encoding="utf-8")
    for words in ("HMAC-SHA256", '["challenge", nonce]', '["response", proof]', bridge.WELCOME):
        assert words in readme


def test_script_runs_with_the_standard_library_only() -> None:
    # Neither another package, nor a newer Python than on systems with Gxsm3.
    tree = ast.parse(Path(bridge.__file__).read_text(encoding="utf-8"), feature_version=(3, 8))
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imported |= {one.name for node in ast.walk(tree) if isinstance(node, ast.Import) for one in node.names}
    assert {str(name) for name in imported} <= sys.stdlib_module_names | {"gxsm"}


def test_messages_that_the_readme_explains_are_in_the_code() -> None:
    folder = Path(bridge.__file__).parent
    traps = (folder / "README.md").read_text(encoding="utf-8").partition("## Traps")[2].partition("\n## ")[0]
    code = "\n".join(file.read_text(encoding="utf-8") for file in sorted(folder.glob("*.py")))
    code += (folder.parents[1] / "translator" / "tcp.py").read_text(encoding="utf-8")
    strings = [node.value for node in ast.walk(ast.parse(code.replace("from __future__ import annotations", "")))
               if isinstance(node, ast.Constant) and isinstance(node.value, str)]  # fmt: skip
    written = "\0".join(strings)
    quoted = re.findall(r"\*\*`(.*?)`\*\*", traps)
    assert len(quoted) > 10
    for message in quoted:
        for part in re.split(r"…|'400,0 Å'|Xp-|folder \. ", message):
            assert part.strip() in written, message
