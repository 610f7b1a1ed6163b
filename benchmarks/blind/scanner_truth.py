"""All numbers of the true scanner of one recording, in one flat tuple.

The first block is what a nominal device file states too. The rest is what such a file leaves out; its defaults switch
it off. SI units, radians. The tuple is flat because compiled code takes it as one argument and because an effect then
replaces its fields with one ``_replace``; comments group the fields by stage.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple


class Truth(NamedTuple):
    """One axis of the true scanner."""

    # Stated by the device file as well.
    J: float = 1.0
    b: float = 0.0
    k: float = 1.0
    torque_per_volt: float = 0.0  # a linear drive's; zero means combs
    C0: float = 0.0
    Cb: float = 0.0
    theta0: float = 1.0
    R_s: float = 0.0  # transimpedance [ohm]; its bias is the command
    a_cir: float = 0.0  # demodulator [V/F]
    gain: float = 0.0  # position sensor [V/rad]
    offset: float = 0.0  # b_cir, or a position sensor's zero [V]
    section_1: float = inf  # corners of the demodulator's low-pass sections [rad/s]
    section_2: float = inf

    # Mechanics.
    scale: float = 1.0  # of J, b and k together: torque per inertia
    k2: float = 0.0
    k3: float = 0.0
    k5: float = 0.0
    b2: float = 0.0
    b3: float = 0.0
    tau_c: float = 0.0
    dk: float = 0.0  # resonance-drift, relative, with time constant
    dk_tau: float = 1.0
    db: float = 0.0  # damping-drift
    db_tau: float = 1.0
    k_v: float = 0.0  # viscoelastic
    tau_v: float = 1.0
    mode_frequency: float = 0.0  # a second oscillator [rad/s]
    mode_damping: float = 0.0  # [1/s]
    mode_coupling: float = 0.0  # linear: second-mode [1/s^2]
    mode_exchange: float = 0.0  # theta q^2: mode-coupling [1/(rad s^2)]
    kink_stiffness: float = 0.0  # extra beyond kink_angle, on one side
    kink_angle: float = 0.0
    wander: float = 0.0  # stiffness follows a foreign vibration, relative
    wander_frequency: float = 0.0  # [rad/s]
    pendulum: float = 0.0  # 1: the spring is k sin(theta)
    warming: float = 0.0  # damping per remembered theta^2 [1/rad^2]
    memory: float = 1.0  # time constant of that memory [s]

    # Capacitance.
    theta_c: float = 0.0
    shape: float = 0.0  # relative weight of u^4 in the bell
    parasitic: float = 0.0  # slope of a parasitic capacitance that saturates with angle [F/rad]
    parasitic_angle: float = 1.0

    # Drive.
    drive_mean: float = 0.0  # of the command: droop leaves it alone [V]
    droop: float = 1.0
    drive_corner: float = inf  # [rad/s]
    slew: float = inf  # [V/s]
    compression: float = 0.0  # v - compression v^3 [1/V^2]
    charge: float = 0.0  # [V]
    charge_tau: float = 1.0
    carrier: float = 0.0  # added to V^2 [V^2]

    # Readout.
    sections: float = 1.0  # both of the demodulator's corners lie at this multiple of what is stated
    readout_corner: float = inf  # [rad/s]
    square_Cp: float = inf  # [F]
    square_at: float = 0.0  # capacitance at which the square law keeps gain and value [F]
    leak: float = 0.0  # epsilon e^(i psi), in farads of the carrier
    leak_phase: float = 0.0
    feedthrough: float = 0.0  # [V/V]
    gain_drift: float = 0.0  # relative, over the whole recording
    limit: float = inf  # [V]
    sensor_cubic: float = 0.0  # [1/V^2]
    tone: float = 0.0  # [V]
    tone_frequency: float = 0.0  # [rad/s]
    tone_phase: float = 0.0
    drift_1: float = 0.0  # offset-drift: half-waves over the recording [V]
    drift_2: float = 0.0
    drift_3: float = 0.0
    rate_gain: float = 0.0  # gain differs with the sign of the rate
    play: float = 0.0  # share of the output that goes through a play operator
    play_width: float = 0.0  # its half width [V]
    ripple: float = 0.0  # gain follows a supply's ripple, relative
    ripple_frequency: float = 0.0  # [rad/s]

    # Timing.
    delay: float = 0.0  # of sense [s]
    skew: float = 0.0  # sense's clock runs fast by this fraction
    swing_delay: float = 0.0  # delay per remembered theta^2 [s/rad^2]
    jitter: float = 0.0  # sense's clock wanders by this [s]
    jitter_frequency: float = 0.0  # [rad/s]

    # Optics of the reference detector.
    angle_cubic: float = 0.0  # [1/rad^2]
    edge: float = inf  # where the spot begins to leave the detector, on one side [rad]
    edge_loss: float = 0.0  # share of the motion beyond that is lost

    # Imperfections that no catalogue lists, beside an effect (see imperfections.py).
    curve_5: float = 0.0  # readout curve of fifth order, relative at curve_height
    curve_7: float = 0.0
    curve_height: float = 1.0  # [V]
    flutter: float = 0.0  # of the gain, relative
    flutter_frequency: float = 0.0  # [rad/s]
    flutter_phase: float = 0.0
    level_gain: float = 0.0  # relative loss of gain where the recent mean square is twice level_square
    level_tau: float = 1.0  # [s]
    level_square: float = 1.0  # [V^2]
    foreign_frequency: float = 0.0  # a weak mode [rad/s]
    foreign_damping: float = 0.0  # [1/s]
    foreign_coupling: float = 0.0  # [1/s^2]
    spring_memory: float = 0.0  # stiffness per remembered theta^2, relative [1/rad^2]
    spring_tau: float = 1.0  # [s]
    drive_memory: float = 0.0  # drive gain per remembered command^2, relative [1/V^2]
    drive_tau: float = 1.0  # [s]
    slip_stiffness: float = 0.0  # of a pivot that slips [N m/rad]
    slip_angle: float = 1.0  # its deflection when it slips [rad]
    uneven: float = 0.0  # rms of the sampling times' pattern [s]
    uneven_pattern: float = 2.0  # its length in samples
    uneven_phase: float = 0.0
    code_step: float = 0.0  # of a converter with missing codes [V]
    code_missing: float = 0.0  # share of them
    code_seed: float = 0.0
    rail: float = inf  # one-sided limit [V]
