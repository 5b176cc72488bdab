"""Viewing and steering over https with a certificate and a password, as from another computer."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.ui.ui_lab import Night

from afspm.model import ControlMode
from afspm.plugins.web.passwords import hashed

PASSWORD, COMMON = "a tip of gold", "lead for all"
TLS = 'certificate = "lab.crt"\ncertificate_key = "lab.key"\n'
MAKE = "openssl req -x509 -newkey rsa:2048 -nodes -days 2 -keyout lab.key -out lab.crt -subj /CN=lab-pc"


@pytest.fixture
def night(browser: Any, tmp_path: Path) -> Iterator[Night]:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl is found: `apt install openssl`")
    subprocess.run(MAKE.split(), cwd=tmp_path, check=True, capture_output=True)
    people = f'people = {{ Ada = "{hashed(PASSWORD)}", Max = "{hashed("of silver")}" }}\n'
    one = Night(tmp_path, more=people + f'password_hash = "{hashed(COMMON)}"\n' + TLS)
    yield one
    one.close()


def test_a_person_with_a_password_takes_over_and_can_not_after_signing_out(night: Night, browser: Any) -> None:
    assert night.url.startswith("https://")
    context = browser.new_context(ignore_https_errors=True)  # a self-signed certificate
    try:
        page = context.new_page()
        page.goto(night.url)
        assert page.url == f"{night.url}/login"
        for password in ("of silver", COMMON, PASSWORD):
            page.fill("#person", "Ada")
            page.fill("#password", password)
            page.click("button")
            if password != PASSWORD:
                page.wait_for_selector("text=Wrong name or password")
        page.wait_for_selector(".picture[data-time]")
        page.click("button:has-text('Take over: MANUAL')")
        night.until(lambda: night.control().mode is ControlMode.MANUAL)
        assert [(cookie["secure"], cookie["httpOnly"]) for cookie in context.cookies()] == [(True, True)]
        kept = context.cookies()
        other = context.new_page()
        other.goto(night.url)
        other.click("button:has-text('Sign out')")
        page.wait_for_url("**/login")  # the page that was still open, too
        context.add_cookies(kept)
        page.goto(night.url)
        assert page.url == f"{night.url}/login"
    finally:
        context.close()
