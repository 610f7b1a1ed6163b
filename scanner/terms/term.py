"""The definition of a term: one physical effect beyond the nominal laws, for simulation, diagnosis and estimation.

A term file holds one ``TERM``. Its law is one or more of these functions, listed in the order in which a signal passes
them:

====================  =========================================================================================
``constants``         ``(axis, p) -> axis``: changes values of the nominal laws
``voltage``           ``(voltage, p, context) -> voltage``: the drive, shape (n, 3), see ``scanner.integrator.nodes``
``torque``            compiled with ``scanner.integrator.abi.TORQUE_LAW``: torque and hidden states
``capacitance``       compiled with ``scanner.integrator.abi.CAPACITANCE_LAW``: additional capacitance and its slope
``pre_demodulation``  ``(capacitance, p, context) -> capacitance``: before the sections of an AMDM readout
``corners``           ``(p) -> corners``: first-order low-pass sections of the channel [Hz]
``output``            ``(signal, p, context) -> signal``: one of the term's ``channels``; the channel ``"place"`` is the
                      position of the beam on the sample, as the mirror angle that would put it there [rad]
``clock``             ``(time, p) -> time``: the time at which each sample of that channel was really taken [s]
====================  =========================================================================================

``p`` holds the values of the parameters in their order. Compiled laws receive it as an array, others as a sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scanner.arrays import Array
from scanner.device import Axis
from scanner.device_toml import FINITE, NONZERO, POSITIVE
from scanner.interpolation import shift_samples
from scanner.lowpass import apply_lowpass
from scanner.stages import Readout

STAGES = ("drive", "mechanics", "capacitance", "readout", "timing", "optics")
"""Stages of the instrument, in the order in which a signal passes them."""

SMALLEST_INVERSE = 1e-3
"""Smallest x of an inverse parameter at the end of an interval. A corner frequency a thousand times its natural size
has no effect that a recording shows; an infinite one could not be written as a number."""

AMPLITUDE_KINDS = ("linear", "inverse", "factor")
"""Kinds of parameter that are the size of an effect: the effect vanishes at x = 0."""

MAX_LOG_RATIO = 60.0
"""Bound on the exponent of a ``factor`` or ``log`` parameter: exp(60) = 1e26 is beyond any physical ratio, and larger
exponents, which a fit may try, would overflow."""


NATURAL_PHASE_LAG = 0.1
"""Natural size of a delay: the phase by which it turns the signal at its own frequency [rad]. It is the same for delays
and for every low-pass, which a signal of one frequency does not distinguish: the prior must not prefer one of them."""

MIN_MODE_QUALITY = 0.5
"""Quality factor of critical damping. Below it a mode does not oscillate: it is a relaxation, which has names of its
own."""


@dataclass(frozen=True)
class NaturalScales:
    """Natural sizes of one axis in one recording, which set the prior ranges of parameters.

    Attributes:
        amplitude: of the motion [rad].
        rate: angular frequency of the motion; of the resonance where the drive is swept [rad/s].
        J, b, k: nominal mechanics [kg m^2, N m s, N m / rad].
        duration: of the recording [s].
        voltage_mean, voltage_rms: mean of the drive, and rms deviation from it [V].
        drive_rate: angular frequency of the drive's strongest spectral line; of the motion without a drive [rad/s].
        sense_rms, sense_peak: rms deviation of the sense signal from its mean, and its largest magnitude [V].
        readout: of the axis; None where it has none.
        line: frequency of a spectral line in the residual that neither drive nor motion explains; None where there is
            none [Hz].
        two_axes: whether the other axis moves as well.
    """

    amplitude: float
    rate: float
    J: float
    b: float
    k: float
    duration: float
    voltage_mean: float = 0.0
    voltage_rms: float = 0.0
    drive_rate: float = 1.0
    sense_rms: float = 1.0
    sense_peak: float = 1.0
    readout: Readout | None = None
    line: float | None = None
    two_axes: bool = False


@dataclass(frozen=True)
class Parameter:
    """One parameter of a term, and its prior range.

    The diagnosis fits x, which is standard normal a priori. The physical value follows from x by the kind:

    ===========  =======================  ==========================================================================
    ``linear``   scale x                  the size of an effect
    ``inverse``  scale / x                a corner frequency or time constant; no effect at x = 0
    ``factor``   scale exp(spread x)      a factor on a nominal value; no effect at x = 0
    ``log``      scale exp(spread x)      a time constant or frequency, which is not the size of an effect
    ``line``     scale + x / duration     the frequency of a spectral line that was detected
    ``fixed``    scale                    not fitted
    ===========  =======================  ==========================================================================

    Attributes:
        name: in device files.
        unit: of the physical value [SI].
        scale: natural size, from the scales of the recording.
        kind: one of the above.
        spread: standard deviation a priori of the logarithm, for ``factor`` and ``log``.
        sign: +1 or -1 where physics allows only x of that sign, 0 where both.
        starts: values of x to start a search from, for a ``log`` parameter.
        minimum: lower bound of a ``log`` parameter, which is added to the above, in its unit.
        must: condition on the value in a device file, one of ``scanner.device_toml``; that of the kind where None.
        any_sign_on: channels on which the value may be any finite number.
    """

    name: str
    unit: str
    scale: Callable[[NaturalScales], float]
    kind: str = "linear"
    spread: float = 1.0
    sign: int = 0
    starts: tuple[float, ...] = (0.0,)
    minimum: float = 0.0
    must: str | None = None
    any_sign_on: tuple[str, ...] = ()

    def condition(self, channel: str) -> str:
        """Return the condition that a stated value has to satisfy for a term that acts on ``channel``.

        A size or a spectral line may be any finite number. The other kinds divide or are exponentials, so 0 has no
        meaning, and a negative value only for an ``inverse`` parameter of both signs.
        """
        if channel in self.any_sign_on or (self.must is None and self.kind in ("linear", "line")):
            return FINITE["must"]
        if self.must is None and self.kind == "inverse" and self.sign != 1:
            return NONZERO["must"]
        return self.must or POSITIVE["must"]

    def possible(self, x: float) -> float:
        """Return ``x``, or its nearest value that physics allows, at which an inverse parameter is finite."""
        nearest = SMALLEST_INVERSE if self.kind == "inverse" else 0.0
        return self.sign * max(self.sign * x, nearest) if self.sign else x

    def value(self, x: float, scales: NaturalScales) -> float:
        """Return the physical value for ``x`` in a recording with the given scales."""
        size = self.scale(scales)
        if self.kind == "linear":
            return size * x
        if self.kind == "inverse":
            return size / x if x else float("inf")
        if self.kind == "fixed":
            return size
        if self.kind == "line":
            return size + x / scales.duration
        return self.minimum + size * float(np.exp(np.clip(self.spread * x, -MAX_LOG_RATIO, MAX_LOG_RATIO)))


@dataclass(frozen=True)
class SignalContext:
    """Arguments of a law on arrays in addition to its signal.

    Attributes:
        time: of the samples, from the start of the recording, shape (n,) [s].
        step: between the samples [s].
        readout: nominal; None where the axis has none.
        voltage: drive at the samples, after the drive terms, shape (n,) [V].
        raw_voltage: drive at the samples as recorded, shape (n,) [V].
        theta, rate: motion of the mirror, shape (n,) [rad, rad/s].
        variant: the text after the colon in the name of the term's channel, as in ``"sense:signal"``.
        other: the channel of the same kind of the other axis, without that axis's terms, shape (n,); only for a
            ``coupled`` term.
    """

    time: Array
    step: float
    readout: Readout | None
    voltage: Array
    raw_voltage: Array
    theta: Array
    rate: Array
    variant: str = ""
    other: Array = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class Term:
    """One effect.

    Attributes:
        effect: name in the catalogue.
        stage: one of ``STAGES``.
        equation: the law with the term in it, as text.
        parameters: in the order in which the laws take them.
        source: where the law was published.
        confounders: effect -> the measurement that distinguishes the two.
        constants, voltage, torque, capacitance, pre_demodulation, corners, output, clock: the law, see the module.
        hidden_state_scales: natural sizes of the hidden states, at most two. Their effect on the mirror is proportional
            to the first parameter, which is the size of the effect.
        initial_seeds: for an effect that grows from its hidden states: values of x of the hidden states to start a
            search from.
        applies: whether an axis can show the effect at all, from the axis and its scales.
        channels: kinds of channel that ``output`` may act on: ``"sense"``, ``"angle"``, ``"intensity"`` or ``"place"``.
            A device file selects one by its index, ``variant``.
        stated_channels: further kinds of channel, for device files and for effects that are read from the samples
            themselves; no fit searches them.
        after_noise: whether ``output`` acts on the sum of signal and noise, as the converter does.
        per_axis: on an electrode that all combs share, whether each axis may have the effect separately.
        torque_only: whether ``voltage`` adds a carrier. The torque contains its mean square; in the current of a comb
            it lies beyond the band of the readout.
        drifts: whether the effect changes with the time since the start of a recording, and so starts again with each.
        coupled: whether ``torque`` or ``output`` depends on the motion of the other axis.
    """

    effect: str
    stage: str
    equation: str
    parameters: tuple[Parameter, ...]
    source: str
    confounders: Mapping[str, str] = field(default_factory=dict)
    constants: Callable[[Axis, Sequence[float]], Axis] | None = None
    voltage: Callable[[Array, Sequence[float], SignalContext], Array] | None = None
    torque: Callable[..., Any] | None = None
    capacitance: Callable[..., Any] | None = None
    pre_demodulation: Callable[[Array, Sequence[float], SignalContext], Array] | None = None
    output: Callable[[Array, Sequence[float], SignalContext], Array] | None = None
    clock: Callable[[Array, Sequence[float]], Array] | None = None
    corners: Callable[[Sequence[float]], tuple[float, ...]] | None = None
    hidden_state_scales: tuple[Callable[[NaturalScales], float], ...] = ()
    initial_seeds: tuple[tuple[float, ...], ...] = ()
    applies: Callable[[Axis, NaturalScales], bool] = lambda axis, scales: True
    channels: tuple[str, ...] = ("sense",)
    stated_channels: tuple[str, ...] = ()
    after_noise: bool = False
    per_axis: bool = False
    torque_only: bool = False
    drifts: bool = False
    coupled: bool = False

    @property
    def variants(self) -> tuple[str, ...]:
        """The kinds of channel among which ``variant`` of a device file selects, in its order."""
        return (*self.channels, *self.stated_channels)

    @property
    def couples_motions(self) -> bool:
        """Whether the motion itself depends on that of the other axis."""
        return self.coupled and self.torque is not None

    @property
    def acts_on_channel(self) -> bool:
        """Whether the effect acts on a recorded channel, and not on the mirror."""
        return not (self.output is None and self.clock is None and self.corners is None)

    def apply(self, signal: Array, p: Sequence[float], context: SignalContext) -> Array:
        """Return a signal (n,) of the channel that the effect acts on, after the effect."""
        for corner in self.corners(p) if self.corners is not None else ():
            signal = apply_lowpass(signal, corner, context.step)
        if self.output is not None:
            signal = self.output(signal, p, context)
        if self.clock is not None:
            signal = shift_samples(signal, (self.clock(context.time, p) - context.time) / context.step)
        return signal

    def values(self, x: Sequence[float], scales: NaturalScales) -> tuple[float, ...]:
        """Return the physical values of all parameters from ``x`` of the free ones."""
        free = iter(x)
        return tuple(p.value(0.0 if p.kind == "fixed" else next(free), scales) for p in self.parameters)

    @property
    def free_parameters(self) -> tuple[Parameter, ...]:
        """The parameters that are not fixed."""
        return tuple(p for p in self.parameters if p.kind != "fixed")


def driven_by_comb(axis: Axis) -> bool:
    """Whether the voltage of an axis is on its comb: a coil or a piezo may drive a mirror that a comb senses."""
    return axis.capacitance is not None and (axis.drive is None or axis.drive.kind == "electrostatic")
