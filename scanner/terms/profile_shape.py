"""A capacitance that is no Gaussian: a flatter top, a steeper flank."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.terms.term import Parameter, Term
from scanner.trajectory import BELL


@njit(BELL, cache=True)
def bell(theta, p, nominal):  # type: ignore[no-untyped-def]
    u = (theta - nominal[5]) / nominal[4]
    height = p[0] * nominal[3] * np.exp(-u * u)
    return height * u**4, height * (4.0 - 2.0 * u * u) * u**3 / nominal[4]


TERM = Term(
    effect="profile-shape",
    stage="capacitance",
    equation="C(θ) = C0 (1 + a u⁴) exp(−u²) + Cb,  u = (θ − θ_th)/θ0",
    parameters=(Parameter("a", "1", lambda s: 0.2),),
    source="Chen et al. 2020, fig. 8: measured profile",
    lookalikes={"square-law": "it grows with the parasitic capacitance: change the circuit, or record the angle"},
    bell=bell,
    applies=lambda axis, scales: axis.capacitance is not None,
)
