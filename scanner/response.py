"""From a drive to the channels, stage by stage, with any set of terms.

One chain for everybody who asks what a device would have recorded: prediction, diagnosis, simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from scanner.device import Amdm, Axis, Position, Readout
from scanner.errors import BadInput
from scanner.laws import amdm_voltage, capacitance, capacitance_slope, position_voltage, transimpedance_voltage
from scanner.lowpass import low_passed
from scanner.terms import STAGES, Term, View, catalogue

Array = NDArray[np.float64]
_NOTHING = np.empty(0)

RELAXATIONS = 2
"""Turns in which coupled axes are moved again; each gains the square of the coupling."""


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
        added: its terms.
        inputs: as recorded.
        angle, rate: shape (n + 1,) [rad, rad/s].
        voltage: that pulled, terms included, shape (n + 1,) [V].
    """

    axis: Axis
    added: tuple[Added, ...]
    inputs: Inputs
    angle: Array
    rate: Array
    voltage: Array

    def after(self, first: int) -> Path:
        """The path from step ``first`` on."""
        inputs = replace(self.inputs, voltage=self.inputs.voltage[first:], t0=self.inputs.t0 + first * self.inputs.step)
        return replace(
            self, inputs=inputs, angle=self.angle[first:], rate=self.rate[first:], voltage=self.voltage[first:]
        )

    def followed_by(self, path: Path) -> Path:
        """This path and the one that goes on where it ends."""
        return replace(
            self,
            inputs=replace(self.inputs, voltage=np.concatenate([self.inputs.voltage, path.inputs.voltage])),
            angle=np.concatenate([self.angle[:-1], path.angle]),
            rate=np.concatenate([self.rate[:-1], path.rate]),
            voltage=np.concatenate([self.voltage[:-1], path.voltage]),
        )


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
        near = get_close_matches(effect, known) or known
        hint = f"known effects: {', '.join(near)}; a term file of your own is given with --terms"
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
        axis: nominal values, with the readout that sees it.
        start: angle [rad] and rate [rad/s] at the first sample.
        other: angle of the other axis, shape (n, 3) [rad].
    """
    return move_abreast([(axis, added, start)], inputs, other)[0]


def move_abreast(
    cases: Sequence[tuple[Axis, Sequence[Added], tuple[float, float]]], inputs: Inputs, other: Array | None = None
) -> list[Path]:
    """:func:`move` for (axis, terms, start) that differ in their numbers alone, and not in those of drive terms.

    As many as the integrator has lanes take little longer than one.
    """
    from scanner.trajectory import Bell, Motion, Torque, side_by_side  # its kernels take half a second to load

    voltage, motions = None, []
    for nominal, added, start in cases:
        axis = with_constants(nominal, added)
        if voltage is None:
            voltage = pulling(axis, added, inputs)
        torques = [
            Torque(each.term.torque, each.values, each.hidden if each.term.hidden else None)
            for each in added
            if each.term.torque is not None
        ]
        bells = [Bell(each.term.bell, each.values) for each in added if each.term.bell is not None]
        motions.append(Motion(axis, start, torques, bells))
    assert voltage is not None
    pulled = samples(voltage)
    moved = side_by_side(motions, voltage, inputs.step, inputs.t0, other)
    return [
        Path(motion.axis, tuple(added), inputs, angle, rate, pulled)
        for motion, (_, added, _), (angle, rate) in zip(motions, cases, moved, strict=True)
    ]


def with_constants(axis: Axis, added: Iterable[Added]) -> Axis:
    """The axis with the constants that its terms give it."""
    for each in added:
        if each.term.constants is not None:
            axis = each.term.constants(axis, each.values)
    return axis


def pulling(axis: Axis, added: Sequence[Added], inputs: Inputs) -> Array:
    """The voltage on the combs, terms included, shape (n, 3) [V]."""
    view = View(inputs.time, inputs.step, axis.readout, _NOTHING, samples(inputs.voltage), _NOTHING, _NOTHING)
    voltage = inputs.voltage
    for each in by_stage(added):
        if each.term.voltage is not None:
            voltage = each.term.voltage(voltage, each.values, view)
    return voltage


Mover = Callable[[str, Inputs, tuple[float, float], "Array | None"], Path]
"""(axis, inputs, start, other axis's angle) -> its motion."""


def move_all(inputs: Mapping[str, Inputs], starts: Mapping[str, tuple[float, float]], coupled: bool,
             mover: Mover) -> dict[str, Path]:  # fmt: skip
    """The motion of every axis; coupled ones are relaxed by turns: the weaker the coupling, the fewer it takes.

    Args:
        coupled: whether a term looks at the other axis.
    """
    paths = {name: mover(name, inputs[name], starts[name], None) for name in inputs}
    for _ in range(RELAXATIONS if coupled and len(paths) > 1 else 0):
        before = dict(paths)
        for name in inputs:
            (other,) = (path for each, path in before.items() if each != name)
            paths[name] = mover(name, inputs[name], starts[name], _thirds(other))
    return paths


def _thirds(path: Path) -> Array:
    """Angle at the start, middle and end of every step, by cubic Hermite interpolation, shape (n, 3)."""
    a, b = path.angle[:-1], path.angle[1:]
    middle = 0.5 * (a + b) + path.inputs.step / 8.0 * (path.rate[:-1] - path.rate[1:])
    return np.stack([a, middle, b], axis=1)


def sense(readout: Readout, paths: Sequence[Path], beneath: Array | float = 0.0) -> Array:
    """The sense channel, shape (n + 1,) [V]; several paths stand for combs on one electrode.

    Args:
        readout: nominal. A term that changes its constants, or the signal behind it, may stand with any of its axes.
    """
    readout = effective(readout, paths)
    match readout:
        case Amdm():
            signal = np.sum([_comb(path) for path in paths], axis=0)
            for path in paths:
                for each in path.added:
                    if each.term.modulate is not None:
                        signal = each.term.modulate(signal, each.values, _view(path, readout))
            for corner in readout.lpf_hz:
                signal = low_passed(signal, corner, paths[0].inputs.step)
            signal = amdm_voltage(signal, readout.a_cir, readout.b_cir)
        case Position():
            signal = position_voltage(paths[0].angle, readout.gain, readout.offset)
        case _:
            # The current is that of the voltage on the comb, the nominal bias where none was recorded.
            currents = [
                transimpedance_voltage(_comb_slope(path), path.rate, readout.R_s, path.voltage) for path in paths
            ]
            signal = np.sum(currents, axis=0)
    return passed("sense", signal, paths, readout, beneath)


def effective(readout: Readout, paths: Sequence[Path]) -> Readout:
    """The readout with the constants that the terms of all its axes give it."""
    for path in paths:
        terms = [each for each in path.added if each.term.stage == "readout"]
        readout = with_constants(replace(path.axis, readout=readout), terms).require_readout()
    return readout


def reference(path: Path) -> Array:
    """The reference angle, shape (n + 1,) [rad]."""
    return passed("angle", path.angle, [path], path.axis.readout)


def passed(
    channel: str, signal: Array, paths: Sequence[Path], readout: Readout | None, beneath: Array | float = 0.0
) -> Array:
    """``signal`` after the terms that act on ``channel``, in the order of their stages, those of its output last.

    Args:
        beneath: what lies under the channel whatever the mirror does (hum): an output clips it with the signal.
    """
    acting = [(each, path) for path in paths for each in path.added if each.channel.partition(":")[0] == channel]
    acting.sort(key=lambda pair: STAGES.index(pair[0].term.stage))
    for at_output in (False, True):
        for each, path in acting:
            if each.term.at_output is at_output:
                variant = each.channel.partition(":")[2]
                signal = each.term.passed(signal, each.values, _view(path, readout, variant))
        if not at_output:
            signal = signal + beneath
    return signal


def _comb(path: Path) -> Array:
    comb = path.axis.require_capacitance()
    return capacitance(path.angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th) + _extra(path, 0)


def _comb_slope(path: Path) -> Array:
    comb = path.axis.require_capacitance()
    return capacitance_slope(path.angle, comb.C0, comb.theta0, comb.theta_th) + _extra(path, 1)


def _extra(path: Path, derivative: int) -> Array | float:
    from scanner.trajectory import Bell

    bells = [Bell(each.term.bell, each.values) for each in path.added if each.term.bell is not None]
    return sum((bell.along(path.angle, path.axis)[derivative] for bell in bells), start=0.0)


def _view(path: Path, readout: Readout | None, variant: str = "") -> View:
    inputs = path.inputs
    raw = samples(inputs.voltage)
    return View(inputs.time, inputs.step, readout, path.voltage, raw, path.angle, path.rate, variant)


def samples(voltage: Array) -> Array:
    """Of a voltage at the start, middle and end of every step, shape (n, 3), that at the n + 1 samples."""
    return np.append(voltage[:, 0], voltage[-1, 2])
