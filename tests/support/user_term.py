"""The text of a file in which a user adds a term, a spring whose torque goes with the seventh power of the angle."""

USER_TERM = """
from numba import njit
from scanner.terms import Parameter, Term
from scanner.integrator.abi import TORQUE_LAW

@njit(TORQUE_LAW)
def torque(t, theta, omega, other, volt, z0, z1, p, nominal):
    return -p[0] * theta**7, 0.0, 0.0

K7 = Parameter("k7", "N m", lambda s: s.k / s.amplitude**6)
TERM = Term("septic-stiffness", "mechanics", "+ k7 θ⁷", (K7,), "mine", torque=torque)
"""
