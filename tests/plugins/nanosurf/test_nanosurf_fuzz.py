"""Random scripts neither end the emulated Studio, nor spoil it, nor write outside its folder."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from benchmarks.fuzz import fuzz
from benchmarks.fuzz.nanosurf import NanosurfFuzzer
from rotation import ALL

from afspm.basics import ExperimentClock
from afspm.plugins.nanosurf.emulator import NanosurfEmulator

CALLS = 1500 if ALL else 500


def test_random_scripts_are_survived(tmp_path: Path) -> None:
    outcome = fuzz(NanosurfFuzzer, NanosurfEmulator(port=0), tmp_path, CALLS)
    assert min(outcome.answered, outcome.refused) > CALLS / 20


ENDS = ('{1,{"not enough memory"}}', '{1,{"the script runs too long"}}')


@pytest.fixture
def clients(tmp_path: Path) -> Iterator[list[socket.socket]]:
    """Connect two clients to an emulator."""
    with NanosurfEmulator(port=0).running(tmp_path, ExperimentClock.starting_now(speed=1e4)) as address:
        host, _, port = address.rpartition(":")
        with ExitStack() as stack:
            yield [stack.enter_context(socket.create_connection((host, int(port)), 30.0)) for _ in range(2)]


@pytest.mark.parametrize("kept", ["local t = {}", "t = {}"])
def test_script_that_exhausts_the_memory_fails_and_others_run(kept: str, clients: list[socket.socket]) -> None:
    greedy, other = clients
    ask(greedy, "return root.session.select('91-01-000', 2)")
    for more in ('("x"):rep(1e6)', "{}", "function() end"):
        assert ask(greedy, f"{kept} while true do t[#t + 1] = {more} end") in ENDS
        assert ask(other, "return root.session.list()[1], 1.5") == '{0,{"91-01-000",1.5}}'
        assert ask(greedy, "return root.workflow.imaging.line_rate.value") == "{0,{1.0}}"


def test_studio_13_has_the_values_and_commands_of_its_users_scripts(tmp_path: Path) -> None:
    clock = ExperimentClock.starting_now(speed=1e4)
    with NanosurfEmulator(port=0, release=13).running(tmp_path, clock) as address:
        host, _, port = address.rpartition(":")
        with socket.create_connection((host, int(port)), 30.0) as client:
            assert ask(client, "return root.session.select('91-01-000', 1)") == "{0,{nil}}"
            values = "root.workflow.imaging.property"
            assert ask(client, f"{values}.points_per_line.value=64; return 0") == "{0,{0}}"
            assert ask(client, f"return {values}.points_per_line.value") == "{0,{64}}"
            assert ask(client, f"return {values}.scan_range_fast_axis.unit") == '{0,{"m"}}'
            assert ask(client, f"return {values}.scan_mode.value_raw") == "{0,{1}}"
            assert ask(client, f"return {values}.line_rate.value_get") == "{0,{nil}}"
            assert ask(client, "return root.workflow.imaging.start_imaging()").startswith("{0,")
            assert ask(client, "return root.workflow.imaging.acquire") == "{0,{nil}}"
            assert ask(client, "return root.workflow.z_controller.property.setpoint.unit") == '{0,{"V"}}'


@pytest.mark.parametrize("field", ["line_rate", "line_rate.value"])
def test_value_assigned_to_a_property_is_set_for_all_clients(field: str, clients: list[socket.socket]) -> None:
    for client in clients:
        ask(client, "return root.session.select('91-01-000', 1)")
    assert ask(clients[0], f"root.workflow.imaging.{field} = 3.5") == "{0,{}}"
    for client in clients:
        assert ask(client, "return root.workflow.imaging.line_rate.value_get()") == "{0,{3.5}}"
        assert ask(client, "return root.workflow.imaging.line_rate.value, root.workflow.imaging.line_rate.unit") == (
            '{0,{3.5,"Hz"}}'
        )


@pytest.mark.parametrize(
    "assigned",
    [
        "root.workflow.imaging = 1",
        "root.workflow.imaging.start = nil",
        "root.workflow.imaging.line_rate = 'fast'",
        "root.workflow.imaging.line_rate = nil",
        "root.workflow.imaging.line_rate.value_set = nil",
        "root.workflow.imaging.line_rate.unit = 'kHz'",
        "root.workflow.imaging.scanning_started.connect = nil",
        "root.workflow.imaging.mine = 1",
        "root.mine = 1",
        "table.insert(root.workflow.imaging, 1)",
    ],
)
def test_nothing_in_the_tree_can_be_replaced(assigned: str, clients: list[socket.socket]) -> None:
    client, other = clients
    tree = """
local function paths(node, name, found)
  for key, one in pairs(node) do
    found[#found + 1] = name .. "." .. tostring(key) .. " " .. type(one)
    if type(one) == "table" then paths(one, name .. "." .. tostring(key), found) end
  end
  return found
end
local found = paths(root, "root", {})
table.sort(found)
return table.concat(found, ";")
"""
    for one in clients:
        ask(one, "return root.session.select('91-01-000', 1)")
    before = ask(other, tree)
    assert "root.workflow.imaging.line_rate.value_set function" in before
    assert ask(client, assigned).startswith("{1,{")
    assert ask(other, tree) == before
    assert ask(other, "return root.workflow.imaging.line_rate.value") == "{0,{1.0}}"


@pytest.mark.parametrize(
    "script",
    [
        "while true do pcall(function() while true do end end) end",
        "root.workflow.imaging.scanning_started.connect(function() while true do end end) "
        "root.workflow.imaging.acquire()",
        "string.format, table.concat = nil, nil",
    ],
)
def test_a_script_that_does_not_end_leaves_the_others_alone(script: str, clients: list[socket.socket]) -> None:
    client, other = clients
    ask(client, "return root.session.select('91-01-000', 1)")
    ask(client, script)
    assert ask(other, "return root.session.list()[1], 1.5") == '{0,{"91-01-000",1.5}}'


def test_client_that_reads_no_replies_is_disconnected(clients: list[socket.socket]) -> None:
    deaf, other = clients
    script = b'return ("x"):rep(5e6)'

    def flood() -> None:
        for _ in range(200):
            deaf.sendall(struct.pack("<I", len(script)) + script)
            assert ask(other, "return 1") == "{0,{1}}"

    with pytest.raises(ConnectionError):
        flood()


def ask(connection: socket.socket, script: str) -> str:
    raw = script.encode()
    connection.sendall(struct.pack("<I", len(raw)) + raw)
    reader = connection.makefile("rb")
    return reader.read(struct.unpack("<I", reader.read(4))[0]).decode()
