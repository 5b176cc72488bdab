from __future__ import annotations

from importlib import metadata

import pytest

from afspm.basics.errors import ConfigError
from afspm.basics.requirements import imports_of_extra, require


def needy(requires: object) -> type:
    return type("Needy", (), {"requires": requires})


INSTALLED = {"afspm": "0.1.0", "numpy": "2.1", "nicegui": "2.9"}
OF_AFSPM = [
    "numpy>=1.26",
    'nicegui>=3.0; extra == "dashboard"',
    'itsdangerous>=2.2; extra == "dashboard"',
    'afspm[dashboard]; extra == "all"',
    'torch; extra == "all" and python_version < "3"',
]


@pytest.fixture(autouse=True)
def _packages(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name not in INSTALLED:
            raise metadata.PackageNotFoundError(name)
        return INSTALLED[name]

    monkeypatch.setattr(metadata, "version", version)
    monkeypatch.setattr(metadata, "requires", {"afspm": OF_AFSPM}.get)


@pytest.mark.parametrize(
    ("requires", "packages", "command"),
    [
        (("torch>=2.4",), "torch", 'pip install "torch>=2.4"'),
        ("torch", "torch", 'pip install "torch"'),
        (("numpy>=3",), "numpy>=3 (there is 2.1)", 'pip install "numpy>=3"'),
        (("afspm[dashboard]",), "nicegui>=3.0 (there is 2.9), itsdangerous", 'pip install "afspm[dashboard]"'),
        (("afspm[all]",), "nicegui>=3.0 (there is 2.9), itsdangerous", 'pip install "afspm[all]"'),
        (("numpy", "torch", "jax"), "torch, jax", 'pip install "torch" "jax"'),
    ],
)
def test_missing_packages_are_named_with_the_install_command(requires: object, packages: str, command: str) -> None:
    with pytest.raises(ConfigError) as refused:
        require(needy(requires))
    assert (refused.value.what, refused.value.hint) == (
        f"Needy needs packages that are not installed: {packages}",
        command,
    )


def test_missing_package_of_an_extra_is_named_with_the_install_command() -> None:
    with pytest.raises(ConfigError) as refused, imports_of_extra("xarray", "to_xarray"):
        import no_such_package  # type: ignore[import-not-found] # noqa: F401
    assert str(refused.value) == (
        'to_xarray needs no_such_package, which is not installed (pip install "afspm[xarray]")'
    )


@pytest.mark.parametrize("requires", [(), ("numpy>=1.26",), ("afspm",)])
def test_installed_packages_are_accepted(requires: object) -> None:
    require(needy(requires))
    require(None)


def test_invalid_requirement_is_refused() -> None:
    with pytest.raises(ConfigError, match="'two words' is not a requirement"):
        require(needy(("two words",)))
