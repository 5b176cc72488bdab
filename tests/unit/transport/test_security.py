"""Accepted peers: this computer, or the owners of keys."""

from __future__ import annotations

import stat
import sys
from pathlib import Path
from typing import Any

import pytest
import zmq
from zmq.auth import load_certificate
from zmq.utils import z85

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError, TransportError
from afspm.transport import keys
from afspm.transport.keys import Authenticator
from afspm.transport.network import Network, is_local
from afspm.transport.port import CaughtUp, ControlConnected, PacketReceived, RequestReceived
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort

ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:1", "tcp://localhost:1", "tcp://[::1]:1", "ipc:///tmp/a", "inproc://a"]
)
def test_addresses_of_this_computer(address: str) -> None:
    assert is_local(address)


@pytest.mark.parametrize(
    "address",
    ["tcp://*:1", "tcp://0.0.0.0:1", "tcp://192.168.0.2:1", "tcp://spm.example.org:1", "tcp://localhost.evil.org:1",
     "tcp://eth0:1", "epgm://239.0.0.1:1", "tcp://192.168.0.2:1;127.0.0.1:1", "nonsense", ""],
)  # fmt: skip
def test_addresses_that_are_not_for_this_computer_only_are_refused_without_keys(open_: Any, address: str) -> None:
    assert not is_local(address)
    network = open_(Network())
    for use in (network.bind, network.connect):
        with pytest.raises(ConfigError, match="no keys") as refused:
            use(network.socket(zmq.PUB), address)
        assert "insecure" in refused.value.hint


def test_insecure_must_be_set_explicitly(open_: Any) -> None:
    network = open_(Network.from_launch("A", {"insecure": "true"}))
    assert network.bind(network.socket(zmq.PUB), "tcp://0.0.0.0:0").startswith("tcp://0.0.0.0:")
    assert open_(Network.from_launch("A", None)).keys is None


def test_taken_port_is_reported(open_: Any) -> None:
    network = open_(Network())
    address = network.bind(network.socket(zmq.PUB), ANY)
    with pytest.raises(TransportError, match="can't bind") as refused:
        network.bind(network.socket(zmq.PUB), address)
    assert "another program" in refused.value.hint
    assert str(refused.value).count(address) == 1


def test_address_of_another_computer_is_reported(open_: Any) -> None:
    network = open_(Network(insecure=True))
    with pytest.raises(TransportError, match="can't bind") as refused:
        network.bind(network.socket(zmq.PUB), "tcp://192.0.2.1:0")  # kept for documents: nobody has it
    assert "does not have this address" in refused.value.hint


def test_generated_keys_are_kept_and_secrets_are_for_the_owner_only(tmp_path: Path) -> None:
    written = keys.generate(tmp_path, ["Experiment", "Tip Corrector"])
    assert {file.name for file in written} == {
        "Experiment.key", "Experiment.key_secret", "Tip Corrector.key", "Tip Corrector.key_secret",
    }  # fmt: skip
    before = keys.load(tmp_path, "Experiment")
    assert [f.name for f in keys.generate(tmp_path, ["Experiment", "New"])] == ["New.key_secret", "New.key"]
    assert keys.load(tmp_path, "Experiment").secret == before.secret
    assert before.peers[before.public] == "Experiment"
    if sys.platform != "win32":
        secret = tmp_path / "private" / "Experiment.key_secret"
        assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert before.secret.decode() not in repr(before)


def test_the_public_key_of_a_process_elsewhere_is_left_alone(tmp_path: Path) -> None:
    keys.generate(tmp_path, ["here", "elsewhere"])
    (tmp_path / "private" / "elsewhere.key_secret").unlink()  # as on the computer that public/ was copied to
    before = keys.public_keys(tmp_path, "here")
    assert [file.name for file in keys.generate(tmp_path, ["here", "elsewhere", "new"])] == [
        "new.key_secret",
        "new.key",
    ]
    assert before.items() <= keys.public_keys(tmp_path, "here").items()
    with pytest.raises(ConfigError, match="only the public one"):
        keys.load(tmp_path, "elsewhere")


def test_lost_public_key_is_restored(tmp_path: Path) -> None:
    keys.generate(tmp_path, ["A"])
    before = keys.load(tmp_path, "A")
    (tmp_path / "public" / "A.key").unlink()
    assert [file.name for file in keys.generate(tmp_path, ["A"])] == ["A.key"]
    assert keys.load(tmp_path, "A") == before


@pytest.mark.parametrize("name", ["../evil", "", "a/b", ".hidden", "x" * 200])
def test_name_that_is_not_valid_for_a_file_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError):
        keys.generate(tmp_path, [name])


def test_missing_and_broken_keys_are_distinguished(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can't be read"):
        keys.load(tmp_path, "Nobody")
    keys.generate(tmp_path, ["A"])
    (tmp_path / "private" / "A.key_secret").write_text("nonsense")
    with pytest.raises(ConfigError, match="no public key"):
        keys.load(tmp_path, "A")


def locked_server(folder: Path) -> ZmqServerPort:
    own = keys.load(folder, "translator")
    return ZmqServerPort(Network(own), CLOCK, serve=ANY, publish=ANY, allowed="scheduler")


def locked_component(folder: Path, name: str, server: ZmqServerPort, claimed: str = "") -> ZmqPort:
    assert server.publish_address is not None
    servers = {server.serve_address: "translator", server.publish_address: "translator"}
    network = Network(keys.load(folder, name, servers))
    return ZmqPort(network, claimed or name, CLOCK, subscribe=[server.publish_address], control=server.serve_address)


def test_with_keys_the_server_knows_the_sender_and_packets_arrive(tmp_path: Path, open_: Any, until: Any) -> None:
    keys.generate(tmp_path, ["translator", "scheduler"])
    server = open_(locked_server(tmp_path))
    server.publish("Scan2d", b"scan")
    port = open_(locked_component(tmp_path, "scheduler", server, claimed="whatever it says"))
    found, asked = [], []  # type: ignore[var-annotated]
    until(
        lambda: ControlConnected() in found and any(isinstance(i, CaughtUp) for i in found),
        (server, []), (port, found),
    )  # fmt: skip
    assert [bytes(i.packet.payload) for i in found if isinstance(i, PacketReceived)] == [b"scan"]
    port.send([b"\1", b"", b""])
    until(lambda: any(isinstance(a, RequestReceived) for a in asked), (server, asked), (port, found))
    assert RequestReceived([b"\1", b"", b""], "scheduler") in asked


def test_key_made_during_the_run_is_accepted(tmp_path: Path, open_: Any, until: Any) -> None:
    keys.generate(tmp_path, ["translator"])
    server = open_(locked_server(tmp_path))
    keys.generate(tmp_path, ["scheduler"])
    port = open_(locked_component(tmp_path, "scheduler", server))
    found: list[Any] = []
    until(lambda: ControlConnected() in found, (server, []), (port, found))


def test_connection_during_the_writing_of_a_key_does_no_harm(tmp_path: Path) -> None:
    keys.generate(tmp_path, ["translator", "late"])
    whole = (tmp_path / "public" / "late.key").read_bytes()
    key = z85.decode(load_certificate(tmp_path / "public" / "late.key")[0])
    (tmp_path / "public" / "late.key").unlink()
    own = keys.load(tmp_path, "translator")
    context: zmq.Context[Any] = zmq.Context()
    authenticator = Authenticator(context, own)
    knock = [b"1.0", b"1", b"afspm", b"", b"", b"CURVE", key]
    (tmp_path / "public" / "late.key").write_bytes(b"")
    assert authenticator.answer(knock)[2] == b"400"
    (tmp_path / "public" / "late.key").write_bytes(whole)  # which does not change the time of the folder
    assert authenticator.answer(knock)[2:5] == [b"200", b"OK", b"late"]
    (tmp_path / "public" / "other.key").write_bytes(whole)  # a name that is taken is not taken over
    assert authenticator.answer([*knock[:-1], b"\0" * 32])[2] == b"400"
    assert authenticator.answer(knock)[4] == b"late"
    authenticator.close()
    context.term()


def test_translator_refuses_known_keys_except_the_schedulers(tmp_path: Path, open_: Any, until: Any) -> None:
    keys.generate(tmp_path, ["translator", "scheduler", "visitor"])
    server = open_(locked_server(tmp_path))
    port = open_(locked_component(tmp_path, "visitor", server, claimed="scheduler"))
    found, asked = [], []  # type: ignore[var-annotated]
    until(lambda: ControlConnected() in found, (server, asked), (port, found))
    port.send([b"\1", b"", b""])
    until(lambda: any(getattr(i, "response", None) for i in found), (server, asked), (port, found))
    response = next(i.response for i in found if getattr(i, "response", None))
    assert not response.ok
    assert "only scheduler may send requests" in response.reason
    assert not any(isinstance(a, RequestReceived) for a in asked)


@pytest.mark.parametrize("stranger", ["a key of its own", "no key"])
def test_unknown_keys_are_refused(tmp_path: Path, open_: Any, until: Any, plain: Any, stranger: str) -> None:
    keys.generate(tmp_path, ["translator", "scheduler"])
    server = open_(locked_server(tmp_path))
    requester = plain(zmq.DEALER)
    if stranger == "a key of its own":
        public, secret = zmq.curve_keypair()
        requester.curve_publickey, requester.curve_secretkey = public, secret
        requester.curve_serverkey = keys.load(tmp_path, "translator").public
    requester.connect(server.serve_address)
    requester.send_multipart([b"", b"\1"])
    friend, found, asked = open_(locked_component(tmp_path, "scheduler", server)), [], []  # type: ignore[var-annotated]
    until(lambda: ControlConnected() in found, (server, asked), (friend, found))
    friend.send([b"\7", b"", b"friend"])
    until(lambda: any(isinstance(a, RequestReceived) for a in asked), (server, asked), (friend, found))
    assert [a.frames for a in asked if isinstance(a, RequestReceived)] == [[b"\7", b"", b"friend"]]


def test_address_with_an_unknown_owner_is_refused(tmp_path: Path, open_: Any) -> None:
    keys.generate(tmp_path, ["A", "B"])
    network = open_(Network(keys.load(tmp_path, "A", {"tcp://127.0.0.1:5": "C"})))
    with pytest.raises(ConfigError, match="no key is set"):
        network.connect(network.socket(zmq.SUB), "tcp://127.0.0.1:4")
    with pytest.raises(ConfigError, match="no public key of 'C'"):
        network.connect(network.socket(zmq.SUB), "tcp://127.0.0.1:5")


@pytest.mark.skipif(sys.platform == "win32", reason="files have no modes there")
@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o644])
def test_secret_key_readable_by_others_is_refused(tmp_path: Path, mode: int) -> None:
    keys.generate(tmp_path, ["series"])
    (tmp_path / "private" / "series.key_secret").chmod(mode)
    with pytest.raises(ConfigError, match=f"its mode is {mode:04o}") as refused:
        keys.load(tmp_path, "series")
    assert "chmod 600" in refused.value.hint
