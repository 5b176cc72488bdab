"""An installation of afspm is whole: `pip install "afspm[testing]"`, then `pytest tests/installed`.

These tests are for packagers, and in the source distribution: they need the installed afspm and pytest, and nothing of
the clone. They take two minutes.
"""

from __future__ import annotations

import importlib.metadata
import importlib.resources
import json
import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import afspm

EXTRAS = re.compile(r"^([\w.-]+).*; *.*extra == ", re.MULTILINE)
OTHERWISE_NAMED = {"av", "httpx2", "IPython", "pandas", "quickjs", "skimage", "starlette"}
"""Imports of an extra whose names are not those of its requirements, or that a requirement brings along."""
IMPORT_ALL = """
import importlib, json, pkgutil, sys
import afspm
failures = {}
def note(name):
    error = sys.exc_info()[1]
    failures[name] = (error.name or str(error)) if isinstance(error, ImportError) else str(error)
for module in pkgutil.walk_packages(afspm.__path__, "afspm.", onerror=note):
    if module.name.endswith(".__main__") or ".skeletons." in module.name:
        continue  # programs, and templates, which import themselves by other names
    try:
        importlib.import_module(module.name)
    except Exception:  # the test judges failures of every kind
        note(module.name)
print(json.dumps(failures))
"""


def run(*command: str, folder: Path, code: int = 0) -> str:
    """Run a command in a folder far from the clone, and return its output."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONWARNINGS")}
    done = subprocess.run(
        command, cwd=folder, env={**environment, "COLUMNS": "200"}, capture_output=True, encoding="utf-8", check=False
    )
    output = done.stdout + done.stderr
    assert done.returncode == code, output
    assert "Traceback" not in output
    return output


def run_afspm(*arguments: str, folder: Path, code: int = 0) -> str:
    program = Path(sysconfig.get_path("scripts")) / ("afspm.exe" if os.name == "nt" else "afspm")
    return run(str(program), *arguments, folder=folder, code=code)


def test_program_has_the_version_of_the_metadata(tmp_path: Path) -> None:
    assert run_afspm("--version", folder=tmp_path).strip() == f"afspm {importlib.metadata.version('afspm')}"


def test_every_module_can_be_imported_or_lacks_a_package_of_an_extra(tmp_path: Path) -> None:
    failures = json.loads(run(sys.executable, "-c", IMPORT_ALL, folder=tmp_path))
    requirements = "\n".join(importlib.metadata.requires("afspm") or ())
    optional = {name.replace("-", "_") for name in EXTRAS.findall(requirements)} | OTHERWISE_NAMED

    def is_explained(failure: str) -> bool:
        return failure.partition(".")[0] in optional or 'pip install "afspm[' in failure

    assert {module: failure for module, failure in failures.items() if not is_explained(failure)} == {}


def test_types_messages_and_samples_are_installed() -> None:
    origin = json.loads(importlib.metadata.distribution("afspm").read_text("direct_url.json") or "{}")
    if origin.get("dir_info", {}).get("editable"):
        pytest.skip("an editable installation reads messages and samples from the clone")
    files = importlib.resources.files("afspm")
    assert (files / "py.typed").is_file()
    assert (files / "wire" / "proto" / "scan.proto").is_file()
    golden = json.loads((files / "wire" / "proto" / "golden.json").read_text(encoding="utf-8"))
    assert golden
    assert (files / "samples" / "tip_repair" / "experiment.toml").is_file()


def test_doctor_loads_every_declared_class(tmp_path: Path) -> None:
    report = json.loads(run_afspm("doctor", "--json", folder=tmp_path))
    assert report["is_well"]
    found = [one for one in report["found"] if one["where"].startswith("afspm ")]
    assert found
    assert {one["severity"] for one in found} == {"fine"}


@pytest.mark.parametrize("kind", ["experiment", "component", "driver"])
def test_template_has_no_error(kind: str, tmp_path: Path) -> None:
    run_afspm("new", kind, "my-idea", folder=tmp_path)
    assert "nothing wrong" in run_afspm("check", "experiment.toml", folder=tmp_path / "my_idea")


def test_experiment_of_the_template_measures_and_is_read_back(tmp_path: Path) -> None:
    run_afspm("new", "component", "my-idea", folder=tmp_path)
    folder = tmp_path / "my_idea"
    output = run_afspm("run", "experiment.toml", folder=folder)
    assert "measured: 6 scans" in output
    assert "the roughest is scan" in output
    with afspm.open_run(folder / "runs" / "latest") as night:
        assert [scan.shape for scan in night.scans] == [(128, 128)] * 6
    run_afspm("export", "--to", "csv", "--out", "out", folder=folder)
    assert list((folder / "out").iterdir())


def test_tests_of_the_template_of_a_component_pass(tmp_path: Path) -> None:
    run_afspm("new", "component", "my-idea", folder=tmp_path)
    run(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", folder=tmp_path / "my_idea")


def test_driver_of_the_template_passes_the_suite(tmp_path: Path) -> None:
    run_afspm("new", "driver", "my-scope", folder=tmp_path)
    # the check scan/duration is left out: it compares with the clock, and a busy computer fails it
    checks = [word for name in ("published", "frame", "parameter", "refused", "scan/order") for word in ("-k", name)]
    output = run_afspm("test-translator", "experiment.toml", *checks, folder=tmp_path / "my_scope")
    assert re.search(r"^[1-9]\d* passed", output, re.MULTILINE)
