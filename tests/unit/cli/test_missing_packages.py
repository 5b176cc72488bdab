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
    "line", ["what-if runs/latest --set tip_classifier.sigmas=60", "drift study tracker=bank,paper -n 2"]
)
def test_missing_command_names_its_package(line: str) -> None:
    done = CliRunner().invoke(app, line.split())
    assert isinstance(done.exception, ConfigError)
    assert line.startswith(str(done.exception).partition("the command afspm ")[2].partition(" is not installed")[0])
    assert "pip install ./packages/afspm-lab" in str(done.exception)
    assert "what-if" not in CliRunner().invoke(app, ["--help"]).output


def test_missing_function_names_its_package() -> None:
    with pytest.raises(AttributeError, match=r"pip install \./packages/afspm-lab"):
        afspm.what_if  # noqa: B018
    with pytest.raises(AttributeError, match=r"'nonsense'$"):
        afspm.nonsense  # noqa: B018


def test_named_packages_exist() -> None:
    for package in {*packages.BROUGHT_BY.values()}:
        assert (PACKAGES / package / "pyproject.toml").exists()
