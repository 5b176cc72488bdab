"""`replaces = true`: a table of a further file stands in place of the one before."""

from __future__ import annotations

from pathlib import Path

from afspm.experiment import document, load

SAMPLE = """
[clock]
speed = 60.0
[microscope]
component = true
class = "Simulator"
seed = 3
feedback = { mode = "current" }
"""


def laid_over(folder: Path, above: str) -> document.Document:
    for name, text in {"sample.toml": SAMPLE, "above.toml": above}.items():
        (folder / name).write_text(text, encoding="utf-8")
    return document.read([folder / "sample.toml", folder / "above.toml"])


def test_table_that_replaces_keeps_nothing_of_the_one_before(tmp_path: Path) -> None:
    found = laid_over(tmp_path, '[clock]\nreplaces = true\n[microscope]\nreplaces = true\nclass = "Nanonis"\n')
    assert found.data == {"clock": {}, "microscope": {"class": "Nanonis"}}
    assert str(found.place("microscope", "class")).endswith("above.toml:5")


def test_inner_table_replaces_alone_and_others_are_merged(tmp_path: Path) -> None:
    found = laid_over(tmp_path, "[microscope]\nfeedback = { replaces = true, setpoint = 1e-10 }\n")
    assert found.data["microscope"] == {
        "component": True, "class": "Simulator", "seed": 3, "feedback": {"setpoint": 1e-10}
    }  # fmt: skip


def test_key_means_the_same_where_there_was_no_table(tmp_path: Path) -> None:
    assert laid_over(tmp_path, "[limits]\nregion = { replaces = true, x = [0, 1] }\n").data["limits"] == {
        "region": {"x": [0, 1]}
    }


def test_replaces_that_is_not_true_is_an_unknown_key(tmp_path: Path) -> None:
    laid_over(tmp_path, "[clock]\nreplaces = 1\n")
    errors = [str(one) for one in load(tmp_path / "sample.toml", tmp_path / "above.toml").check() if one.is_error]
    assert any("replaces" in error for error in errors)
