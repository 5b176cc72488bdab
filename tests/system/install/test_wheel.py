"""What a new user meets: the wheel alone, in an environment of its own, far from the clone."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

ROOT = Path(__file__).parents[3]
BUILT_FROM = ("src", "proto", "experiments", "pyproject.toml", "hatch_build.py", "README.md", "LICENSE")
LOOK = """
import afspm
scope = afspm.connect(name="notebook")
scan = scope.scan(shape=(16, 20)).first
print(scope.state.name, scan.shape, float(scan.to_xarray().std()) > 0)
scan
"""


class Installed:
    """An environment with afspm from its wheel.

    Attributes:
        wheel: with its path; folder: of the environment.
    """

    def __init__(self, uv: str, wheel: Path, folder: Path) -> None:
        self._uv, self.wheel, self.folder = uv, wheel, folder
        self.bin = folder / ("Scripts" if os.name == "nt" else "bin")
        hidden = ("PYTHONPATH", "VIRTUAL_ENV", "PYTEST_CURRENT_TEST")
        self.environment = {name: value for name, value in os.environ.items() if name not in hidden}
        self.environment |= {"PATH": f"{self.bin}{os.pathsep}{os.environ['PATH']}", "COLUMNS": "200"}

    def add(self, *requirements: str) -> None:
        """Install more. Skips the test where that can't be had."""
        command = (self._uv, "pip", "install", "-q", "--python", str(self.folder), *requirements)
        done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
        if done.returncode != 0:
            pytest.skip(f"packages can't be had here: {done.stderr}")

    def run(self, *command: str, cwd: Path, code: int = 0) -> str:
        """Run a command of the environment, and return its output."""
        done = subprocess.run(
            command,
            cwd=cwd,
            env=self.environment,
            capture_output=True,
            encoding="utf-8",
            timeout=DEADLINE_S,
            check=False,
        )
        output = done.stdout + done.stderr
        assert done.returncode == code, output
        return output

    def start(self, *command: str, cwd: Path) -> subprocess.Popen[str]:
        return subprocess.Popen(
            command, cwd=cwd, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8"
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """afspm with its normal dependencies and nothing else."""
    beside = ROOT / "build/tools" / ("Scripts/uv.exe" if os.name == "nt" else "bin/uv")
    uv = shutil.which("uv") or (str(beside) if beside.exists() else None)
    if uv is None:
        pytest.skip("there is no uv, which installs quickly")
    folder = tmp_path_factory.mktemp("installed")
    subprocess.run([uv, "venv", "-q", "--python", sys.executable, folder / "venv"], check=True)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    probe = [uv, "pip", "install", "--dry-run", "-q", "--python", folder / "venv", *project["build-system"]["requires"]]
    if (probed := subprocess.run(probe, capture_output=True, encoding="utf-8", check=False)).returncode != 0:
        pytest.skip(f"packages can't be had here: {probed.stderr}")
    clone = folder / "clone"  # a build writes into the clone, in which other tests run
    for name in BUILT_FROM:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
        clone.mkdir(exist_ok=True)
        copy(ROOT / name, clone / name)
    subprocess.run([uv, "build", "--wheel", "-q", "-o", folder, clone], check=True)
    shutil.rmtree(clone)
    (wheel,) = folder.glob("*.whl")
    made = Installed(uv, wheel, folder / "venv")
    made.add(str(wheel))
    return made


def only_run(folder: Path) -> Path:
    """Return the folder of the one run in `runs`; beside it, `latest` leads to it."""
    (run,) = (one for one in (folder / "runs").iterdir() if (one / "run.json").exists() and not one.is_symlink())
    return run


@pytest.mark.skipif(sys.platform == "win32", reason="a console's Ctrl-C reaches all who share it")
@pytest.mark.parametrize("options", [(), ("--drift",)])
def test_the_demonstration_measures_and_leaves_a_report(
    installed: Installed, tmp_path: Path, options: tuple[str, ...]
) -> None:
    with installed.start("afspm", "demo", *options, cwd=tmp_path) as night:
        assert night.stdout is not None
        lines = []
        for line in night.stdout:
            lines.append(line)
            if "scan 2 of" in line:  # of how many depends on how many were missed
                night.send_signal(signal.SIGINT)
    output = "".join(lines)
    assert night.returncode == 130, output
    assert "A simulated night" in lines[0]
    for word in ("ERROR", "Traceback"):
        assert word not in output
    run = only_run(tmp_path)
    assert f"the report is {run / 'report.html'}" in output
    assert (run / "report.html").stat().st_size > 10_000
    assert len(list((run / "scans").glob("*.h5"))) >= 2


def test_missing_package_is_found_before_any_process_starts(installed: Installed, tmp_path: Path) -> None:
    installed.run("afspm", "new", "experiment", "night", cwd=tmp_path)
    folder = tmp_path / "night"
    (folder / "brief.toml").write_text(
        '[scheduler]\nclass = "DriftCompensatedScheduler"\ndrift = { estimator = "brief" }\n'
    )
    says = {
        ("run", "experiment.toml", "--dashboard"): 'pip install "afspm[dashboard]"',
        ("check", "experiment.toml", "brief.toml"): 'pip install "afspm[features]"',
        ("run", "experiment.toml", "brief.toml"): 'pip install "afspm[features]"',
    }
    for arguments, remedy in says.items():
        output = installed.run("afspm", *arguments, cwd=folder, code=1)
        assert "needs packages that are not installed" in output
        assert remedy in output
        assert "Traceback" not in output
    assert not (folder / "runs").exists()
    installed.run("afspm", "run", "experiment.toml", cwd=folder)
    output = installed.run("afspm", "dashboard", cwd=folder, code=1)  # the page of a night that is over
    assert 'pip install "afspm[dashboard]"' in output
    assert "Traceback" not in output


def test_a_notebook_joins_measures_and_shows_a_scan(installed: Installed, tmp_path: Path) -> None:
    installed.add(f"afspm[notebook] @ {installed.wheel.as_uri()}")
    installed.run("afspm", "new", "experiment", "night", cwd=tmp_path)
    folder = tmp_path / "night"
    cells: list[dict[str, Any]] = [
        {"cell_type": "code", "id": "a", "metadata": {}, "outputs": [], "execution_count": None, "source": LOOK}
    ]
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3"}}
    made = {"cells": cells, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}
    (folder / "look.ipynb").write_text(json.dumps(made), encoding="utf-8")
    frame = "series = { component = false }\nmetadata = { component = false }\n"
    (folder / "notebook.toml").write_text(frame)
    with installed.start("afspm", "run", "experiment.toml", "notebook.toml", cwd=folder) as night:
        assert night.stdout is not None
        assert any("processes, into" in line for line in night.stdout)
        installed.run("jupyter", "execute", "--inplace", "look.ipynb", cwd=folder)
        installed.run("afspm", "end", "--yes", cwd=folder)
        assert night.wait(DEADLINE_S) == 0, night.stdout.read()
    (cell,) = json.loads((folder / "look.ipynb").read_text(encoding="utf-8"))["cells"]
    text, shown = cell["outputs"]
    assert "FREE (16, 20) True" in "".join(text["text"])
    assert "text/html" in shown["data"] or "image/png" in shown["data"]
