"""The forward model: from a drive voltage to the recorded channels, stage by stage, with any set of terms.

Simulation, prediction and diagnosis use this one chain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scanner.active_terms import ActiveTerm, in_signal_order, place_in_signal_path, with_constants
from scanner.arrays import Array
from scanner.device import Axis
from scanner.integrator.nodes import nodes_to_samples
from scanner.laws import amdm_voltage, capacitance, capacitance_slope, motion_voltage, transimpedance_voltage
from scanner.lowpass import apply_lowpass
from scanner.stages import Amdm, MotionSensor, Readout
from scanner.terms import SignalContext

_EMPTY = np.empty(0)

REFERENCE_ORDERS = {"angle": 0, "velocity": 1, "acceleration": 2}
"""Kinds of reference channel (``angle_x``, ...) and the time derivatives of the angle that they hold."""


@dataclass(frozen=True)
class DriveInput:
    """The voltage that drives one axis.

    Attributes:
        voltage: at the start, middle and end of every step, shape (n, 3) [V].
        step: length of a step [s].
        t0: start on the recording's clock, which is the time origin of all drifts [s].
        is_bias: whether it is the recorded DC bias of the current of a transimpedance readout. The current under
            another voltage has the stated bias.
    """

    voltage: Array
    step: float
    t0: float = 0.0
    is_bias: bool = False

    @cached_property
    def time(self) -> Array:
        """Times of the n + 1 samples, shape (n + 1,) [s]."""
        return self.t0 + self.step * np.arange(len(self.voltage) + 1, dtype=np.float64)

    @cached_property
    def samples(self) -> Array:
        """Voltage at the n + 1 samples, shape (n + 1,) [V]."""
        return nodes_to_samples(self.voltage)


@dataclass(frozen=True)
class AxisTrajectory:
    """The motion of one axis and the drive that caused it.

    Attributes:
        axis: with the constants that its terms change.
        active_terms: its terms.
        drive: as recorded, before the drive terms.
        angle, rate: shape (n + 1,) [rad, rad/s].
        voltage: on the actuator, after the drive terms, shape (n + 1,) [V].
        other: the motion of the other axis; None where it does not move, or was not recorded.
    """

    axis: Axis
    active_terms: tuple[ActiveTerm, ...]
    drive: DriveInput
    angle: Array
    rate: Array
    voltage: Array
    other: AxisTrajectory | None = None

    def derivative(self, order: int) -> Array:
        """Return the angle [rad], its rate [rad/s] or its acceleration [rad/s2] (``order`` 0, 1, 2), shape (n + 1,)."""
        if order < 2:
            return self.rate if order else self.angle
        return acceleration(self.angle, self.rate, self.drive.step)

    def from_step(self, first: int) -> AxisTrajectory:
        """Return the trajectory from step ``first`` on."""
        drive = replace(self.drive, voltage=self.drive.voltage[first:], t0=self.drive.t0 + first * self.drive.step)
        return replace(
            self,
            drive=drive,
            angle=self.angle[first:],
            rate=self.rate[first:],
            voltage=self.voltage[first:],
            other=None if self.other is None else self.other.from_step(first),
        )

    def to_step(self, stop: int) -> AxisTrajectory:
        """Return the trajectory up to the end of step ``stop`` - 1."""
        return replace(
            self,
            drive=replace(self.drive, voltage=self.drive.voltage[:stop]),
            angle=self.angle[: stop + 1],
            rate=self.rate[: stop + 1],
            voltage=self.voltage[: stop + 1],
            other=None if self.other is None else self.other.to_step(stop),
        )

    def joined_with(self, later: AxisTrajectory) -> AxisTrajectory:
        """Return this trajectory and ``later``, which starts where this one ends, as one."""
        return replace(
            self,
            drive=replace(self.drive, voltage=np.concatenate([self.drive.voltage, later.drive.voltage])),
            angle=np.concatenate([self.angle[:-1], later.angle]),
            rate=np.concatenate([self.rate[:-1], later.rate]),
            voltage=np.concatenate([self.voltage[:-1], later.voltage]),
            other=None if self.other is None or later.other is None else self.other.joined_with(later.other),
        )


def simulate_axis(
    axis: Axis,
    terms: Sequence[ActiveTerm],
    drive: DriveInput,
    start: tuple[float, float],
    other_angle: Array | None = None,
) -> AxisTrajectory:
    """Return the motion of one axis under its drive.

    Args:
        axis: nominal values, with the readout that senses it.
        terms: physics beyond the nominal laws.
        drive: the recorded drive.
        start: angle [rad] and rate [rad/s] at the first sample.
        other_angle: angle of the other axis, at the nodes of every step, shape (n, 3) [rad].
    """
    return simulate_batch([(axis, terms, start)], drive, other_angle)[0]


def simulate_batch(
    cases: Sequence[tuple[Axis, Sequence[ActiveTerm], tuple[float, float]]],
    drive: DriveInput,
    other_angle: Array | None = None,
) -> list[AxisTrajectory]:
    """Return :func:`simulate_axis` of several (axis, terms, start) in one call of the integrator.

    The cases have the same terms and differ in numbers only. Up to ``scanner.integrator.abi.LANES`` cases take little
    longer than one.
    """
    # Imported here because loading the compiled kernels takes half a second.
    from scanner.integrator.trajectories import CapacitanceTerm, TorqueTerm, TrajectorySpec, integrate_batch

    specs, drives, of_values = [], [], dict[tuple[object, ...], tuple[Array, Array]]()
    for nominal, terms, start in cases:
        axis = with_constants(nominal, terms)
        values = tuple(active.values for active in terms if active.term.voltage is not None)
        if values not in of_values:
            voltage = effective_drive(axis, terms, drive)
            of_values[values] = voltage, nodes_to_samples(voltage)
        drives.append(of_values[values])
        torques = [
            TorqueTerm(
                active.term.torque, active.values, active.hidden_state if active.term.hidden_state_scales else None
            )
            for active in terms
            if active.term.torque is not None
        ]
        capacitances = [
            CapacitanceTerm(active.term.capacitance, active.values)
            for active in terms
            if active.term.capacitance is not None
        ]
        specs.append(TrajectorySpec(axis, start, torques, capacitances))
    motions = integrate_batch(specs, [voltage for voltage, _ in drives], drive.step, drive.t0, other_angle)
    return [
        AxisTrajectory(spec.axis, tuple(terms), drive, angle, rate, at_samples)
        for spec, (_, terms, _), (angle, rate), (_, at_samples) in zip(specs, cases, motions, drives, strict=True)
    ]


def effective_drive(axis: Axis, terms: Sequence[ActiveTerm], drive: DriveInput) -> Array:
    """Return the voltage on the actuator, after the drive terms, at the nodes of every step, shape (n, 3) [V]."""
    context = SignalContext(drive.time, drive.step, axis.readout, _EMPTY, drive.samples, _EMPTY, _EMPTY)
    voltage = drive.voltage
    for active in in_signal_order(terms):
        if active.term.voltage is not None:
            voltage = active.term.voltage(voltage, active.values, context)
    return voltage


def acceleration(angle: Array, rate: Array, step: float) -> Array:
    """Return the second derivative of a trajectory from its angle and its rate, shape (n + 1,) [rad/s2].

    The formulas are exact for polynomials of degree 5 (inside: the two neighbours; at the ends: the two next samples).
    With 50 steps a period their error is 1e-6. At a jump of the torque they return the mean of both sides.

    Args:
        angle, rate: at least 3 samples, shape (n + 1,) [rad, rad/s].
        step: between samples [s].
    """
    out = np.empty_like(angle)
    out[1:-1] = 2.0 * (angle[2:] - 2.0 * angle[1:-1] + angle[:-2]) / step**2 - (rate[2:] - rate[:-2]) / (2.0 * step)
    for end, sign in ((slice(None, 3), 1.0), (slice(-1, -4, -1), -1.0)):
        (a0, a1, a2), (w0, w1, w2) = angle[end], sign * rate[end]
        out[end.start or 0] = (-11.5 * a0 + 8.0 * a1 + 3.5 * a2) / step**2 - (6.0 * w0 + 8.0 * w1 + w2) / step
    return out


def sense_signal(readout: Readout, motions: Sequence[AxisTrajectory], background: Array | float = 0.0) -> Array:
    """Return the sense channel, shape (n + 1,) [V].

    Args:
        readout: nominal. A term that changes its constants or its signal may belong to any of the axes.
        motions: of the axis that the readout senses, or of all axes whose combs share its electrode.
        background: as in :func:`apply_channel_terms`.
    """
    readout = effective_readout(readout, motions)
    return apply_channel_terms("sense", _before_channel_terms(readout, motions), motions, readout, background)


def _before_channel_terms(readout: Readout, motions: Sequence[AxisTrajectory]) -> Array:
    """The signal of a readout before the terms that act on its channel, shape (n + 1,) [V]."""
    match readout:
        case Amdm():
            signal = sum(map(_capacitance, motions[1:]), start=_capacitance(motions[0]))
            for motion in motions:
                for active in motion.active_terms:
                    if active.term.pre_demodulation is not None:
                        context = _signal_context(motion, readout)
                        signal = active.term.pre_demodulation(signal, active.values, context)
            for corner in readout.lpf_hz:
                signal = apply_lowpass(signal, corner, motions[0].drive.step)
            signal = amdm_voltage(signal, readout.a_cir, readout.b_cir)
        case MotionSensor():
            signal = motion_voltage(motions[0].derivative(readout.order), readout.gain, readout.offset)
        case _:
            currents = [
                transimpedance_voltage(
                    _capacitance_slope(motion),
                    motion.rate,
                    readout.R_s,
                    _recorded_bias(motion) if motion.drive.is_bias else readout.V_bias,
                )
                for motion in motions
            ]
            signal = sum(currents[1:], start=currents[0])
    return signal


def _recorded_bias(motion: AxisTrajectory) -> Array:
    """The recorded bias of the current of a comb after the drive terms, without carriers, shape (n + 1,) [V]."""
    passed = [active for active in motion.active_terms if not active.term.torque_only]
    if len(passed) == len(motion.active_terms):
        return motion.voltage
    return nodes_to_samples(effective_drive(motion.axis, passed, motion.drive))


def effective_readout(readout: Readout, motions: Sequence[AxisTrajectory]) -> Readout:
    """Return the readout with the constants that the terms of all its axes change."""
    for motion in motions:
        terms = [active for active in motion.active_terms if active.term.stage == "readout"]
        readout = with_constants(replace(motion.axis, readout=readout), terms).require_readout()
    return readout


def reference_signal(motion: AxisTrajectory, kind: str = "angle") -> Array:
    """Return a reference channel of ``REFERENCE_ORDERS``, shape (n + 1,) [rad, rad/s or rad/s2]."""
    return apply_channel_terms(kind, motion.derivative(REFERENCE_ORDERS[kind]), [motion], motion.axis.readout)


def apply_channel_terms(
    channel: str,
    signal: Array,
    motions: Sequence[AxisTrajectory],
    readout: Readout | None,
    background: Array | float = 0.0,
) -> Array:
    """Return ``signal`` after the terms that act on ``channel``, in signal order.

    Args:
        channel: ``"sense"`` or one of ``REFERENCE_ORDERS``.
        signal: shape (n + 1,), in the unit of the channel.
        motions: of all axes whose terms may act on the channel.
        readout: of the channel.
        background: what adds to the channel independently of the motion (hum). Terms with ``after_noise``, such as the
            saturation of the converter, act on the sum.
    """
    pairs = [
        (active, motion)
        for motion in motions
        for active in motion.active_terms
        if active.channel.partition(":")[0] == channel
    ]
    pairs.sort(key=lambda pair: place_in_signal_path(pair[0]))
    for after_noise in (False, True):
        for active, motion in pairs:
            if active.term.after_noise is after_noise:
                variant = active.channel.partition(":")[2]
                context = _signal_context(motion, readout, variant)
                if active.term.coupled:
                    context = replace(context, other=_same_channel(channel, motion.other, motion.angle.size))
                signal = active.term.apply(signal, active.values, context)
        if not after_noise:
            signal = signal + background
    return signal


def _same_channel(channel: str, motion: AxisTrajectory | None, size: int) -> Array:
    """The channel of the same kind of another axis, without its terms, shape (size,); 0 where it does not move."""
    if motion is None or (channel == "sense" and motion.axis.readout is None):
        return np.zeros(size)
    if channel == "sense":
        return _before_channel_terms(motion.axis.require_readout(), [motion])
    return motion.derivative(REFERENCE_ORDERS[channel])


def _capacitance(motion: AxisTrajectory) -> Array:
    comb = motion.axis.require_capacitance()
    return capacitance(motion.angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th) + _term_capacitance(motion, 0)


def _capacitance_slope(motion: AxisTrajectory) -> Array:
    comb = motion.axis.require_capacitance()
    return capacitance_slope(motion.angle, comb.C0, comb.theta0, comb.theta_th) + _term_capacitance(motion, 1)


def _term_capacitance(motion: AxisTrajectory, derivative: int) -> Array | float:
    """Capacitance [F] (``derivative`` 0) or slope [F/rad] (1) that the capacitance terms add, shape (n + 1,)."""
    from scanner.integrator.trajectories import CapacitanceTerm

    terms = [
        CapacitanceTerm(active.term.capacitance, active.values)
        for active in motion.active_terms
        if active.term.capacitance is not None
    ]
    return sum((term.evaluate(motion.angle, motion.axis)[derivative] for term in terms), start=0.0)


def _signal_context(motion: AxisTrajectory, readout: Readout | None, variant: str = "") -> SignalContext:
    drive = motion.drive
    return SignalContext(
        drive.time, drive.step, readout, motion.voltage, drive.samples, motion.angle, motion.rate, variant
    )
