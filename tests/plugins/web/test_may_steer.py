"""Steering sends no request without a name, even if the page shows a button."""

from __future__ import annotations

from typing import Any, cast

import pytest

from afspm.basics import ExperimentClock, Launch
from afspm.plugins.web.dashboard.access import Access, Visitor
from afspm.plugins.web.dashboard.actions import ActionResult, Steering
from afspm.plugins.web.dashboard.sessions import Sessions
from afspm.plugins.web.persons import Persons
from afspm.plugins.web.watch import Watch


@pytest.fixture
def access() -> Access:
    return Access("127.0.0.1", "", {}, lambda: 1000.0, Sessions(None, lambda: 1000.0), {})


@pytest.fixture
def steering(access: Access, monkeypatch: pytest.MonkeyPatch) -> Steering:
    clock = ExperimentClock.real()
    watch = Watch(clock)
    persons = Persons(Launch("dashboard"), clock, watch)
    monkeypatch.setattr(persons, "_connect", lambda person, hurried: (None, person))
    return Steering(persons, watch, access)


def done(steering: Steering, visitor: Visitor) -> list[Any]:
    """Return the names under which an action was carried out."""
    asked: list[Any] = []

    def act(actions: Any) -> ActionResult:
        asked.append(actions._commands)
        return ActionResult("done")

    steering.do(visitor, act).result(5.0)
    return asked


@pytest.mark.parametrize("person", ["", " ", "a:b", "<b>"])
def test_a_nameless_person_may_not_steer(steering: Steering, person: str) -> None:
    assert done(steering, Visitor("Ada")) == ["Ada"]
    assert done(steering, Visitor(person)) == []
    assert "Sign in" in steering.do(Visitor(person), cast("Any", str)).result(5.0).text


def test_an_open_page_steers_no_more_after_signing_out(steering: Steering, access: Access) -> None:
    cookie = access.enter("Ada", "", "x")
    visitor = access.visitor(cookie)
    assert visitor is not None
    assert done(steering, visitor) == ["Ada"]
    access.leave(cookie)
    assert done(steering, visitor) == []
