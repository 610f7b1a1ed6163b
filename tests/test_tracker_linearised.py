"""When a block is linearised anew: at a step that its own laws bend over."""

import numpy as np
import pytest

from estimation.tracker.smoother import NONLINEAR, _change
from estimation.tracker.step import DAMPING, GAIN, LOG, PHASE, STATES, STIFFNESS, TREND


@pytest.mark.parametrize("at", [PHASE, LOG, STIFFNESS, DAMPING, GAIN, STATES + PHASE, 2 * STATES])
def test_any_state_but_the_trend_counts_as_it_is(at: int) -> None:
    x = np.zeros(2 * STATES + 1)
    x[at] = -2.0 * NONLINEAR
    assert _change(x, np.zeros(x.size), 6e-4) == 2.0 * NONLINEAR


def test_a_trend_counts_as_what_it_makes_of_the_stiffness_over_a_block() -> None:
    x = np.zeros(2 * STATES + 1)
    x[STATES + TREND] = 0.1
    assert _change(x, np.zeros(x.size), 6e-4) == pytest.approx(6e-5)
