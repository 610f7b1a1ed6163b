"""An actuator that remembers where it turned: piezo ceramics, magnets. Gain and lag grow with the swing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import float64, njit
from numpy.typing import NDArray

from scanner.terms.term import Parameter, Term, View
from scanner.trajectory import halves, thirds

Array = NDArray[np.float64]


@njit(float64[::1](float64[::1]), cache=True)
def plays(v):  # type: ignore[no-untyped-def]
    """Sum of play operators of every width, evenly dense, over ``v`` (n,), all of them at rest at the first sample.

    Rayleigh's law: P = ± x²/2 away from rest, P = P_turn ± (x − x_turn)²/4 after a turn. A swing that passes an earlier
    turn forgets it, so the turns that still count lie nested, each inside the one before.
    """
    out = np.zeros_like(v)
    turn, height = np.empty_like(v), np.empty_like(v)
    depth, widest = 0, 0.0
    for i in range(1, v.size):
        x, before = v[i] - v[0], v[i - 1] - v[0]
        if abs(x) >= widest:
            widest = abs(x)
            out[i] = 0.5 * x * widest
            turn[0], height[0], depth = x, out[i], 1
            continue
        if (x - before) * (before - turn[depth - 1]) < 0.0:
            turn[depth], height[depth] = before, out[i - 1]
            depth += 1
        while depth > 2 and (x - turn[depth - 2]) * (turn[depth - 2] - turn[depth - 1]) >= 0.0:
            depth -= 2
        far = x - turn[depth - 1]
        out[i] = height[depth - 1] + 0.25 * far * abs(far)
    return out


def voltage(voltage: Array, p: Sequence[float], view: View) -> Array:
    half = halves(voltage)
    return thirds(half + p[0] * plays(half))


TERM = Term(
    effect="hysteresis",
    stage="drive",
    equation="V + h ∫ P_r[V] dr,  P_r the play operator of half-width r",
    parameters=(Parameter("h", "1/V", lambda s: 0.1 / s.voltage_rms, sign=1),),
    source="Rayleigh, Phil. Mag. 23, 225 (1887); Kuhnen, European Journal of Control 9, 407 (2003), eq 1-10",
    lookalikes={
        "drive-lag": "its phase follows the frequency, whatever the swing: drive at two amplitudes",
        "cubic-stiffness": "no loop: gain changes with the swing, phase far from resonance does not",
    },
    applies=lambda axis, scales: axis.drive is not None and axis.drive.kind == "linear" and scales.voltage_rms > 0,
    voltage=voltage,
)
