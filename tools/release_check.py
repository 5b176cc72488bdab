"""Builds the distributions and tries them as users get them: `make release-check`. Publishes nothing.

`python tools/release_check.py [--tag v1.2.3] [STEP …]` runs the named steps, by default all of them, in this order:

    build      the sdist of the tracked files, and the wheel of the sdist, into build/release/dist
    metadata   the metadata, strictly; with --tag also that version, changelog and tag agree
    contents   the files of both, compared with tools/release_contents.toml
    wheel      the wheel in a new environment: afspm doctor, afspm demo, the packagers' tests (tests/installed)
    sdist      the same for the sdist
    plug-ins   packages from outside the tree, installed beside the wheel: a driver, a component, their own tests

Each step but `build` takes the distributions that are in build/release/dist, so that a release tries the files that it
publishes. `metadata` needs twine (`python tools/bootstrap.py release`), the others nothing but Python.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import bootstrap
import changelog

ROOT = Path(__file__).resolve().parents[1]
RELEASE = ROOT / "build" / "release"
DIST = RELEASE / "dist"
CONTENTS = ROOT / "tools" / "release_contents.toml"
EXAMPLES = ROOT / "tests" / "support"
NIGHT = """
[clock]
speed = 60.0

[scope]
component = true
class = "LabScope"

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["500 nm", "500 nm"]
pixels = [32, 32]

[counter]
component = true
class = "ExampleCounter"
scans = 2
"""
"""The components of two plug-ins by their declared names; the component of one ends the night."""
TIMELESS = [
    word
    for name in ("published", "frame", "parameter", "refused", "scan/order", "scan/picture")
    for word in ("-k", name)
]
"""Checks of a driver; others compare the duration of a scan with the clock, which a busy computer fails."""


class Failed(Exception):
    """A step found a fault."""


def project() -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return table


def tracked(root: Path = ROOT) -> list[str]:
    """Return the tracked files, which are all that a commit has."""
    found = subprocess.run(
        ["git", "ls-files", "-z"], cwd=root, capture_output=True, encoding="utf-8", check=True
    ).stdout
    return [name for name in found.split("\0") if name and (root / name).is_file()]


def distribution(kind: str) -> Path:
    """Return the one built file of a kind, "wheel" or "sdist"."""
    found = sorted(DIST.glob("*.whl" if kind == "wheel" else "*.tar.gz"))
    if len(found) != 1:
        raise Failed(f"{DIST} has {len(found)} files of the kind {kind}, and must have one; run the step `build`")
    return found[0]


def build(tag: str | None) -> None:
    """Build from a copy of the tracked files, so that nothing else in the clone can get in."""
    shutil.rmtree(RELEASE, ignore_errors=True)
    source = RELEASE / "source"
    for name in tracked():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, source / name)
    call(bootstrap.find_uv(), "build", "--quiet", "--out-dir", DIST, source)
    shutil.rmtree(source)
    (DIST / ".gitignore").unlink(missing_ok=True)


def metadata(tag: str | None) -> None:
    call(sys.executable, "-m", "twine", "check", "--strict", distribution("wheel"), distribution("sdist"))
    version = project()["version"]
    for kind in ("wheel", "sdist"):
        if f"-{version}" not in distribution(kind).name:
            raise Failed(
                f"{distribution(kind).name} is not of version {version} of pyproject.toml; run the step `build`"
            )
    if tag is not None:
        check_tag(tag, version)


def check_tag(tag: str, version: str, root: Path = ROOT) -> None:
    """Refuse a tag that is not that of the version, and a changelog that was not made for it."""
    if tag != f"v{version}":
        raise Failed(
            f"the tag is {tag}, and pyproject.toml has version {version}: tag v{version}, or raise the version"
        )
    newest = re.search(r"^## \[(.+?)\]", (root / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    if newest is None or newest[1] != version:
        raise Failed(f"CHANGELOG.md has no section of {version} at its head; run `make changelog`, and commit")
    if left := changelog.fragments(root / "changes"):
        raise Failed(f"{len(left)} fragments are in changes/, {left[0].name} first; run `make changelog`, and commit")


def contents(tag: str | None) -> None:
    lists = tomllib.loads(CONTENTS.read_text(encoding="utf-8"))
    wheel, sdist = distribution("wheel"), distribution("sdist")
    with zipfile.ZipFile(wheel) as archive:
        found = {"wheel": [name for name in archive.namelist() if not name.endswith("/")]}
    with tarfile.open(sdist) as tar:
        top = f"{sdist.name.removesuffix('.tar.gz')}/"
        found["sdist"] = [one.name.removeprefix(top) for one in tar.getmembers() if not one.isdir()]
    wrong = []
    for kind, file in (("wheel", wheel), ("sdist", sdist)):
        wrong += faults(lists[kind], tracked(), found[kind], project()["version"])
        if file.stat().st_size > lists[kind]["at_most_mb"] * 1e6:
            wrong.append(
                f"{file.name} has {file.stat().st_size / 1e6:.1f} MB, more than {lists[kind]['at_most_mb']} MB"
            )
    if wrong:
        raise Failed("\n".join([*wrong, f"the list is {CONTENTS.relative_to(ROOT).as_posix()}"]))


def faults(listed: Mapping[str, Any], files: list[str], found: list[str], version: str) -> Iterator[str]:
    """Yield the differences of a distribution from its list.

    Args:
        listed: a table of tools/release_contents.toml.
        files: the tracked files.
        found: the files of the distribution.
        version: of the distribution.
    """
    expected = {
        re.sub(rf"^{re.escape(source)}(?=/|$)", target, name)
        for source, target in listed["folders"].items()
        for name in files
        if (name == source or name.startswith(f"{source}/")) and PurePosixPath(name).name not in listed["left_out"]
    }
    protos = [PurePosixPath(name).stem for name in files if name.startswith("proto/") and name.endswith(".proto")]
    for folder, names in listed["made"].items():
        for name in names:
            for proto in protos if "{proto}" in name else [""]:
                made = name.replace("{proto}", proto)
                expected.add(f"{folder}/{made}".lstrip("/").replace("{version}", version))
    yield from (f"missing: {name}" for name in sorted(expected - set(found)))
    yield from (f"not in the list: {name}" for name in sorted(set(found) - expected))
    yield from (f"{count} times: {name}" for name, count in sorted(Counter(found).items()) if count > 1)
    for name in sorted(expected & set(found)):
        if PurePosixPath(name).suffix not in listed["suffixes"] and ".dist-info/" not in name:
            yield f"a file of a kind that is not in the list: {name}"


class Installed:
    """A new environment with afspm from one of its distributions."""

    def __init__(self, file: Path, folder: Path) -> None:
        self._uv = bootstrap.find_uv()
        self.folder = folder
        self._environment = folder / "environment"
        self.bin = self._environment / ("Scripts" if os.name == "nt" else "bin")
        call(self._uv, "venv", "--quiet", "--python", sys.executable, self._environment)
        self.add(f"afspm[testing] @ {file.as_uri()}")

    def add(self, *requirements: str | Path) -> None:
        call(self._uv, "pip", "install", "--quiet", "--python", self._environment, *requirements)
        call(self._uv, "pip", "check", "--quiet", "--python", self._environment)

    def run(self, program: str, *arguments: str | Path, folder: Path | None = None) -> str:
        """Run a program of the environment, far from the clone, and return its output."""
        hidden = ("PYTHONPATH", "PYTHONWARNINGS", "VIRTUAL_ENV")
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        environment["PATH"] = f"{self.bin}{os.pathsep}{os.environ['PATH']}"
        output = call(self.bin / program, *arguments, folder=folder or self.folder, environment=environment)
        if "Traceback" in output:
            raise Failed(f"{program} {' '.join(map(str, arguments))} prints a traceback:\n{output}")
        return output


def wheel(tag: str | None) -> None:
    _try(distribution("wheel"))


def sdist(tag: str | None) -> None:
    _try(distribution("sdist"))


def _try(file: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="afspm-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        installed = Installed(file, folder)
        installed.run("afspm", "doctor")
        with tarfile.open(distribution("sdist")) as tar:  # a wheel has no tests
            tar.extractall(folder / "unpacked", filter="data")
        (tests,) = (folder / "unpacked").glob("*/tests/installed")
        shutil.copytree(tests, folder / "tests")
        installed.run("python", "-m", "pytest", "tests")
        installed.run("afspm", "demo")
        if not list(folder.glob("runs/*/report.html")):
            raise Failed("afspm demo left no report.html")


def plug_ins(tag: str | None) -> None:
    with tempfile.TemporaryDirectory(prefix="afspm-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        installed = Installed(distribution("wheel"), folder)
        for example in ("example_maker", "example_plugin"):
            shutil.copytree(EXAMPLES / example, folder / example, ignore=shutil.ignore_patterns("__pycache__"))
        installed.run("afspm", "new", "driver", "lab-scope")
        installed.run("afspm", "new", "component", "lab-watch")
        installed.add(*(folder / package for package in ("example_maker", "example_plugin", "lab_scope")))
        # one declaration of the example is broken on purpose, for which doctor ends with 1
        declared = subprocess.run(
            [installed.bin / "afspm", "doctor"], capture_output=True, encoding="utf-8", cwd=folder
        )
        for declaration in (
            "example-maker 2.0: drivers Acme",
            "example-plugin 1.0: components ExampleCounter",
            "LabScope",
        ):
            if declaration not in declared.stdout:
                raise Failed(f"afspm doctor does not list {declaration}:\n{declared.stdout}{declared.stderr}")
        emulated = folder / "example_maker" / "example_maker" / "emulated.toml"
        installed.run("afspm", "test-translator", emulated, "--frame", "500 nm", *TIMELESS)
        installed.run("python", "-m", "pytest", "-q", folder=folder / "lab_scope")
        installed.run("python", "-m", "pytest", "-q", folder=folder / "lab_watch")
        (folder / "night.toml").write_text(NIGHT, encoding="utf-8")
        installed.run("afspm", "run", "night.toml")


STEPS: dict[str, Callable[[str | None], None]] = {
    "build": build,
    "metadata": metadata,
    "contents": contents,
    "wheel": wheel,
    "sdist": sdist,
    "plug-ins": plug_ins,
}


def call(*command: str | Path, folder: Path = ROOT, environment: Mapping[str, str] | None = None) -> str:
    """Run a command; return its output, or raise Failed with it."""
    done = subprocess.run(
        list(map(str, command)),
        cwd=folder, env=environment, capture_output=True, encoding="utf-8", errors="replace", check=False,
    )  # fmt: skip
    output = done.stdout + done.stderr
    if done.returncode != 0:
        raise Failed(f"{' '.join(map(str, command))} ended with {done.returncode}:\n{output}")
    return output


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("steps", nargs="*", metavar="STEP", help=f"of {', '.join(STEPS)}; by default all")
    parser.add_argument("--tag", help="the tag of the release, such as v0.2.0")
    given = parser.parse_args(arguments)
    if unknown := [step for step in given.steps if step not in STEPS]:
        parser.error(f"there is no step {unknown[0]}; there are {', '.join(STEPS)}")
    for name, step in STEPS.items():
        if not given.steps or name in given.steps:
            try:
                step(given.tag)
            except Failed as failed:
                sys.stderr.write(f"FAILED {name}: {failed}\n")
                return 1
            sys.stdout.write(f"passed {name}\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
