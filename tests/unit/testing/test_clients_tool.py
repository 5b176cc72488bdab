"""`make test-clients` reports missing toolchains and failures."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[3]


@pytest.fixture
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("test_clients_tool", ROOT / "tools" / "test_clients.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def client(folder: Path, needs: str, build: str) -> Path:
    file = folder / "conformance.toml"
    text = f'needs = ["{needs}"]\ninstall = "the tool of example.org"\nbuild = [{build}]\n[programs]\n'
    file.write_text(text, encoding="utf-8")
    return file


def test_missing_toolchain_is_reported_as_skipped(tool: ModuleType, tmp_path: Path) -> None:
    said = tool.judged(client(tmp_path, "no-such-compiler", ""))
    assert said == "SKIPPED: there is no no-such-compiler on this computer; install the tool of example.org"


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler: `apt install gcc`")
def test_missing_header_of_a_library_is_reported_with_its_package(tool: ModuleType, tmp_path: Path) -> None:
    file = client(tmp_path, "cc", "")
    headers = 'headers = { "no/such_header.h" = "cc", "stdio.h" = "cc" }\n'
    file.write_text(headers + file.read_text(encoding="utf-8"), encoding="utf-8")
    said = tool.judged(file)
    assert said == "SKIPPED: there is no no/such_header.h on this computer; install the tool of example.org"


def test_target_that_judges_no_client_fails(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "clients" / "cobol").mkdir(parents=True)
    client(tmp_path / "clients" / "cobol", "no-such-compiler", "")
    monkeypatch.setattr(tool, "ROOT", tmp_path)
    assert tool.main([]) == 1
    assert "no client was judged: install what is named above" in capsys.readouterr().out


def test_build_that_fails_is_named(tool: ModuleType, tmp_path: Path) -> None:
    python = Path(sys.executable).as_posix()
    said = tool.judged(client(tmp_path, python, f'["{python}", "-c", "raise SystemExit(3)"]'))
    assert said == f"not built: {python} -c raise SystemExit(3)"


def test_every_client_has_a_conformance_file(tool: ModuleType) -> None:
    folders = {file.parent for file in (ROOT / "clients").glob("*/README.md")}
    assert {folder for folder in folders if not (folder / "conformance.toml").exists()} == set()


def test_unknown_client_is_an_error(tool: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert tool.main(["cobol"]) == 1
    assert "there is no client cobol: " in capsys.readouterr().out
