"""A panel with names from outside, without a browser."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from nicegui import Client, ui

from afspm.model import ProcessCondition, ProcessState
from afspm.plugins.web.dashboard.panels import HealthPanel

HOSTILE = """x" onmouseover="alert(1)" innerHTML="<img src=x onerror=alert(2)>"""


def test_a_name_with_quotation_marks_sets_no_property_of_an_element() -> None:
    with Client(ui.page("/")) as client:
        panel = HealthPanel(cast("Any", SimpleNamespace(may_steer=True)))
        panel.show([ProcessState(HOSTILE, "component", ProcessCondition.ALIVE, 1)], {})
        buttons = [one for one in client.elements.values() if isinstance(one, ui.button)]
    (button,) = buttons
    assert set(button.props) == {"flat", "dense", "no-caps", "aria-label", "label", "color"}
    assert button.props["aria-label"] == f"Restart {HOSTILE}"
