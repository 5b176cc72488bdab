from __future__ import annotations

from dataclasses import dataclass

import pytest

from afspm.experiment.document import Document
from afspm.experiment.sections import Section, parse


class Band(Section):
    low: float
    high: float = 1.0


@dataclass(frozen=True)
class PlainBand:
    low: float
    high: float = 1.0


@pytest.mark.parametrize("kind", [Band, PlainBand])
@pytest.mark.parametrize("table", [{"low": 0.5}, {"low": "half"}], ids=["right", "faulty"])
def test_section_with_a_required_field_is_refused_with_its_class(kind: type, table: dict[str, object]) -> None:
    with pytest.raises(TypeError, match=rf"^{kind.__name__}\.low needs a default, .* a faulty \[band\]$"):
        parse(kind, "band", table, Document(()))
