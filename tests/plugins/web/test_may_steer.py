"""Steering sends no request without a name, even if the page shows a button."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from afspm.basics import ExperimentClock, Launch
from afspm.model import ControlResponse, Response
from afspm.plugins.web.dashboard.access import Access, Visitor
from afspm.plugins.web.dashboard.actions import ActionResult, Steering
from afspm.plugins.web.dashboard.sessions import Sessions
from afspm.plugins.web.persons import Person, Persons
from afspm.plugins.web.watch import Watch


@pytest.fixture
def access() -> Access:
    return Access("127.0.0.1", "", {}, lambda: 1000.0, Sessions(None, lambda: 1000.0), {})


@dataclass
class Commands:
    """The commands of a person, who can only end the experiment."""

    person: str
    ended_by: list[str]

    def end(self) -> Response:
        self.ended_by.append(self.person)
        return Response(int(ControlResponse.SUCCESS))


@pytest.fixture
def ended_by() -> list[str]:
    return []


@pytest.fixture
def steering(access: Access, ended_by: list[str]) -> Steering:
    clock = ExperimentClock.real()
    watch = Watch(clock)

    def connect(person: str, _: Person) -> tuple[None, Any]:
        return None, Commands(person, ended_by)

    return Steering(Persons(Launch("dashboard"), clock, watch, connect), watch, access)


def end(steering: Steering, visitor: Visitor) -> ActionResult:
    return steering.do(visitor, lambda actions: actions.end()).result(5.0)


@pytest.mark.parametrize("person", ["", " ", "a:b", "<b>"])
def test_a_nameless_person_may_not_steer(steering: Steering, ended_by: list[str], person: str) -> None:
    end(steering, Visitor("Ada"))
    assert "Sign in" in end(steering, Visitor(person)).text
    assert ended_by == ["Ada"]


def test_an_open_page_steers_no_more_after_signing_out(steering: Steering, access: Access, ended_by: list[str]) -> None:
    cookie = access.enter("Ada", "", "x")
    visitor = access.visitor(cookie)
    assert visitor is not None
    end(steering, visitor)
    access.leave(cookie)
    end(steering, visitor)
    assert ended_by == ["Ada"]
