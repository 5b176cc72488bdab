from __future__ import annotations

import stat
import sys
from pathlib import Path
from typing import Any

import pytest

from afspm.basics import ConfigError
from afspm.plugins.web.dashboard.access import PASSWORD, Access, Visitor
from afspm.plugins.web.dashboard.sessions import MOST_ENDED, Sessions
from afspm.plugins.web.passwords import check_name, hashed, is_hash, is_loopback, matches

KEPT = hashed("open sesame")
ADAS = hashed("analytical")


class Time:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def access(
    host: str = "0.0.0.0",
    kept: str = KEPT,
    time: Time | None = None,
    people: dict[str, str] | None = None,
    file: Path | None = None,
    **environment: str,
) -> Access:
    time = time or Time()
    return Access(host, kept, {"Ada": ADAS} if people is None else people, time, Sessions(file, time), environment)


def who(guard: Access, cookie: str | None) -> str | None:
    """Return the name of a cookie's viewer; None: access is refused."""
    visitor = guard.visitor(cookie)
    return None if visitor is None else visitor.person


def test_a_password_is_kept_as_a_hash_that_is_different_each_time() -> None:
    assert is_hash(KEPT)
    assert "sesame" not in KEPT
    assert hashed("open sesame") != KEPT
    assert matches("open sesame", KEPT)
    assert not matches("open sesam", KEPT)


@pytest.mark.parametrize(
    ("host", "expected"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("127.8.9.1", True), ("0.0.0.0", False),
     ("192.168.1.4", False), ("::", False), ("lab.example.org", False), ("", False)],
)  # fmt: skip
def test_loopback_addresses_are_recognised(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_on_loopback_every_viewer_may_look_and_a_name_is_enough_to_steer() -> None:
    guard = access("127.0.0.1", "", people={})
    assert guard.visitor(None) == Visitor("")
    assert who(guard, guard.enter("Ada", "", "127.0.0.1")) == "Ada"
    assert Visitor("Ada").may_steer
    assert not Visitor().may_steer


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.4", "::", ""])
def test_a_reachable_page_without_a_password_refuses_to_start(host: str) -> None:
    with pytest.raises(ConfigError, match="has no password"):
        access(host, "", people={})


def test_a_plain_password_in_the_file_is_refused() -> None:
    with pytest.raises(ConfigError, match="not the hash"):
        access(kept="open sesame")
    with pytest.raises(ConfigError, match="'Ada' is not the hash"):
        access(people={"Ada": "analytical"})
    with pytest.raises(ConfigError, match="not the hash"):
        access(people={"Ada": ""})
    with pytest.raises(ConfigError, match="not a valid name"):
        access(people={"a:b": ADAS})


def test_beyond_loopback_a_viewer_needs_a_password_to_look() -> None:
    guard = access()
    assert guard.visitor(None) is None
    assert guard.enter("", "wrong", "10.0.0.2") is None
    assert who(guard, guard.enter("", "open sesame", "10.0.0.2")) == ""
    assert who(guard, guard.enter("Ada", "analytical", "10.0.0.2")) == "Ada"


@pytest.mark.parametrize("host", ["0.0.0.0", "127.0.0.1"])
@pytest.mark.parametrize("kept", [KEPT, ""], ids=["common", "none"])
def test_names_of_others_and_unknown_names_are_refused(host: str, kept: str) -> None:
    guard = access(host, kept, people={"Ada": ADAS, "Max": KEPT})
    assert guard.enter("Ada", "open sesame", "x") is None
    assert guard.enter("Eve", "analytical", "x") is None
    assert guard.enter("Eve", "open sesame", "x") is None
    assert guard.by_password("Ada", "open sesame", "x") is None
    assert who(guard, guard.enter("Ada", "analytical", "y")) == "Ada"


def test_the_common_password_may_be_in_the_environment_and_lets_look_only() -> None:
    environment: dict[str, Any] = {PASSWORD: "from the shell"}
    guard = access(kept="", people={}, **environment)
    assert who(guard, guard.enter("", "from the shell", "x")) == ""
    assert guard.enter("Ada", "from the shell", "x") is None
    assert guard.enter("", "", "x") is None


def test_a_password_is_required_on_loopback_too() -> None:
    assert access("127.0.0.1").visitor(None) is None


def test_on_loopback_with_persons_every_viewer_looks_and_only_persons_steer() -> None:
    guard = access("127.0.0.1", "")
    assert guard.visitor(None) == Visitor()
    assert who(guard, guard.enter("", "", "x")) == ""
    assert guard.enter("Ada", "", "x") is None


def test_a_program_sends_its_name_and_password_with_each_request() -> None:
    guard = access()
    for _ in range(2):
        assert guard.by_password("Ada", "analytical", "x") == Visitor("Ada")
    assert guard.by_password("", "open sesame", "x") == Visitor("")
    assert guard.by_password("Ada", "", "x") is None


@pytest.mark.parametrize("change", [lambda c: c[:-1], lambda c: "x" + c, lambda c: "", lambda c: c + "é"])
def test_a_foreign_cookie_is_worthless(change: object) -> None:
    guard = access()
    cookie = guard.enter("Ada", "analytical", "x")
    assert cookie is not None
    assert callable(change)
    assert guard.visitor(change(cookie)) is None


def test_a_session_outlives_a_restart_but_not_another_password(tmp_path: Path) -> None:
    file = tmp_path / "dashboard.sessions"
    cookie = access(file=file).cookie("Ada")
    assert who(access(file=file), cookie) == "Ada"
    assert who(access(file=file, people={"Ada": hashed("another")}), cookie) is None
    assert who(access(file=file, people={}), cookie) is None
    assert who(access(), cookie) is None
    assert cookie not in file.read_text(encoding="utf-8")
    if sys.platform != "win32":
        assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_a_cookie_is_worthless_after_signing_out_even_over_a_restart(tmp_path: Path) -> None:
    file = tmp_path / "dashboard.sessions"
    guard = access(file=file)
    here, there, others = guard.cookie("Ada"), guard.cookie("Ada"), guard.cookie("")
    visitor = guard.visitor(here)
    assert visitor is not None
    assert guard.is_signed_in(visitor)
    guard.leave(here)
    assert not guard.is_signed_in(visitor)
    for one in (guard, access(file=file)):
        assert [who(one, cookie) for cookie in (here, there, others)] == [None, "Ada", ""]
    guard.leave(there, everywhere=True)
    assert [who(access(file=file), cookie) for cookie in (there, others)] == [None, ""]


def test_signing_out_everywhere_ends_every_session_of_this_person() -> None:
    guard = access()
    cookies = [guard.cookie("Ada") for _ in range(3)]
    guard.leave(cookies[0], everywhere=True)
    assert [who(guard, cookie) for cookie in cookies] == [None] * 3


def test_a_damaged_file_of_sessions_means_signing_in_again(tmp_path: Path) -> None:
    file = tmp_path / "dashboard.sessions"
    for damaged in (b"", b"[{}]", b"{", b"7", b"\xff"):
        file.write_bytes(damaged)
        assert access(file=file).visitor("x") is None


def test_more_endings_than_can_be_kept_end_all_sessions_and_revive_none(tmp_path: Path) -> None:
    guard = access(file=tmp_path / "dashboard.sessions")
    ended, other = [guard.cookie("Ada") for _ in range(MOST_ENDED + 1)], guard.cookie("")
    for cookie in ended:
        guard.leave(cookie)
    assert {who(guard, cookie) for cookie in (*ended, other)} == {None}
    assert who(guard, guard.cookie("Ada")) == "Ada"
    assert (tmp_path / "dashboard.sessions").stat().st_size < 1000


def test_a_session_ends_after_a_month() -> None:
    time = Time()
    guard = access(time=time)
    cookie = guard.cookie("Ada")
    time.now_s += 29 * 24 * 3600
    assert who(guard, cookie) == "Ada"
    time.now_s += 2 * 24 * 3600
    assert guard.visitor(cookie) is None


def test_wrong_passwords_are_checked_every_three_seconds_and_lock_no_person_out() -> None:
    time = Time()
    guard = access(time=time, people={"Ada": ADAS, "Max": KEPT})
    for _ in range(6):
        assert guard.wait_s("Ada", "10.0.0.9") == 0.0
        assert guard.by_password("Ada", "guess", "10.0.0.9") is None
    assert guard.wait_s("Ada", "10.0.0.9") == pytest.approx(3.0)
    assert guard.enter("Ada", "analytical", "10.0.0.9") is None
    assert guard.enter("Ada", "analytical", "10.0.0.2") is not None
    assert guard.enter("Max", "open sesame", "10.0.0.9") is not None
    time.now_s += 3.0
    assert guard.enter("Ada", "analytical", "10.0.0.9") is not None


def test_a_password_that_was_right_is_accepted_at_once_among_wrong_ones() -> None:
    guard = access()
    assert guard.by_password("Ada", "analytical", "10.0.0.9") == Visitor("Ada")
    for _ in range(20):
        assert guard.by_password("Ada", "guess", "10.0.0.9") is None
    assert guard.by_password("Ada", "analytical", "10.0.0.9") == Visitor("Ada")


def test_simultaneous_passwords_are_not_all_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    guard, looked_at = access(), list[str]()

    def wrong(password: str, kept: str) -> bool:
        looked_at.append(password)
        if len(looked_at) == 1:  # nine more come before the first is found to be wrong
            assert [guard.by_password("Ada", "guess", "10.0.0.9") for _ in range(9)] == [None] * 9
        return False

    monkeypatch.setattr("afspm.plugins.web.passwords.matches", wrong)
    guard.by_password("Ada", "guess", "10.0.0.9")
    assert len(looked_at) == 6


def test_many_wrong_passwords_take_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("afspm.plugins.web.passwords.matches", lambda password, kept: False)  # which takes its time
    guard = access()
    for _ in range(6):
        guard.by_password("", "guess", "10.1.0.1")
    assert guard.wait_s("", "10.1.0.1") > 0.0
    for i in range(1000):
        guard.by_password("", "guess", f"10.0.{i // 256}.{i % 256}")
    assert guard.wait_s("", "10.1.0.1") == 0.0, "the oldest address is forgotten"


@pytest.mark.parametrize(
    ("given", "expected"),
    [("Ada", "Ada"), ("  Ada   Lovelace ", "Ada Lovelace"), ("Žofie", "Žofie"), ("o'Neil-Smith", "o'Neil-Smith"),
     ("", ""), ("a/b", ""), ("a:b", ""), ("<b>", ""), ("x" * 41, ""), ("-", ""), ("a\nb", "a b"), ("a|b", "")],
)  # fmt: skip
def test_names_are_restricted_to_those_allowed_in_the_record(given: str, expected: str) -> None:
    assert check_name(given) == expected
