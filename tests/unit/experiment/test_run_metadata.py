"""[metadata]: entries in the files of a run, from the experiment file and from the microscope's class."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.experiment import load

SIMULATOR = (
    '[microscope]\ncomponent = true\nclass = "Simulator"\n\n[scheduler]\ncomponent = true\nclass = "Scheduler"\n'
)
ASYLUM = SIMULATOR.replace("Simulator", "Asylum")
NANONIS = SIMULATOR.replace("Simulator", "Nanonis")


def metadata(folder: Path, text: str) -> dict[str, str]:
    file = folder / "e.toml"
    file.write_text(text, encoding="utf-8")
    return load(file).resolved.metadata()


@pytest.mark.parametrize(("text", "technique"), [(SIMULATOR, "AFM"), (ASYLUM, "AFM"), (NANONIS, None)])
def test_metadata_come_from_the_class_of_the_microscope(tmp_path: Path, text: str, technique: str | None) -> None:
    told = metadata(tmp_path, text)
    assert told.get("technique") == technique
    assert told["vendor"]
    assert told["software"]


def test_run_of_a_controller_has_what_that_never_shows(tmp_path: Path) -> None:
    file = tmp_path / "e.toml"
    shown = '[microscope.parameters.x-engaged]\nvendor = "tip"\ntype = "bool"\n'
    found = []
    for text in (SIMULATOR, SIMULATOR.replace("Simulator", "Park"), SIMULATOR.replace("Simulator", "Park") + shown):
        file.write_text(text, encoding="utf-8")
        found.append(load(file).resolved.never_shown())
    assert found[0] == {}
    assert found[1].pop("tip at the sample") == "x-engaged can't be read"
    assert found[1] == found[2] != {}


def test_metadata_of_the_file_override_the_class(tmp_path: Path) -> None:
    said = '[metadata]\ntechnique = "STM"\nvendor = "Unisoku"\nsample = "Au(111)"\norcid = "0000-0002-1694-233X"\n\n'
    told = metadata(tmp_path, said + NANONIS)
    assert (told["technique"], told["vendor"], told["sample"]) == ("STM", "Unisoku", "Au(111)")
    assert told["orcid"] == "https://orcid.org/0000-0002-1694-233X"
    assert told["software"] == "Nanonis"


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ('orcid = "0000-0002-1825-0098"', "its last digit does not match"),
        ('orcid = "1825"', "looks like 0000-0002-1825-0097"),
        ('technique = "SEM"', "'STM', 'STS' or 'AFM'"),
        ('smaple = "Au"', "did you mean 'sample'?"),
    ],
)
def test_invalid_metadata_are_refused(tmp_path: Path, line: str, why: str) -> None:
    file = tmp_path / "e.toml"
    file.write_text(f"[metadata]\n{line}\n\n{SIMULATOR}", encoding="utf-8")
    (finding,) = load(file).check()
    assert finding.is_error
    assert why in str(finding)
