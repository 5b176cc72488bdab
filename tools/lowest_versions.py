"""Runs tests with the lowest versions of all dependencies that pyproject.toml allows: `make test-lowest`.

build/lowest-env gets afspm with its extras, each direct dependency in its lowest version, and the newest packages that
only tests need. The tests run only if each lower bound is installed: a bound below the version that another dependency
needs would not be tested.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import bootstrap

FOLDER = bootstrap.ROOT / "build" / "lowest-env"
PYTHON = "3.11"
"""The lowest version of Python, for which the lowest versions of all packages have wheels."""
OWN_WARNINGS = ("DeprecationWarning", "PendingDeprecationWarning", "FutureWarning")
"""Errors where afspm raises them. Old and new packages warn of each other, which is nothing that afspm can mend."""


def main(arguments: list[str]) -> int:
    """Make the environment, check the bounds, and run pytest; return its exit code."""
    if arguments == ["--bounds"]:
        return _check_bounds()
    programs = FOLDER / ("Scripts" if os.name == "nt" else "bin")
    uv = bootstrap.find_uv()
    environment = {**os.environ, "UV_PYTHON_DOWNLOADS": "never"}
    if subprocess.run([uv, "python", "find", "--quiet", PYTHON], env=environment, check=False).returncode != 0:
        sys.stdout.write(f"nothing was tried: there is no Python {PYTHON} on this computer\n")
        return 0 if os.environ.get("AFSPM_LACKING") == "passes" else 1
    sys.stdout.write(f"Setting up {FOLDER}: 700 MB …\n")
    sys.stdout.flush()
    # made again each time: an installed version that is high enough would not be lowered
    subprocess.run([uv, "venv", "--quiet", "--clear", "--python", PYTHON, FOLDER], env=environment, check=True)
    install = (uv, "pip", "install", "--quiet", "--python", programs / "python")
    extras = ",".join(bootstrap.extras())
    subprocess.run([*install, "--resolution", "lowest-direct", "-e", f".[{extras}]"], cwd=bootstrap.ROOT, check=True)
    subprocess.run([*install, "--group", "test"], cwd=bootstrap.ROOT, check=True)
    subprocess.run([programs / "python", Path(__file__).resolve(), "--bounds"], check=True)
    warnings = "\n".join(["default", *(f"error::{one}:afspm" for one in OWN_WARNINGS)])
    # processes that the tests start get no filter either
    environment = {**os.environ, "PYTHONWARNINGS": "", "PYTHONDONTWRITEBYTECODE": ""}
    pytest = (programs / "pytest", "-p", "no:cacheprovider", "-o", f"filterwarnings={warnings}")
    return subprocess.run([*pytest, *arguments], cwd=bootstrap.ROOT, env=environment, check=False).returncode


def _check_bounds() -> int:
    # in the environment itself, since packaging is among the dependencies
    from importlib.metadata import version

    from packaging.requirements import Requirement
    from packaging.version import Version

    project = tomllib.loads((bootstrap.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    of_extras = [one for extra in bootstrap.extras() for one in project["optional-dependencies"][extra]]
    untested = []
    for requirement in map(Requirement, [*project["dependencies"], *of_extras]):
        if requirement.name == project["name"]:
            continue
        installed = Version(version(requirement.name))
        (bound,) = (one.version for one in requirement.specifier if one.operator in (">=", "=="))
        if installed != Version(bound):
            what = f"{requirement.name}>={bound} is not tested, because {installed} is installed"
            untested.append(f"{what}: raise the bound to it in pyproject.toml")
    sys.stdout.write("".join(f"{line}\n" for line in untested))
    return bool(untested)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
