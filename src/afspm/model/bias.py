"""The reference of the bias: whether the number at the maker's panel is the bias of the sample or of the tip.

`tip-bias-voltage` is that number, with its sign. `sample-bias` is the same setting by its meaning: positive at the
sample. It is replaced by `tip-bias-voltage` before a limit, rule or driver sees it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from afspm.basics.errors import InvalidValue
from afspm.model import parameter_names as names
from afspm.model.requests import Parameter

BiasOf = Literal["", "sample", "tip"]


@dataclass(frozen=True)
class BiasReference:
    """The electrode whose bias is the number at the maker's panel.

    Attributes:
        of: "sample" or "tip"; empty if it is not known.
        may_have_second: whether the microscope has a second electrode (`x-sample-bias`), or may have one.
    """

    of: BiasOf = ""
    may_have_second: bool = False

    @property
    def sign(self) -> float:
        """Return the factor between `sample-bias` and `tip-bias-voltage`."""
        return -1.0 if self.of == "tip" else 1.0

    @property
    def unknown(self) -> str:
        """Return why there is no `sample-bias`, with the remedy; empty if there is."""
        if self.of:
            return ""
        return (
            "sample-bias is not known here: nothing shows whether the panel has the bias of the sample or of the tip; "
            'see how it is wired, then write bias_reference = "sample" or "tip" into [microscope]'
        )

    @property
    def text(self) -> str:
        """Return the reference for a person."""
        return f"the panel has the bias of the {self.of}" if self.of else "not known: bias_reference names it"

    def canonical(self, given: Parameter) -> Parameter:
        """Return a parameter under its canonical name: `sample-bias` as `tip-bias-voltage`, others as they are.

        Raises:
            InvalidValue: the reference is not known, or the value is not a finite number.
        """
        if given.name != names.BIAS_OF_SAMPLE:
            return given
        if self.unknown:
            raise InvalidValue(self.unknown)
        return self._renamed(given, names.TIP_BIAS_VOLTAGE)

    def of_sample(self, panel: Parameter) -> Parameter:
        """Return a value of `tip-bias-voltage` as `sample-bias`, others as they are.

        Raises:
            InvalidValue: the value is not a finite number.
        """
        return panel if panel.name != names.TIP_BIAS_VOLTAGE else self._renamed(panel, names.BIAS_OF_SAMPLE)

    def _renamed(self, given: Parameter, name: str) -> Parameter:
        if given.value is None:
            return Parameter(name, None, given.unit)
        try:
            number = float(given.value.replace("_", "?"))  # Python would read 1_000
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise InvalidValue(f"{given.name} can't be {given.value[:100]!r}: it is not a finite number")
        return Parameter(name, given.value if self.sign > 0 else repr(0.0 - number), given.unit)
