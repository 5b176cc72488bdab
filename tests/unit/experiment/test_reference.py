"""The reference page has every key that the file may have."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.experiment import limits_section, sections
from afspm.experiment.parts import DECLARED_KEYS, OWN_KEYS, SECTIONS
from afspm.experiment.wiring_classes import WIRE_KEYS, WIRE_SETTINGS, WiringClass
from afspm.scheduler.control.arbitration import RoleTable
from afspm.scheduler.publishing.envelopes import CacheRule, CacheSettings
from afspm.scheduler.settings import ControlSettings

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "experiment-file.md").read_text(encoding="utf-8")
MODELS = [
    sections.ClockSection,
    ControlSettings,
    RoleTable,
    sections.SecuritySection,
    sections.RestartSection,
    sections.RecordSection,
    sections.MetadataSection,
    CacheSettings,
    CacheRule,
    limits_section.LimitsSection,
    limits_section.RegionSection,
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_key_of_a_section_is_on_the_page(model: type) -> None:
    keys = sections.keys_of(model)
    assert [key for key in keys if not any(form in PAGE for form in (f"`{key}", f"{key} =", f".{key}]"))] == []


def test_every_section_and_key_of_a_component_is_on_the_page() -> None:
    assert [name for name in SECTIONS if f"[{name}" not in PAGE] == []
    assert [key for key in (*OWN_KEYS, *DECLARED_KEYS, *WIRE_KEYS) if f"`{key}" not in PAGE] == []


def test_every_used_setting_of_the_wiring_is_on_the_page() -> None:
    kinds = (WiringClass.PUBLISHER, WiringClass.SERVER, WiringClass.ROUTER, WiringClass.CLIENT)
    keys = {key for kind in kinds for key in WIRE_SETTINGS[kind]} - {"get_envelope_for_proto"}
    assert [key for key in keys if f"`{key}`" not in PAGE] == []
