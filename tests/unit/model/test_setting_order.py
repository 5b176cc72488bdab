"""Settings of a feedback that holds a current, set one by one: the gap is never narrower than at both ends."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from afspm.model import names
from afspm.model.setting_order import widening_first

BIAS, SETPOINT, GAIN = names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT, names.ZCTRL_IGAIN
SIGNED = st.builds(lambda sign, size: sign * size, st.sampled_from((-1, 1)), st.floats(1e-3, 1e3))
SETTINGS = st.fixed_dictionaries({BIAS: SIGNED, SETPOINT: SIGNED, GAIN: SIGNED})


# tip T5
@given(SETTINGS, SETTINGS, st.permutations((BIAS, SETPOINT, GAIN)))
def test_no_step_narrows_the_gap_beyond_both_ends(
    now: dict[str, float], wanted: dict[str, float], order: list[str]
) -> None:
    def gap(values: dict[str, float]) -> float:
        return abs(values[BIAS] / values[SETPOINT])

    least, values = min(gap(now), gap(wanted)), dict(now)
    found = widening_first(now, {name: wanted[name] for name in order})
    for name in found:
        values[name] = wanted[name]
        assert gap(values) >= least
    assert values == wanted
    rises = abs(wanted[GAIN]) > abs(now[GAIN])
    assert not rises or found[-1] == GAIN, "a gain rises last"
