"""An actuator with hysteresis (piezo ceramics, magnets): gain and lag grow with the amplitude of the drive."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import float64, njit

from scanner.arrays import Array
from scanner.integrator.nodes import from_nodes, to_nodes
from scanner.terms.term import Parameter, SignalContext, Term


@njit(float64[::1](float64[::1]), cache=True, nogil=True)
def prandtl_ishlinskii(v):  # type: ignore[no-untyped-def]
    """Return the integral of the play operators of all half-widths over a signal ``v`` (n,), shape (n,).

    All operators are at rest at 0 before the first sample, so that the loops of a symmetric oscillation are symmetric
    wherever in it the signal begins. With uniform density the integral has a closed form (Rayleigh): P = ± x²/2 away
    from rest, and P = P_r ± (x − x_r)²/4 after a reversal at x_r. A signal that passes an earlier reversal erases it,
    so the reversals that still count are nested, each inside the one before.
    """
    out = np.zeros_like(v)
    reversal, value_at = np.empty_like(v), np.empty_like(v)
    depth, widest = 0, 0.0
    for i in range(v.size):
        x, before = v[i], v[max(i - 1, 0)]
        if abs(x) >= widest:
            widest = abs(x)
            out[i] = 0.5 * x * widest
            reversal[0], value_at[0], depth = x, out[i], 1
            continue
        if (x - before) * (before - reversal[depth - 1]) < 0.0:
            reversal[depth], value_at[depth] = before, out[i - 1]
            depth += 1
        while depth > 2 and (x - reversal[depth - 2]) * (reversal[depth - 2] - reversal[depth - 1]) >= 0.0:
            depth -= 2
        distance = x - reversal[depth - 1]
        out[i] = value_at[depth - 1] + 0.25 * distance * abs(distance)
    return out


def voltage(voltage: Array, p: Sequence[float], context: SignalContext) -> Array:
    (h,) = p
    half_steps = from_nodes(voltage)
    return to_nodes(half_steps + h * prandtl_ishlinskii(half_steps))


TERM = Term(
    effect="hysteresis",
    stage="drive",
    equation="V + h ∫ P_r[V] dr,  P_r the play operator of half-width r",
    parameters=(Parameter("h", "1/V", lambda s: 0.1 / s.voltage_rms, sign=1),),
    source="Rayleigh, Phil. Mag. 23, 225 (1887); Kuhnen, European Journal of Control 9, 407 (2003), eq 1-10",
    confounders={
        "drive-lag": "its phase depends on frequency, not on amplitude: drive at two amplitudes",
        "cubic-stiffness": "no loop: gain changes with amplitude, phase far from resonance does not",
    },
    applies=lambda axis, scales: axis.drive is not None and axis.drive.kind == "linear" and scales.voltage_rms > 0,
    voltage=voltage,
)
