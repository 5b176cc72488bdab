"""Make the environment .venv from the lock file, with nothing but Python 3.11 or later.

Run by the Makefile: `python3 tools/bootstrap.py demo` (what a plain install holds), `test` (and what the tests need),
`packages` (and the packages of `make test-packages`), `all` (and the tools of `make check`), `browser` (what drives
one, and as root on Debian chromium itself), `gateway` (its judge), `coverage` or `release` (what judges the
distributions). Each adds to what is there. The name of a package of `packages/` makes an environment of its own in the
package's folder, with what its tests need.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
PACKAGES = ROOT / "packages"
TOOLS = ROOT / "build" / "tools"
UV_VERSION = "uv>=0.5,<1"
NOT_TESTED = {"all", "formats", "notebook"}
"""The extras that are not installed for the tests: these install Jupyter where they need it, and write a converter."""


def main(wanted: str) -> None:
    if sys.version_info < (3, 11):  # noqa: UP036  (it is run by whatever python3 there is)
        sys.exit(f"afspm needs Python 3.11 or later, this is {sys.version.split()[0]}")
    if (PACKAGES / wanted).is_dir():
        _sync(f"--package={wanted}", "--group=test", venv=PACKAGES / wanted / ".venv")
        _compile(PACKAGES / wanted / ".venv")
        return
    is_new = not VENV.exists()
    _sync("--group=pip")
    if is_new or wanted == "demo":
        _compile()
    if wanted != "demo":
        if wanted == "browser" and not (_has_browser() or (_apt_installs("chromium") and _has_browser())):
            sys.exit("no chromium is found: `apt install chromium`, or AFSPM_CHROMIUM=/path says where one is")
        groups = ["test", *(["browser"] if _has_browser() else [])]
        groups += ["packages", "check"] if wanted == "all" else []
        groups += [wanted] if wanted in ("coverage", "gateway", "packages", "release") else []
        _sync(*(f"--group={group}" for group in ["pip", *groups]), *(f"--extra={extra}" for extra in extras()))


def extras() -> list[str]:
    """Return the extras that are installed for the tests."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return sorted(project["optional-dependencies"].keys() - NOT_TESTED)


def _sync(*options: str, venv: Path = VENV) -> None:
    uv = find_uv()
    environment = {**os.environ, "UV_PROJECT_ENVIRONMENT": str(venv), "UV_PYTHON_DOWNLOADS": "never"}
    environment.pop("VIRTUAL_ENV", None)
    command = [uv, "sync", "--frozen", "--inexact", "--python", sys.executable, "--quiet", "--no-default-groups"]
    if subprocess.run([*command, *options], cwd=ROOT, env=environment).returncode != 0:
        sys.exit("the environment could not be made: see above")


def environment_of(name: str, package: str) -> Path:
    """Return the folder of programs of the environment build/<name>-env, made if it is not there, with one package.

    It is for what is tried with afspm's files, and is not installed beside afspm.
    """
    folder = ROOT / "build" / f"{name}-env"
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    if not (folder / package).exists():
        sys.stdout.write(f"Setting up {folder} with {package} …\n")
        uv = find_uv()
        subprocess.run([uv, "venv", "--quiet", "--clear", "--python", sys.executable, folder], check=True)
        subprocess.run([uv, "pip", "install", "--quiet", "--python", programs / "python", package], check=True)
        (folder / package).touch()  # so that one that was not finished is made anew
    return programs


def _has_browser() -> bool:
    """Return whether there is a browser for the tests of the page: what drives it is a sixth of all."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return bool(os.environ.get("AFSPM_CHROMIUM")) or any(map(shutil.which, names))


def _compile(venv: Path = VENV) -> None:
    """Compile what an experiment imports now, as pip would and uv does not: it starts many processes, and where Python
    may not keep what it compiled (PYTHONDONTWRITEBYTECODE), each would spend most of its start on compiling again."""
    python = venv / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    packages = "import sysconfig; print(sysconfig.get_path('purelib'))"
    folder = subprocess.run([str(python), "-c", packages], capture_output=True, text=True, check=True).stdout.strip()
    # the tests of packages are not imported; what can't be compiled is a template for another Python
    skipped = ("-x", r"site-packages[/\\].*[/\\]tests?[/\\]")
    subprocess.run([python, "-m", "compileall", "-qq", "-j", "0", *skipped, folder, ROOT / "src"], check=False)


def find_uv() -> str:
    """Return the uv of this computer, or one in an environment of its own, made with the standard library's venv."""
    if found := shutil.which("uv"):
        return found
    folder = TOOLS / ("Scripts" if os.name == "nt" else "bin")
    uv = folder / ("uv.exe" if os.name == "nt" else "uv")
    if not uv.exists():
        _make_venv()
        subprocess.run([str(folder / "python"), "-m", "pip", "install", "--quiet", UV_VERSION], check=True)
    return str(uv)


def _make_venv() -> None:
    if subprocess.run([sys.executable, "-m", "venv", "--clear", str(TOOLS)], capture_output=True).returncode == 0:
        return
    # Debian keeps what venv needs in a package of its own
    package = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
    if not _apt_installs(package):
        sys.exit(f"Python's venv module is incomplete here; on Debian: apt install {package}")
    subprocess.run([sys.executable, "-m", "venv", "--clear", str(TOOLS)], check=True)


def _apt_installs(package: str) -> bool:
    """Return whether this process may install packages of Debian, and has installed this one."""
    if not (shutil.which("apt-get") and hasattr(os, "geteuid") and os.geteuid() == 0):
        return False
    subprocess.run(["apt-get", "update", "-qq"], check=False)
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    install = ["apt-get", "install", "-y", "-qq", package]
    return subprocess.run(install, env=environment, check=False).returncode == 0


def _wanted(arguments: list[str]) -> str:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "wanted",
        nargs="?",
        default="all",
        choices=(
            "demo",
            "test",
            "all",
            "browser",
            "gateway",
            "coverage",
            "packages",
            "release",
            *(one.parent.name for one in PACKAGES.glob("*/pyproject.toml")),
        ),
    )
    return str(parser.parse_args(arguments).wanted)


if __name__ == "__main__":
    main(_wanted(sys.argv[1:]))
