from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from afspm.basics.errors import ConfigError, FileError
from afspm.experiment import load
from afspm.testing.skeletons import write


@pytest.mark.parametrize("name", ["tip_top", "tip-top", " Tip Top "])
def test_skeleton_has_the_requested_name_everywhere(name: str, tmp_path: Path) -> None:
    folder = write("driver", name, tmp_path)
    assert folder == tmp_path / "tip_top"
    files = {file.relative_to(folder).as_posix(): file.read_text() for file in folder.rglob("*") if file.is_file()}
    assert set(files) == {
        "README.md", "experiment.toml", "pyproject.toml", "tests/test_tip_top.py", "tip_top/__init__.py",
        "tip_top/parameters.toml",
    }  # fmt: skip
    assert "class TipTop(Driver)" in files["tip_top/__init__.py"]
    assert tomllib.loads(files["experiment.toml"])["microscope"]["class"] == "tip_top.TipTop"
    assert not any("my_scope" in text or "MyScope" in text for text in files.values())


def test_driver_of_the_skeleton_is_declared_for_any_experiment(tmp_path: Path) -> None:
    project = tomllib.loads((write("driver", "tip-top", tmp_path) / "pyproject.toml").read_text())["project"]
    assert project["entry-points"] == {"afspm.drivers": {"TipTop": "tip_top:TipTop"}}


@pytest.mark.parametrize("name", ["2tips", "", "a.b", "../up", "afspm"])
def test_invalid_package_name_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can't be the name of a package"):
        write("driver", name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "work.txt").write_text("of years")
    with pytest.raises(FileError, match="this folder already exists"):
        write("driver", "mine", tmp_path)
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["work.txt"]


@pytest.mark.parametrize("kind", ["experiment", "component", "driver"])
def test_skeleton_has_its_name_and_no_error(kind: str, tmp_path: Path) -> None:
    folder = write(kind, "height-watch", tmp_path)
    text = "".join(file.read_text() for file in folder.rglob("*") if file.is_file())
    assert not re.search(f"my_?{kind}", text, re.IGNORECASE)
    experiment = load(folder / "experiment.toml")
    assert experiment.check() == []
    assert experiment.name == "height_watch"
    assert ("height_watch" in experiment.component_names) is (kind == "component")
