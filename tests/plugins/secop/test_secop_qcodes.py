"""The sample server with instruments of QCoDeS, which needs a Python of its own: `AFSPM_QCODES_PYTHON` names one."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator

import pytest
from tests.plugins.secop.test_secop_server_sample import SAMPLE, SecopBench

from afspm.model import ControlResponse

PYTHON = os.environ.get("AFSPM_QCODES_PYTHON", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PYTHON, reason="AFSPM_QCODES_PYTHON names no Python with qcodes"),
]
SERVER = """
from qcodes.instrument_drivers.mock_instruments import DummyInstrument, MockField, MockLockin
from secop_server import Module, Server

magnet, source, lockin = MockField("magnet"), DummyInstrument("source", gates=["ch1"]), MockLockin("lockin")
magnet.ramp_rate(60.0)
source.ch1.step, source.ch1.inter_delay = 0.1, 0.02
server = Server({
    "mf": Module("magnet", "T", get=magnet.field, set=magnet.field, bounds=(-2, 2)),
    "gate": Module("gate", "V", get=source.ch1, set=source.ch1, bounds=(-10, 10)),
    "x": Module("lock-in X", "V", get=lockin.X),
}, port=0)
print(server.server_address[1], flush=True)
server.serve_forever()
"""


@pytest.fixture
def bench() -> Iterator[SecopBench]:
    process = subprocess.Popen([PYTHON, "-c", SERVER], cwd=SAMPLE.parent, stdout=subprocess.PIPE, encoding="ascii")
    assert process.stdout is not None
    made = SecopBench(int(process.stdout.readline()), {"m.field": "mf", "m.gate": "gate", "m.x": "x"})
    made.until(lambda: all(one.value is not None for one in made.readings().values()))
    yield made
    made.lines.close()
    process.kill()
    process.communicate()


@pytest.mark.parametrize(("name", "value", "unit"), [("m.gate", 2.0, "V"), ("m.field", 0.5, "T")])
def test_parameter_of_qcodes_is_busy_until_it_has_arrived(
    bench: SecopBench, name: str, value: float, unit: str
) -> None:
    assert bench.order(1, name, str(value), unit) == (ControlResponse.SUCCESS, "")
    assert bench.readings()[name].busy
    bench.until(lambda: bench.readings()[name].value == value and not bench.readings()[name].busy)


def test_qcodes_is_refused_a_value_outside_its_bounds(bench: SecopBench) -> None:
    assert "must be between -2 and 2" in bench.order(1, "m.field", "5", "T")[1]
    assert "can only be read" in bench.order(2, "m.x", "1", "V")[1]
