"""Classes from modules beside an experiment file."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from afspm.basics.packages import BROUGHT_BY
from afspm.experiment import class_loader


def test_modules_beside_the_file_are_unloaded_and_modules_of_an_environment_in_its_folder_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """numpy, for one, refuses a second import."""
    environment = tmp_path / ".venv" / "site-packages"
    for file in (tmp_path / "beside.py", tmp_path / "package" / "__init__.py", environment / "library.py"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("import library\n" if file.name == "beside.py" else "", encoding="utf-8")
    monkeypatch.syspath_prepend(environment)
    with class_loader.importing_from([tmp_path]):
        for name in ("beside", "package"):
            importlib.import_module(name)
        assert {"beside", "package", "library"} <= set(sys.modules)
    assert not {"beside", "package"} & set(sys.modules)
    del sys.modules["library"]  # it was there still


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("from afspm.translator import Driver", "write `from afspm.driver import Driver`"),
        ("from afspm.driver import Region", "write `from afspm import Region`"),
        ("from afspm.driver import NoSuchName", ""),
    ],
)
def test_module_that_imports_a_moved_name_is_pointed_to_its_door(
    line: str, hint: str, tmp_path: Path
) -> None:  # contributors K5
    (tmp_path / "older.py").write_text(line, encoding="utf-8")
    with (
        class_loader.importing_from([tmp_path]),
        pytest.raises(class_loader.Unloadable, match="cannot import") as found,
    ):
        class_loader.load("older.Mine")
    assert found.value.hint == hint


def test_class_of_a_package_that_is_not_installed_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(BROUGHT_BY, "NotInstalled", "afspm-published")  # whose own classes may be installed here
    with pytest.raises(class_loader.Unloadable, match="no ready-made class 'NotInstalled'") as found:
        class_loader.full_path("NotInstalled")
    assert found.value.hint.endswith("pip install ./packages/afspm-published")
