from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from afspm.errors import ConfigError, FileError
from afspm.testing.skeletons import write_driver


@pytest.mark.parametrize("name", ["tip_top", "tip-top", " Tip Top "])
def test_a_package_has_the_name_that_was_asked_for_everywhere(name: str, tmp_path: Path) -> None:
    folder = write_driver(name, tmp_path)
    assert folder == tmp_path / "tip_top"
    files = {str(file.relative_to(folder)): file.read_text() for file in folder.rglob("*") if file.is_file()}
    assert set(files) == {
        "README.md", "experiment.toml", "pyproject.toml", "tests/test_tip_top.py", "tip_top/__init__.py",
        "tip_top/parameters.toml",
    }  # fmt: skip
    assert "class TipTop(Driver)" in files["tip_top/__init__.py"]
    assert tomllib.loads(files["experiment.toml"])["microscope"]["class"] == "tip_top.TipTop"
    assert not any("my_scope" in text or "MyScope" in text for text in files.values())


@pytest.mark.parametrize("name", ["2tips", "", "a.b", "../up", "afspm"])
def test_what_can_not_be_a_package_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can't be the name of a package"):
        write_driver(name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "work.txt").write_text("of years")
    with pytest.raises(FileError, match="there is such a folder already"):
        write_driver("mine", tmp_path)
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["work.txt"]
