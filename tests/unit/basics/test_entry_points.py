"""A laboratory's own package joins by its installation alone."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from deadlines import DEADLINE_S
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from site_folder import EXAMPLE_MAKER, EXAMPLE_PLUGIN, install

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError, FileError
from afspm.experiment import load
from afspm.model import Region
from afspm.plugins.drift.estimators import estimator
from afspm.plugins.drift.registration import DriftScan
from afspm.storage.formats import netcdf, read

EXPERIMENT = """
[clock]
speed = 2000.0

[microscope]
component = true
class = "ExampleScope"

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [16, 16]

[counter]
component = true
class = "ExampleCounter"
scans = 2
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = tmp_path / "site"
    folder.mkdir()
    install(EXAMPLE_PLUGIN, folder)
    monkeypatch.syspath_prepend(folder)
    entry_points.forget()
    yield folder
    entry_points.forget()
    for name in [name for name in sys.modules if name.partition(".")[0] in ("example_plugin", "example_maker")]:
        del sys.modules[name]


def afspm(site: Path, *arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, "-m", "afspm", *arguments]
    return subprocess.run(command, env=environment, cwd=cwd, capture_output=True, encoding="utf-8", timeout=DEADLINE_S)


def test_an_experiment_file_names_drivers_and_components_of_a_plug_in(site: Path, tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT)
    experiment = load(file)
    assert not experiment.check()
    paths = {name: process.class_path for name, process in experiment.resolved.processes.items()}
    assert paths["microscope"] == "example_plugin.scope.ExampleScope"
    assert paths["counter"] == "example_plugin.counter.ExampleCounter"


@pytest.mark.slow  # a whole experiment, as in `make test-all`
def test_an_experiment_with_a_plug_in_runs(site: Path, tmp_path: Path) -> None:
    (tmp_path / "experiment.toml").write_text(EXPERIMENT)
    done = afspm(site, "run", "experiment.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "counted by the plug-in" in done.stdout + done.stderr


def test_a_file_is_read_by_the_reader_of_a_plug_in(site: Path, tmp_path: Path) -> None:
    file = tmp_path / "scan.example"
    np.savetxt(file, np.arange(6.0).reshape(2, 3))
    (scan,) = read(file).scans
    assert scan.shape == (2, 3)


def test_unknown_suffix_is_refused_with_the_known_ones(site: Path, tmp_path: Path) -> None:
    file = tmp_path / "scan.other"
    file.touch()
    with pytest.raises(FileError) as refused:
        read(file)
    assert ".ibw" in refused.value.hint
    assert ".example" in refused.value.hint


def test_drift_is_estimated_by_the_estimator_of_a_plug_in(site: Path) -> None:
    scan = DriftScan(np.zeros((4, 4)), Region((1e-6, 0.0), (1e-6, 1e-6)), 0.0, 1.0)
    found = estimator("standstill").register(scan, scan)
    assert found.accepted
    assert not found.displacement_m.any()


def test_a_command_of_a_plug_in_is_run_and_a_broken_one_spoils_nothing(site: Path) -> None:
    done = afspm(site, "example-hello", "--name", "world")
    assert done.stdout == "hello world\n", done.stderr
    broken = afspm(site, "example-broken")
    assert broken.returncode == 1
    assert "'example-broken' of the package example-plugin can't be loaded" in broken.stderr


def test_undeclared_name_is_none() -> None:
    assert entry_points.find("example", entry_points.READERS) is None
    assert entry_points.load(entry_points.READERS, "example") is None


def test_name_declared_by_two_packages_is_refused(site: Path) -> None:
    declare(site, "[afspm.readers]\nexample = other_plugin:read\n")
    with pytest.raises(ConfigError, match="several packages: example-plugin, other-plugin"):
        entry_points.load(entry_points.READERS, "example")


@pytest.mark.parametrize("group", ["afspm.drivers", "afspm.components"])
def test_afspms_name_declared_by_another_package_is_refused_with_both(group: str, site: Path, tmp_path: Path) -> None:
    declare(site, f"[{group}]\nSimulator = other_plugin:Simulator\n")
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT.replace("ExampleScope", "Simulator"))
    (error,) = (one for one in load(file).check() if "class" in one.what)
    assert "'Simulator' is offered by several packages: afspm, other-plugin" in error.what
    assert "uninstall" in error.hint


def test_names_that_no_clash_concerns_stay_usable(site: Path) -> None:
    declare(site, "[afspm.drivers]\nSimulator = other_plugin:Simulator\n")
    assert entry_points.class_path("Nanonis") == "afspm.plugins.nanonis.Nanonis"


def test_everything_that_afspm_declares_can_be_loaded() -> None:
    ours = [one for one in entry_points.inventory() if one.package.startswith("afspm ")]
    of_packages = {entry_points.FUNCTIONS, entry_points.DRIFT_COMMANDS, entry_points.PAGE_PARTS}
    assert {one.group for one in ours} == set(entry_points.GROUPS) - of_packages
    assert [one for one in ours if one.problem] == []


def test_everything_that_afspm_declares_can_be_loaded_without_extras() -> None:
    wanted = (Requirement(text) for text in metadata.requires("afspm") or ())
    of_extras = {canonicalize_name(one.name) for one in wanted if one.marker and "extra" in str(one.marker)} - {"afspm"}
    owners = metadata.packages_distributions().items()
    modules = sorted(module for module, names in owners if of_extras & {*map(canonicalize_name, names)})
    assert "bluesky" in modules
    look = f"""
import sys
sys.modules.update(dict.fromkeys({modules}))
from afspm.basics import entry_points
print([one for one in entry_points.inventory() if one.package.startswith("afspm ") and one.problem])
"""
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, encoding="utf-8", timeout=DEADLINE_S)
    assert done.stdout == "[]\n", done.stdout + done.stderr


def test_inventory_lists_unusable_names_with_reasons(site: Path) -> None:
    declare(site, "[afspm.driver]\nNew = other_plugin:New\n[afspm.commands]\nrun = other_plugin:run\n")
    problems = {one.name: one for one in entry_points.inventory(["run"]) if one.problem}
    assert problems.keys() == {"example-broken", "New", "run"}
    assert problems["New"].package == "other-plugin 1.0"
    assert "no such group" in problems["New"].problem
    assert "ModuleNotFoundError" in problems["example-broken"].problem
    assert problems["run"].problem == "afspm has a command of this name"


def test_command_of_afspm_is_not_replaced_and_doctor_says_so(site: Path) -> None:
    declare(site, "[afspm.commands]\ncheck = example_plugin.commands:hello\n")
    assert "Find every error" in afspm(site, "check", "--help").stdout
    done = afspm(site, "doctor", "--json")
    found = {(one["where"], one["severity"]): one["what"] for one in json.loads(done.stdout)["found"]}
    assert found["other-plugin 1.0", "warning"] == "afspm.commands check: afspm has a command of this name"
    assert "can't be loaded" in found["example-plugin 1.0", "warning"]
    assert any("ExampleScope" in one["what"] for one in json.loads(done.stdout)["found"])
    assert done.returncode == 0  # no experiment needs these


def test_metadata_of_the_installed_packages_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    read_times = 0
    read = metadata.distributions

    def counted() -> Iterable[metadata.Distribution]:
        nonlocal read_times
        read_times += 1
        return read()

    monkeypatch.setattr(metadata, "distributions", counted)
    entry_points.forget()
    for name in ("Simulator", "Scheduler", "Nanonis"):
        assert entry_points.class_path(name) is not None
    assert entry_points.names(entry_points.READERS)
    assert read_times == 1


def test_suffix_of_several_makers_is_read_by_the_reader_that_knows_the_file(site: Path, tmp_path: Path) -> None:
    install(EXAMPLE_MAKER, site)
    declare(site, "[afspm.readers]\nnc.0 = missing:read\n")  # faults 5: it can't be loaded, and comes first
    file = tmp_path / "scan.nc"
    file.write_bytes(netcdf.encoded({}, {"program": "Acme", "version": "1"}))
    assert read(file).header["version"] == "1"
    file.write_bytes(netcdf.encoded({}, {"program": "another"}))
    with pytest.raises(FileError, match=r"'nc\.0' of the package other-plugin can't be loaded"):
        read(file)
    shutil.rmtree(site / "other_plugin-1.0.dist-info")
    entry_points.forget()
    with pytest.raises(FileError, match="neither by GXSM nor"):
        read(file)


METADATA = "Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"


def declare(site: Path, lines: str | bytes, name: str = "other-plugin", metadata: str | None = METADATA) -> None:
    """Install a package that only declares names."""
    info = site / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    if metadata is not None:
        (info / "METADATA").write_text(metadata.format(name=name))
    (info / "entry_points.txt").write_bytes(lines if isinstance(lines, bytes) else lines.encode())
    entry_points.forget()


@pytest.fixture
def ill(site: Path) -> Path:
    """A folder with packages that can't be imported or read."""
    (site / "leaving.py").write_text("raise SystemExit(7)\n")
    (site / "raising.py").write_text("raise RuntimeError('no form today')\n")
    declare(site, "[afspm.commands]\nleave = leaving:app\nnumber = math:pi\n", "leaving")
    declare(site, "[afspm.forms]\nform = raising:FORM\n", "raising")
    declare(site, "[afspm.components]\nLine without a value\n", "half-a-line")
    declare(site, "[afspm.components]\nOdd = no module!\nGood = example_plugin.counter:ExampleCounter\n", "odd-value")
    declare(site, "[afspm.readers]\nx = leaving:read\n", "without-metadata", metadata=None)
    declare(site, "[afspm.readers]\nx = leaving:read\n", "without-name", metadata="Metadata-Version: 2.1\n")
    declare(site, b"[afspm.readers]\n\xff = leaving:read\n", "latin")
    declare(site, "[afspm.readers]\nsxm = leaving:read\n", "second-reader")
    return site


# faults 5
def test_packages_that_cannot_be_used_are_named_and_all_else_goes_on(ill: Path, tmp_path: Path) -> None:
    (tmp_path / "experiment.toml").write_text(EXPERIMENT.replace("ExampleCounter", "Good"))
    shown = afspm(ill, "--help")
    assert shown.returncode == 0, shown.stdout + shown.stderr
    assert "example-hello" in shown.stdout
    left = afspm(ill, "leave")
    assert left.returncode == 1
    assert "'leave' of the package leaving can't be loaded: SystemExit: 7" in left.stderr
    checked = afspm(ill, "check", "experiment.toml", "--json", cwd=tmp_path)
    assert (checked.returncode, json.loads(checked.stdout)) == (0, []), checked.stdout + checked.stderr

    done = afspm(ill, "doctor", "--json")
    found = json.loads(done.stdout)["found"]
    problems = {Path(one["where"]).name: one["what"] for one in found if one["severity"] == "warning"}
    expected = {
        "leaving 1.0": "SystemExit: 7", "raising 1.0": "RuntimeError: no form today",
        "half_a_line-1.0.dist-info": "its metadata can't be read", "odd-value": "'no module!' is not of the form",
        "without_metadata-1.0.dist-info": "its metadata can't be read",
        "without_name-1.0.dist-info": "its metadata can't be read",
        "latin-1.0.dist-info": "UnicodeDecodeError", "second-reader 1.0": "afspm declares this name, too",
    }  # fmt: skip
    assert {name: words for name, words in expected.items() if words not in problems.get(name, "")} == {}
    assert done.returncode == 0


def test_experiment_that_may_need_an_unusable_package_names_it(ill: Path, tmp_path: Path) -> None:
    (tmp_path / "experiment.toml").write_text(EXPERIMENT.replace("ExampleCounter", "Odd"))
    checked = afspm(ill, "check", "experiment.toml", "--json", cwd=tmp_path)
    found = json.loads(checked.stdout)
    assert checked.returncode == 1
    assert [one["level"] for one in found] == ["error", "warning"]
    assert "there is no ready-made class 'Odd'" in found[0]["what"]
    assert "the package odd-value: 'no module!' is not of the form module:object" in found[0]["hint"]
    assert "'form' of the package raising can't be loaded" in found[1]["what"]


def test_second_reader_of_a_suffix_leaves_afspms_in_use(ill: Path) -> None:
    assert entry_points.load(entry_points.READERS, "sxm").__module__.startswith("afspm.")


def test_of_two_versions_of_a_package_the_first_in_the_path_is_used(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    declare(site, "[afspm.readers]\nold = other_plugin:read\n")
    newer = tmp_path / "newer"
    newer.mkdir()
    declare(newer, "[afspm.readers]\nnew = other_plugin:read\n")
    monkeypatch.syspath_prepend(newer)
    entry_points.forget()
    assert entry_points.find("new", entry_points.READERS) is not None
    assert entry_points.find("old", entry_points.READERS) is None
