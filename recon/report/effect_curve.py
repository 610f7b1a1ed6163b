"""Curves of catalogue effects in their own variables, with 95 % bands from the posterior."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.candidate_terms.discrepancy import is_discrepancy
from estimation.device_fit.data import sense_channel
from estimation.device_fit.fit import Fit
from estimation.device_fit.parameters import Candidate
from estimation.device_fit.posterior import draw_parameters
from scanner.active_terms import ActiveTerm, with_constants
from scanner.arrays import Array
from scanner.forward_model import AxisTrajectory, apply_channel_terms, effective_drive, sense_signal
from scanner.integrator.abi import nominal_values
from scanner.integrator.nodes import nodes_to_samples
from scanner.integrator.trajectories import CapacitanceTerm
from scanner.stages import Readout

CURVE_SAMPLES = 4000
"""Number of times of the run at which the change by an effect is evaluated: a hundred per bin of its curve."""

CURVE_BINS = 40
"""Number of bins of an effect's curve."""

MODULATION_ADVANTAGE = 4.0
"""Ratio of unexplained variances from which a time-dependent coefficient (of stiffness, damping or gain) is drawn
instead of the best plain curve. Below it the plain curve is easier to read and explains nearly as much."""


@dataclass(frozen=True)
class EffectCurve:
    """An effect in its own variables: a spring over angle, a drift over time, a lag over frequency, a gain over level.

    Attributes:
        x, y: shape (n,).
        band: 95 % band of ``y``, shape (2, n).
        x_label, y_label: quantity and unit.
        logarithmic: whether ``x`` is drawn on a logarithmic axis.
    """

    x: Array
    y: Array
    band: Array
    x_label: str
    y_label: str
    logarithmic: bool = False


def effect_curve(fit: Fit, candidate: Candidate) -> EffectCurve | None:
    """The curve of a catalogue effect with its 95 % band; None if it has hidden states or no effect in the run.

    The fitted motion is used for all parameter values, so the band is that of the effect alone.
    """
    term = candidate.term
    if is_discrepancy(candidate) or term.hidden_state_scales:
        return None
    scales = fit.model.scales(candidate.axis)
    indices = fit.model.indices("term", candidate.key)

    def values(x: Array) -> tuple[float, ...]:
        return term.values([float(v) for v in x[indices]], scales)

    run_index = next(i for i, run in enumerate(fit.model.runs) if candidate.axis in run.inputs)
    if term.corners is not None or term.clock is not None:
        duration = fit.model.runs[run_index].duration
        return _timing_curve(fit, candidate, values, scales.rate / (2.0 * np.pi), duration)
    return _state_curve(fit, candidate, values, run_index)


def _timing_curve(
    fit: Fit, candidate: Candidate, values: Callable[[Array], tuple[float, ...]], frequency: float, duration: float
) -> EffectCurve:
    """Phase shift over frequency for low-pass sections, shift in time over time for a clock."""
    term = candidate.term
    if term.corners is not None:
        corners = term.corners
        x = np.geomspace(0.1 * frequency, 10.0 * frequency, 100)

        def curve(p: Array) -> Array:
            return np.degrees(np.sum([-np.arctan(x / corner) for corner in corners(values(p))], axis=0))

        labels, x_drawn, logarithmic = ("frequency (kHz)", "phase shift (°)"), 1e-3 * x, True
    else:
        clock = term.clock
        assert clock is not None
        x = np.linspace(0.0, duration, 100)

        def curve(p: Array) -> Array:
            return 1e6 * (clock(x, values(p)) - x)

        labels, x_drawn, logarithmic = ("time (ms)", "shift in time (µs)"), 1e3 * x, False
    band = np.percentile([curve(p) for p in draw_parameters(fit)], [2.5, 97.5], axis=0)
    return EffectCurve(x_drawn, curve(fit.x), band, *labels, logarithmic)


@dataclass(frozen=True)
class _MotionWithout:
    """The fitted motion without an effect.

    Attributes:
        axis: name of the axis of the effect.
        motions: by name of the axes that the sense channel of ``axis`` shows, ``axis`` among them.
        readout: of that channel, with nominal values; None where the device states none.
    """

    axis: str
    motions: Mapping[str, AxisTrajectory]
    readout: Readout | None

    @property
    def trajectory(self) -> AxisTrajectory:
        """Of the axis of the effect."""
        return self.motions[self.axis]

    def sense(self, readout: Readout, trajectory: AxisTrajectory) -> Array:
        """The sense channel with another trajectory of the axis, shape (n + 1,) [V]."""
        return sense_signal(readout, list({**self.motions, self.axis: trajectory}.values()))


def _motion_without(fit: Fit, candidate: Candidate, run_index: int) -> _MotionWithout:
    """The fitted motion of one run, in which other terms than the candidate's act."""
    model, trajectories = fit.model, fit.model.trajectories(run_index, fit.x)
    channel = sense_channel(model.device, candidate.axis)
    sensed = {name: each for name, each in trajectories.items() if sense_channel(model.device, name) == channel}
    trajectory = trajectories[candidate.axis]
    others = tuple(active for active in trajectory.active_terms if active.term is not candidate.term)
    nominal = model.nominal(candidate.axis, fit.x)
    without = replace(trajectory, axis=with_constants(nominal, others), active_terms=others)
    readout = model.nominal(next(iter(sensed)), fit.x).readout
    return _MotionWithout(candidate.axis, {**sensed, candidate.axis: without}, readout)


@dataclass(frozen=True)
class _Representation:
    """Representation of a change d(t) by a coefficient c: d = c(variable) · regressor.

    Attributes:
        x_label, y_label: quantity and unit.
        variable: on which the coefficient depends, shape (n,).
        regressor: shape (n,); ones for a plain curve.
        scale: factor from the coefficient to the unit of ``y_label``.
    """

    x_label: str
    y_label: str
    variable: Array
    regressor: Array
    scale: float = 1.0

    def coefficients(self, change: Array) -> Array:
        """Least-squares coefficient in each bin, shape (CURVE_BINS,), NaN for an empty bin."""
        bin_index = _bin_indices(self.variable)
        weight = np.bincount(bin_index, self.regressor**2, CURVE_BINS)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(weight > 0.0, np.bincount(bin_index, change * self.regressor, CURVE_BINS) / weight, np.nan)

    def unexplained(self, change: Array) -> float:
        """Mean square of ``change`` that the coefficients do not explain."""
        fitted = self.coefficients(change)[_bin_indices(self.variable)] * self.regressor
        return float(np.nanmean((change - fitted) ** 2))

    def curve(self, change: Array) -> Array:
        return self.scale * self.coefficients(change)


def _state_curve(
    fit: Fit, candidate: Candidate, values: Callable[[Array], tuple[float, ...]], run_index: int
) -> EffectCurve | None:
    """The change by an effect over the variable that explains most of its variance."""
    without = _motion_without(fit, candidate, run_index)
    size = without.trajectory.angle.size
    samples = np.linspace(0, size - 1, min(CURVE_SAMPLES, size)).astype(np.intp)

    def change(x: Array) -> Array:
        active = ActiveTerm(candidate.term, values(x), candidate.channel)
        return _change(without, active, samples)

    fitted = change(fit.x)
    if not fitted.any():
        return None
    representation = _choose_representation(_representations(without, candidate, samples), fitted)
    bin_index = _bin_indices(representation.variable)
    x = np.bincount(bin_index, representation.variable, CURVE_BINS) / np.maximum(
        np.bincount(bin_index, minlength=CURVE_BINS), 1
    )
    y = representation.curve(fitted)
    drawn = np.stack([representation.curve(change(p)) for p in draw_parameters(fit)])
    not_empty = np.isfinite(y)
    band = np.percentile(drawn[:, not_empty], [2.5, 97.5], axis=0)
    return EffectCurve(x[not_empty], y[not_empty], band, representation.x_label, representation.y_label)


def _representations(without: _MotionWithout, candidate: Candidate, samples: NDArray[np.intp]) -> list[_Representation]:
    """Plain curves first, then time-dependent coefficients, whose regressor is not constant."""
    motion = without.trajectory
    time, angle, rate = motion.drive.time[samples], motion.angle[samples], motion.rate[samples]
    ones, quantity = np.ones(samples.size), _changed_quantity(candidate)
    variables = {"angle (mrad)": 1e3 * angle, "rate (rad/s)": rate, "time (ms)": 1e3 * time}
    variables["voltage (V)"] = motion.voltage[samples]
    if candidate.term.coupled and motion.other is not None:
        variables["angle of the other axis (mrad)"] = 1e3 * motion.other.angle[samples]
    modulations = {}
    if candidate.term.torque is not None:
        mechanics = motion.axis.require_mechanics()
        modulations["change of stiffness (%)"] = angle, -100.0 / mechanics.k
        modulations["change of damping (%)"] = rate, -100.0 / mechanics.b
    elif candidate.term.output is not None and not candidate.channel.startswith("angle") and without.readout:
        level = without.sense(without.readout, motion)[samples]
        variables = {"level of the sense signal (V)": level} | variables
        modulations["change of gain (%)"] = level, 100.0
        modulations["change of gain about the mean level (%)"] = level - level.mean(), 100.0
    usable = {name: v for name, v in variables.items() if np.ptp(v) > 1e-9 * np.abs(v).max()}
    plain = [_Representation(name, quantity, v, ones) for name, v in usable.items()]
    products = [_Representation("time (ms)", name, 1e3 * time, r, scale) for name, (r, scale) in modulations.items()]
    return plain + products


def _choose_representation(options: Sequence[_Representation], change: Array) -> _Representation:
    plain = [option for option in options if not np.ptp(option.regressor)]
    products = [option for option in options if np.ptp(option.regressor)]
    best_plain = min(plain, key=lambda option: option.unexplained(change))
    if products:
        product = min(products, key=lambda option: option.unexplained(change))
        if MODULATION_ADVANTAGE * product.unexplained(change) < best_plain.unexplained(change):
            return product
    return best_plain


def _changed_quantity(candidate: Candidate) -> str:
    """Quantity and unit of what an effect changes at its stage."""
    term = candidate.term
    if term.torque is not None:
        return "extra torque (N m)"
    if term.capacitance is not None:
        return "extra capacitance (F)"
    if term.voltage is not None:
        return "extra voltage (V)"
    if candidate.channel.startswith("angle"):
        return "change of the recorded angle (rad)"
    return "change of the sense signal (V)"


def _change(without: _MotionWithout, active: ActiveTerm, samples: NDArray[np.intp]) -> NDArray[np.float64]:
    """What one effect changes at its stage along a fixed motion, shape of ``samples``."""
    motion = without.trajectory
    term, nominal = active.term, nominal_values(motion.axis)
    if term.torque is not None:
        values, time = np.asarray(active.values, float), motion.drive.time
        other_angle = np.zeros(time.size) if motion.other is None else motion.other.angle
        torque = [
            term.torque(time[i], motion.angle[i], motion.rate[i], other_angle[i], motion.voltage[i], 0.0, 0.0,
                        values, nominal)[0]
            for i in samples
        ]  # fmt: skip
        return np.array(torque)
    if term.capacitance is not None:
        law = CapacitanceTerm(term.capacitance, active.values)
        return law.evaluate(motion.angle[samples], motion.axis)[0]
    if term.voltage is not None:
        change = effective_drive(motion.axis, [active], motion.drive) - motion.drive.voltage
        return nodes_to_samples(change)[samples]
    changed = replace(motion, axis=with_constants(motion.axis, [active]), active_terms=(*motion.active_terms, active))
    if active.channel.startswith("angle"):
        after, before = (apply_channel_terms("angle", t.angle, [t], t.axis.readout) for t in (changed, motion))
        return (after - before)[samples]
    if without.readout is None:
        return np.zeros(samples.size)
    return (without.sense(without.readout, changed) - without.sense(without.readout, motion))[samples]


def _bin_indices(variable: Array) -> NDArray[np.intp]:
    low, high = variable.min(), variable.max()
    return np.minimum((variable - low) / (high - low) * CURVE_BINS, CURVE_BINS - 1).astype(np.intp)
