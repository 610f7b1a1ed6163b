"""A capacitance that is not Gaussian: a flatter top and steeper flanks."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.integrator.abi import CAPACITANCE_LAW
from scanner.terms.term import Parameter, Term


@njit(CAPACITANCE_LAW, cache=True)
def capacitance(theta, p, nominal):  # type: ignore[no-untyped-def]
    a = p[0]
    u = (theta - nominal.theta_th) / nominal.theta0
    height = a * nominal.C0 * np.exp(-u * u)
    return height * u**4, height * (4.0 - 2.0 * u * u) * u**3 / nominal.theta0


TERM = Term(
    effect="profile-shape",
    stage="capacitance",
    equation="C(θ) = C0 (1 + a u⁴) exp(−u²) + Cb,  u = (θ − θ_th)/θ0",
    parameters=(Parameter("a", "1", lambda s: 0.2),),
    source="Chen et al. 2020, fig. 8: measured profile",
    confounders={
        "square-law": "the square law grows with the parasitic capacitance: change the circuit, or record the angle"
    },
    capacitance=capacitance,
    applies=lambda axis, scales: axis.capacitance is not None,
)
