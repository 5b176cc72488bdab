"""The page about acts at the panels has what follows them now."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.plugins.panel_table import PAGE, PANELS, table

pytestmark = [pytest.mark.slow]  # a dozen translators for each maker


@pytest.mark.parametrize("maker", PANELS)
def test_acts_at_the_panel_have_the_consequences_on_the_page(
    maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HOME", "USERPROFILE", "TMPDIR"):  # of the secret of Gxsm's bridge, and of its lock
        monkeypatch.setenv(name, str(tmp_path))
    assert table(maker) in PAGE.read_text(encoding="utf-8"), "tests.plugins.panel_table writes it again"
