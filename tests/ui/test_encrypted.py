"""With a certificate and a password, as from another computer: what is seen and what is done goes over https."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ui_lab import Night

from afspm.model import ControlMode

PASSWORD = "a tip of gold"
MAKE = "openssl req -x509 -newkey rsa:2048 -nodes -days 2 -keyout lab.key -out lab.crt -subj /CN=lab-pc"


@pytest.fixture
def night(browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Night]:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl is found: `apt install openssl`")
    subprocess.run(MAKE.split(), cwd=tmp_path, check=True, capture_output=True)
    monkeypatch.setenv("AFSPM_DASHBOARD_PASSWORD", PASSWORD)
    one = Night(tmp_path, more='certificate = "lab.crt"\ncertificate_key = "lab.key"\n')
    yield one
    one.close()


def test_who_knows_the_password_sees_scans_and_takes_over(night: Night, browser: Any) -> None:
    assert night.url.startswith("https://")
    context = browser.new_context(ignore_https_errors=True)  # nobody has signed this certificate
    try:
        page = context.new_page()
        page.goto(night.url)
        assert page.url == f"{night.url}/login"
        for password in ("a guess", PASSWORD):
            page.fill("#person", "Ada")
            page.fill("#password", password)
            page.click("button")
            if password != PASSWORD:
                page.wait_for_selector("text=That is not right.")
        page.wait_for_selector(".picture[data-time]")
        page.click("button:has-text('Take over: MANUAL')")
        night.until(lambda: night.control().mode is ControlMode.MANUAL)
        assert [(cookie["secure"], cookie["httpOnly"]) for cookie in context.cookies()] == [(True, True)]
    finally:
        context.close()
