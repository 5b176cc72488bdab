"""A grid contains every different combination, by names from a command line or a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.basics import ConfigError, FileError, InvalidValue
from afspm_lab.study.grid import SettingsGrid
from afspm_lab.study.settings import NightSettings


def test_every_combination_comes_once_after_the_defaults() -> None:
    grid = SettingsGrid.of(["pixels=64,128", "hours=4", "every_s=900,1800"])
    named = dict(grid.settings())
    assert next(iter(named)) == "defaults"
    assert named["defaults"].hours == 4
    combinations = {(one.pixels, one.every_s) for one in named.values()}
    assert combinations == {(64, 900), (64, 1800), (128, 900), (128, 1800)}
    assert len(named) == 4


def test_settings_of_another_tracker_make_no_combination() -> None:
    grid = SettingsGrid.of(["tracker=bank,paper", "paper.queue=3,5,10"])
    named = dict(grid.settings())
    assert list(named) == ["defaults", "tracker=paper paper.queue=3", "tracker=paper paper.queue=5",
                           "tracker=paper paper.queue=10"]  # fmt: skip
    assert named["defaults"].tracker == {"class": "bank"}
    assert named["tracker=paper paper.queue=10"].tracker == {"class": "paper", "queue": 10}


@pytest.mark.parametrize("given", [["paper.queue=3,5"], ["tracker=bank", "paper.queue=3"], ["tracker.queue=3"]])
def test_settings_of_a_part_that_no_night_has_are_refused(given: list[str]) -> None:
    with pytest.raises(ConfigError, match="has no effect"):
        dict(SettingsGrid.of(given).settings())


def test_a_user_s_own_part_gets_settings_by_its_full_name() -> None:
    named = dict(SettingsGrid.of(["estimator=my_lab.Periodicity", "my_lab.Periodicity.lattice_m=1e-9,2e-9"]).settings())
    assert [one.estimator.get("lattice_m") for one in named.values()] == [None, 1e-9, 2e-9]
    assert list(named)[1] == "my_lab.Periodicity.lattice_m=1e-09"


def test_the_command_line_overrides_a_file(tmp_path: Path) -> None:
    file = tmp_path / "grid.toml"
    text = 'tracker = ["bank", "paper"]\nhours = 2\n[paper]\nqueue = [3, 5]\nf_min = 0.5\n'
    file.write_text(text, encoding="utf-8-sig")
    grid = SettingsGrid.of([str(file), "hours=3"])
    assert grid.values == {
        "tracker": ("bank", "paper"), "hours": (3,), "paper.queue": (3, 5), "paper.f_min": (0.5,),
    }  # fmt: skip
    assert grid.varied == ("tracker", "paper.queue")


def test_unknown_and_meaningless_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="pixel"):
        NightSettings.of({"pixel": 3})
    with pytest.raises(InvalidValue, match="does not fit"):
        NightSettings.of({"pixels": 1024})
    with pytest.raises(ConfigError, match="not a setting"):
        SettingsGrid.of(["tracker"])
    with pytest.raises(FileError, match="can't be read"):
        SettingsGrid.of([str(tmp_path / "missing.toml")])
    (tmp_path / "bad.toml").write_text("= 3", encoding="utf-8")
    with pytest.raises(ConfigError, match="is not TOML"):
        SettingsGrid.of([str(tmp_path / "bad.toml")])
