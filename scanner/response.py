"""From a drive to the channels, stage by stage, with any set of terms.

One chain for everybody who asks what a device would have recorded: prediction, diagnosis, simulation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.device import Amdm, Axis, Position, Readout
from scanner.errors import BadInput
from scanner.laws import amdm_voltage, capacitance, capacitance_slope, position_voltage, transimpedance_voltage
from scanner.lowpass import lowpass, step_coefficients
from scanner.terms import STAGES, Term, View, catalogue, shifted
from scanner.trajectory import Bell, Torque, integrate

Array = NDArray[np.float64]
_NOTHING = np.empty(0)


@dataclass(frozen=True)
class Added:
    """A term at work on one axis.

    Attributes:
        term: the physics.
        values: of its parameters, in the term's order.
        channel: which of ``term.channels`` its output law acts on.
        hidden: its hidden states at the start.
    """

    term: Term
    values: tuple[float, ...]
    channel: str = "sense"
    hidden: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Inputs:
    """What drives one axis.

    Attributes:
        voltage: at the start, middle and end of every step, shape (n, 3) [V].
        step: [s].
        t0: start on the recording's clock, the origin of all that drifts [s].
    """

    voltage: Array
    step: float
    t0: float = 0.0

    @property
    def time(self) -> Array:
        """Times of the n + 1 samples [s]."""
        return self.t0 + self.step * np.arange(len(self.voltage) + 1, dtype=np.float64)


@dataclass(frozen=True)
class Path:
    """The motion of one axis, and what drove it.

    Attributes:
        axis: with the constants that its terms gave it.
        angle, rate: shape (n + 1,) [rad, rad/s].
        voltage: that pulled, terms included, and
        raw_voltage: as recorded, shape (n + 1,) [V].
    """

    axis: Axis
    angle: Array
    rate: Array
    voltage: Array
    raw_voltage: Array


def added_terms(axis: Axis) -> tuple[Added, ...]:
    """The terms that a device file states for an axis under ``[x.terms.<effect>]``.

    Raises:
        BadInput: an effect that is not known, or one of its parameters missing.
    """
    known = catalogue()
    return tuple(_stated(axis, effect, dict(values), known) for effect, values in axis.terms.items())


def _stated(axis: Axis, effect: str, values: dict[str, float], known: dict[str, Term]) -> Added:
    key = f"{axis.name}.terms.{effect}"
    if effect not in known:
        hint = f"known effects: {', '.join(known)}; a term file of your own is given with --terms"
        raise BadInput("is an effect that nobody knows", file=axis.source, channel=key, hint=hint)
    term = known[effect]
    if missing := [p.name for p in term.parameters if p.name not in values]:
        hint = f"{effect} needs {', '.join(p.name for p in term.parameters)}"
        raise BadInput(f"lacks {missing[0]}", file=axis.source, channel=key, hint=hint)
    variant = int(values.get("variant", 0))
    if not 0 <= variant < len(term.channels):
        raise BadInput(f"variant {variant} is unknown", file=axis.source, channel=key, hint="count from 0")
    return Added(term, tuple(values[p.name] for p in term.parameters), term.channels[variant])


def by_stage(added: Iterable[Added]) -> list[Added]:
    """Terms in the order in which a signal meets their stages."""
    return sorted(added, key=lambda each: STAGES.index(each.term.stage))


def move(
    axis: Axis, added: Sequence[Added], inputs: Inputs, start: tuple[float, float], other: Array | None = None
) -> Path:
    """The motion of one axis under its drive.

    Args:
        axis: nominal values.
        start: angle [rad] and rate [rad/s] at the first sample.
        other: angle of the other axis, shape (n, 3) [rad].
    """
    raw = _samples(inputs.voltage)
    for each in added:
        if each.term.constants is not None:
            axis = each.term.constants(axis, each.values)
    view = View(inputs.time, inputs.step, axis.readout, _NOTHING, raw, _NOTHING, _NOTHING)
    voltage = inputs.voltage
    for each in by_stage(added):
        if each.term.voltage is not None:
            voltage = each.term.voltage(voltage, each.values, view)
    torques = [Torque(each.term.torque, each.values, each.hidden) for each in added if each.term.torque is not None]
    bells = [Bell(each.term.bell, each.values) for each in added if each.term.bell is not None]
    angle, rate = integrate(axis, start, voltage, inputs.step, inputs.t0, torques, bells, other)
    return Path(axis, angle, rate, _samples(voltage), raw)


def sense(readout: Readout, added: Sequence[Added], paths: Sequence[Path], inputs: Inputs) -> Array:
    """The sense channel, shape (n + 1,) [V]; several paths stand for combs on one electrode."""
    match readout:
        case Amdm():
            signal = np.sum([_comb(path, added) for path in paths], axis=0)
            for each in added:
                if each.term.modulate is not None:
                    signal = each.term.modulate(signal, each.values, _view(paths[0], inputs, readout))
            signal = amdm_voltage(_demodulated(signal, readout, inputs.step), readout.a_cir, readout.b_cir)
        case Position():
            signal = position_voltage(paths[0].angle, readout.gain, readout.offset)
        case _:
            # The current is that of the voltage on the comb, the nominal bias where none was recorded.
            path = paths[0]
            signal = transimpedance_voltage(_comb_slope(path, added), path.rate, readout.R_s, path.voltage)
    return output("sense", signal, added, paths[0], inputs, readout)


def _demodulated(signal: Array, readout: Amdm, step: float) -> Array:
    """The capacitance behind the sections, stepped twice a sample: their step takes its input for linear in between."""
    dense = np.empty(2 * signal.size - 1)
    dense[::2] = signal
    dense[1::2] = shifted(signal, 0.5)[:-1]
    for corner in readout.lpf_hz:
        lowpass(dense, *step_coefficients(corner, 0.5 * step), dense[0], dense[0])
    return dense[::2].copy()


def reference(added: Sequence[Added], path: Path, inputs: Inputs) -> Array:
    """The reference angle, shape (n + 1,) [rad]."""
    return output("angle", path.angle, added, path, inputs, path.axis.readout)


def output(
    channel: str, signal: Array, added: Sequence[Added], path: Path, inputs: Inputs, readout: Readout | None
) -> Array:
    """``signal`` after the output laws that act on ``channel``, in the order of their stages."""
    for each in by_stage(added):
        kind, _, variant = each.channel.partition(":")
        if each.term.output is not None and kind == channel:
            signal = each.term.output(signal, each.values, _view(path, inputs, readout, variant))
    return signal


def _comb(path: Path, added: Sequence[Added]) -> Array:
    comb = path.axis.require_capacitance()
    total = capacitance(path.angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th)
    return total + _extra(path, added, 0)


def _comb_slope(path: Path, added: Sequence[Added]) -> Array:
    comb = path.axis.require_capacitance()
    return capacitance_slope(path.angle, comb.C0, comb.theta0, comb.theta_th) + _extra(path, added, 1)


def _extra(path: Path, added: Sequence[Added], derivative: int) -> Array | float:
    laws = [each for each in added if each.term.bell is not None]
    if not laws:
        return 0.0
    along = [Bell(each.term.bell, each.values).along(path.angle, path.axis) for each in laws if each.term.bell]
    return np.sum([extra[derivative] for extra in along], axis=0)


def _view(path: Path, inputs: Inputs, readout: Readout | None, variant: str = "") -> View:
    return View(inputs.time, inputs.step, readout, path.voltage, path.raw_voltage, path.angle, path.rate, variant)


def _samples(voltage: Array) -> Array:
    return np.append(voltage[:, 0], voltage[-1, 2])
