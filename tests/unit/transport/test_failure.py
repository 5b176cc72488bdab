"""The text of an error in a user's code: the user's lines, without those of afspm."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.errors import Refused
from afspm.client.component import Component
from afspm.client.dispatch import MessageDispatcher
from afspm.model import Region, ScanParameters
from afspm.transport.process.failure import describe

EMPTY: dict[str, str] = {}
# a user's file is not type-checked
REGION: Any = Region
SCAN_PARAMETERS: Any = ScanParameters
OURS = Path(MessageDispatcher.give.__code__.co_filename).parents[1]


def made_up(code: str, **names: object) -> dict[str, Any]:
    """Return the names that `code` defines, as if it were a file of afspm."""
    exec(compile(code, str(OURS / "client" / "made_up.py"), "exec"), names)
    return names


CALL = """
def call(function):
    try:
        function()
    except Exception as error:
        return error
    raise AssertionError("it did not raise")
"""


def raised(function: Callable[[], object]) -> BaseException:
    """Return the error that a function raises when afspm's code calls it."""
    error = made_up(CALL)["call"](function)
    assert isinstance(error, BaseException)
    return error


REFUSE = """
def refuse():
    raise Refused(9, "too far", where="series")
"""


def refuse() -> None:
    made_up(REFUSE, Refused=Refused)["refuse"]()


def test_error_text_has_the_message_before_the_users_lines() -> None:
    lines = describe(raised(lambda: EMPTY["sharpness"])).splitlines()
    assert lines[0] == "KeyError: 'sharpness'"
    assert all("made_up.py" not in line for line in lines[1:])
    assert any("test_failure.py" in line for line in lines[1:])


def test_refusal_is_shown_at_the_users_line() -> None:
    text = describe(raised(refuse), "series")
    assert text.splitlines()[0] == "too far"
    assert "made_up.py" not in text
    assert "test_failure.py" in text


WITHIN = """
@contextmanager
def holding():
    raise Refused(9, "too far", where="series")
    yield

def run():
    with holding():
        pass
"""


def test_refusal_inside_a_context_of_an_own_component_is_shown() -> None:
    run = made_up(WITHIN, Refused=Refused, contextmanager=contextmanager)["run"]
    assert describe(raised(run), "series").splitlines()[0].startswith("too far")


def test_error_of_afspm_alone_is_shown_whole() -> None:
    text = describe(raised(lambda: 1 / 0), package=Path(__file__).parents[3])  # as if all of this were ours
    assert "made_up.py" in text
    assert "test_failure.py" in text


def test_refusal_of_an_own_component_is_only_its_message() -> None:
    error = raised(refuse)
    error.__cause__ = raised(lambda: EMPTY["of a library that we called"])
    assert describe(error, "series", package=Path(__file__).parents[3]) == "too far"


def test_chained_errors_are_shown() -> None:
    def careless() -> None:
        try:
            EMPTY["first"]
        except KeyError:
            undefined()  # type: ignore[name-defined]  # noqa: F821

    text = describe(raised(careless))
    assert text.startswith("NameError")
    assert "KeyError: 'first'" in text
    assert "made_up.py" not in text


def test_scope_used_too_early_is_shown_at_its_line() -> None:
    class Early(Component):
        def __init__(self) -> None:
            self.region = self.scope.scan_parameters

    text = describe(raised(Early))
    assert "not there yet in __init__" in text.splitlines()[0]
    assert "component.py" not in text


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: REGION(([0], 0), ("1 um", "1 um")),
        lambda: REGION(0, 1e-6),
        lambda: SCAN_PARAMETERS(shape=64),
        lambda: SCAN_PARAMETERS(shape=(1, 2, 3)),
        lambda: SCAN_PARAMETERS(shape=(64.0, 64.0)),
        lambda: SCAN_PARAMETERS(shape=("64", 64)),
    ],
)
def test_value_of_the_wrong_type_is_refused_with_the_right_one(wrong: Callable[[], object]) -> None:
    assert "e.g. " in describe(raised(wrong)).splitlines()[0]
