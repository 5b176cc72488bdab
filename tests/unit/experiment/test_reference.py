"""The reference page has every key that the file may have."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel

from afspm.experiment import cache_section, limits_section, sections
from afspm.experiment.parts import DECLARED_KEYS, OWN_KEYS, SECTIONS
from afspm.experiment.wiring_classes import WIRE_KEYS, WIRE_SETTINGS, WiringClass

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "experiment-file.md").read_text(encoding="utf-8")
MODELS = [
    sections.ClockSection,
    sections.ControlSection,
    sections.RolesSection,
    sections.SecuritySection,
    sections.RestartSection,
    sections.RecordSection,
    sections.MetadataSection,
    cache_section.CacheSection,
    cache_section.CacheRuleSection,
    limits_section.ParameterLimit,
    limits_section.ActionLimit,
    limits_section.LimitsSection,
    limits_section.RegionSection,
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_key_of_a_section_is_on_the_page(model: type[BaseModel]) -> None:
    assert [
        key for key in model.model_fields if not any(form in PAGE for form in (f"`{key}", f"{key} =", f".{key}]"))
    ] == []


def test_every_section_and_key_of_a_component_is_on_the_page() -> None:
    assert [name for name in SECTIONS if f"[{name}" not in PAGE] == []
    assert [key for key in (*OWN_KEYS, *DECLARED_KEYS, *WIRE_KEYS) if f"`{key}" not in PAGE] == []


def test_every_setting_of_the_wiring_that_means_something_is_on_the_page() -> None:
    kinds = (WiringClass.PUBLISHER, WiringClass.SERVER, WiringClass.ROUTER, WiringClass.CLIENT)
    keys = {key for kind in kinds for key in WIRE_SETTINGS[kind]} - {"get_envelope_for_proto"}
    assert [key for key in keys if f"`{key}`" not in PAGE] == []
