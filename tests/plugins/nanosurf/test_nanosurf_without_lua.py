"""Without lupa the emulated Studio is refused before anything starts."""

from __future__ import annotations

from importlib import metadata

import pytest

from afspm.basics import ConfigError
from afspm.plugins.nanosurf.emulator import NanosurfEmulator


def test_missing_package_is_reported_with_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    version = metadata.version

    def found(name: str) -> str:
        if name == "lupa":
            raise metadata.PackageNotFoundError(name)
        return version(name)

    NanosurfEmulator().check()
    monkeypatch.setattr(metadata, "version", found)
    with pytest.raises(ConfigError, match="NanosurfEmulator needs packages that are not installed: lupa") as refused:
        NanosurfEmulator().check()
    assert refused.value.hint == 'pip install "afspm[nanosurf]"'
