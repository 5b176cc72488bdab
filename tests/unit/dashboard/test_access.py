from __future__ import annotations

import stat
import sys
from pathlib import Path

import pytest

from afspm.dashboard.access import (
    PASSWORD,
    TOKEN,
    Access,
    Visitor,
    check_name,
    hashed,
    is_hash,
    is_loopback,
    matches,
    secret_in,
)
from afspm.errors import ConfigError

KEPT = hashed("open sesame")


class Time:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def access(host: str = "0.0.0.0", kept: str = KEPT, time: Time | None = None, **environment: str) -> Access:
    return Access(host, kept, time or Time(), b"s" * 32, environment)


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
def test_loopback_is_this_computer_alone(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_on_loopback_anybody_may_look_and_a_name_is_enough_to_steer() -> None:
    guard = access("127.0.0.1", "")
    assert guard.visitor(None) == Visitor("")
    cookie = guard.enter("Ada", "", "127.0.0.1")
    assert guard.visitor(cookie) == Visitor("Ada")
    assert Visitor("Ada").may_steer
    assert not Visitor().may_steer


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.4", "::", ""])
def test_where_others_can_reach_it_it_refuses_to_start_without_a_password(host: str) -> None:
    with pytest.raises(ConfigError, match="neither password nor token"):
        access(host, "")


def test_a_plain_password_in_the_file_is_refused() -> None:
    with pytest.raises(ConfigError, match="not the hash"):
        access(kept="open sesame")


def test_elsewhere_nobody_looks_without_the_password() -> None:
    guard = access()
    assert guard.visitor(None) is None
    assert guard.enter("Ada", "wrong", "10.0.0.2") is None
    cookie = guard.enter("Ada", "open sesame", "10.0.0.2")
    assert guard.visitor(cookie) == Visitor("Ada")


def test_the_password_may_be_in_the_environment() -> None:
    guard = access(kept="", **{PASSWORD: "from the shell"})
    assert guard.enter("Ada", "from the shell", "x") is not None
    assert guard.enter("Ada", "", "x") is None


def test_a_password_on_loopback_is_asked_for_too() -> None:
    assert access("127.0.0.1").visitor(None) is None


def test_a_token_lets_in_and_may_say_who() -> None:
    guard = access(kept="", **{TOKEN: "t0ken"})
    assert guard.by_token("t0ken", "Ada", "x") == Visitor("Ada")
    assert guard.by_token("t0ken", "", "x") == Visitor("")
    assert guard.by_token("token", "Ada", "x") is None
    assert guard.by_token("", "Ada", "x") is None


@pytest.mark.parametrize(
    "change",
    [
        lambda cookie: cookie[:-1] + ("0" if cookie[-1] != "0" else "1"),
        lambda cookie: "x" + cookie,
        lambda cookie: "",
        lambda cookie: cookie.split(".")[0],
        lambda cookie: "QWRh." + cookie.split(".")[1],
        lambda cookie: cookie + "é",
    ],
)
def test_a_cookie_that_was_not_signed_here_counts_for_nothing(change: object) -> None:
    guard = access()
    cookie = guard.enter("Ada", "open sesame", "x")
    assert cookie is not None
    assert callable(change)
    assert guard.visitor(change(cookie)) is None


def test_a_cookie_outlives_a_restart_but_not_another_password() -> None:
    cookie = access().cookie("Ada")
    assert access().visitor(cookie) == Visitor("Ada")
    assert access(kept=hashed("another")).visitor(cookie) is None
    assert Access("0.0.0.0", KEPT, Time(), b"other", {}).visitor(cookie) is None


def test_a_cookie_is_forgotten_after_a_month() -> None:
    time = Time()
    guard = access(time=time)
    cookie = guard.cookie("Ada")
    time.now_s += 29 * 24 * 3600
    assert guard.visitor(cookie) == Visitor("Ada")
    time.now_s += 2 * 24 * 3600
    assert guard.visitor(cookie) is None


def test_whoever_was_wrong_too_often_has_to_wait_even_with_the_right_password() -> None:
    time = Time()
    guard = access(time=time, **{TOKEN: "t0ken"})
    for _ in range(5):
        assert guard.by_token("guess", "", "10.0.0.9") is None
    assert guard.wait_s("10.0.0.9") == pytest.approx(60.0)
    assert guard.enter("Eve", "open sesame", "10.0.0.9") is None
    assert guard.by_token("t0ken", "", "10.0.0.9") is None
    assert guard.enter("Ada", "open sesame", "10.0.0.2") is not None
    time.now_s += 61.0
    assert guard.enter("Eve", "open sesame", "10.0.0.9") is not None


def test_many_that_are_wrong_take_no_more_memory() -> None:
    guard = access()
    for i in range(3000):
        guard.by_token("guess", "", f"10.0.{i // 256}.{i % 256}")
    assert len(guard._failures) <= 1000


@pytest.mark.parametrize(
    ("given", "expected"),
    [("Ada", "Ada"), ("  Ada   Lovelace ", "Ada Lovelace"), ("Žofie", "Žofie"), ("o'Neil-Smith", "o'Neil-Smith"),
     ("", ""), ("a/b", ""), ("a:b", ""), ("<b>", ""), ("x" * 41, ""), ("-", ""), ("a\nb", "a b"), ("a|b", "")],
)  # fmt: skip
def test_names_are_what_may_stand_in_the_record(given: str, expected: str) -> None:
    assert check_name(given) == expected


def test_the_secret_is_kept_for_oneself(tmp_path: Path) -> None:
    file = tmp_path / "dashboard.secret"
    secret = secret_in(file)
    assert secret_in(file) == secret
    assert len(secret) == 32
    assert secret_in(None) != secret_in(None)
    if sys.platform != "win32":
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
