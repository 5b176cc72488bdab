"""A name of a package that is not installed is refused with the name of the package."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from typer.testing import CliRunner

import afspm
from afspm.basics import ConfigError, entry_points, packages
from afspm.cli.app import app
from afspm.experiment import load

PACKAGES = Path(__file__).parents[3] / "packages"


@pytest.fixture(autouse=True)
def plain_install(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Hide the packages that `pip install .` leaves out."""
    found = metadata.distributions
    hidden = {*packages.BROUGHT_BY.values()}
    monkeypatch.setattr(metadata, "distributions", lambda: (one for one in found() if one.name not in hidden))
    entry_points.forget()
    yield
    entry_points.forget()


@pytest.mark.parametrize(
    ("line", "package"),
    [
        ("agent runs/latest", "afspm-agents"),
        ("approve --grant grant.toml", "afspm-agents"),
        ("drift study tracker=bank,paper -n 2", "afspm-lab"),
        ("what-if runs/latest --set tip_classifier.sigmas=60", "afspm-lab"),
    ],
)
def test_missing_command_names_its_package(line: str, package: str) -> None:
    done = CliRunner().invoke(app, line.split())
    assert isinstance(done.exception, ConfigError)
    named = str(done.exception).partition("the command afspm ")[2].partition(" is not installed")[0]
    assert named
    assert line.startswith(named)
    assert f"pip install ./packages/{package}" in str(done.exception)


def test_missing_class_names_its_package(tmp_path: Path) -> None:
    file = tmp_path / "night.toml"
    file.write_text('[agent]\ncomponent = true\nclass = "Agent"\n')
    (finding,) = [one for one in load(file).check() if "Agent" in one.what]
    assert finding.is_error
    assert "pip install ./packages/afspm-agents" in finding.hint


def test_missing_function_names_its_package() -> None:
    with pytest.raises(AttributeError, match=r"pip install \./packages/afspm-lab"):
        afspm.what_if  # noqa: B018
    with pytest.raises(AttributeError, match=r"'nonsense'$"):
        afspm.nonsense  # noqa: B018


def test_named_packages_exist() -> None:
    for package in {*packages.BROUGHT_BY.values()}:
        assert (PACKAGES / package / "pyproject.toml").exists()
