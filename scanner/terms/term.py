"""What a term is: one physical effect beyond the nominal laws, told once for simulator, diagnosis and estimators.

A term file holds one ``TERM``. Its law is one or more of these functions, in the order in which a signal meets them:

==============  ============================================================================================
``constants``   ``(axis, p) -> axis``: other values in the nominal laws
``voltage``     ``(voltage, p, view) -> voltage``: the drive, shape (n, 3) as in ``scanner.trajectory``
``torque``      compiled with ``TORQUE``: torque and hidden states (mechanics)
``bell``        compiled with ``BELL``: extra capacitance and its slope
``modulate``    ``(capacitance, p, view) -> capacitance``: before an AMDM readout's sections
``output``      ``(signal, p, view) -> signal``: the channel that the variant names; ``"place"`` is where on the
                sample the beam stands, told as an angle
``clock``       ``(time, p) -> time``: which time a sample of that channel shows
``corners``     ``(p) -> corners``: first-order low-passes that the channel passes last [Hz]
==============  ============================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.device import Axis, Readout
from scanner.lowpass import low_passed

Array = NDArray[np.float64]

STAGES = ("drive", "mechanics", "capacitance", "readout", "timing", "optics")
AMPLITUDES = ("linear", "inverse", "factor")
"""Kinds of parameter that say how much of the effect there is: at x = 0 there is none."""


@dataclass(frozen=True)
class Scales:
    """Natural sizes of one axis in one recording, from which prior ranges are told.

    Attributes:
        amplitude: of the motion [rad].
        rate: its angular frequency, in a sweep that of the resonance [rad/s].
        J, b, k: nominal mechanics.
        duration: of the recording [s].
        voltage_mean, voltage_rms: of the drive: mean, and deviation from it [V].
        drive_rate: angular frequency of the drive's strongest line, of the motion where there is none [rad/s].
        sense_rms, sense_peak: deviation of the sense signal from its mean, and its largest magnitude [V].
        readout: of the axis, None where it has none.
        line: frequency of a line in the residual that neither drive nor motion explains, None where there is none [Hz].
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
    """One number of a term, and how large it may plausibly be.

    The diagnosis works with x, standard normal a priori. ``linear``: value = scale x. ``inverse``: value = scale / x
    (a corner frequency: nothing happens at x = 0). ``factor``: value = scale exp(spread x), nothing happens at x = 0.
    ``log``: value = scale exp(spread x), a time constant or frequency that does nothing by itself. ``line``: value =
    scale + x / duration, the frequency of a line that was seen. ``fixed``: value = scale.

    Attributes:
        scale: natural size, from the recording's scales.
        sign: +1 or -1 where physics allows only x of that sign, 0 where both.
        starts: values of x to search from, for a ``log`` parameter.
    """

    name: str
    unit: str
    scale: Callable[[Scales], float]
    kind: str = "linear"
    spread: float = 1.0
    sign: int = 0
    starts: tuple[float, ...] = (0.0,)

    def value(self, x: float, scales: Scales) -> float:
        """The physical value of ``x``."""
        size = self.scale(scales)
        if self.kind == "linear":
            return size * x
        if self.kind == "inverse":
            return size / x if x else float("inf")
        if self.kind == "fixed":
            return size
        if self.kind == "line":
            return size + x / scales.duration
        return size * float(np.exp(np.clip(self.spread * x, -60.0, 60.0)))


@dataclass(frozen=True)
class View:
    """What an array law may look at.

    Attributes:
        time: of the samples, from the recording's start [s].
        step: between them [s].
        readout: nominal readout.
        voltage: drive at the samples, terms included [V].
        raw_voltage: drive at the samples as recorded [V].
        theta, rate: the mirror's motion [rad, rad/s].
        variant: which of the term's variants.
    """

    time: Array
    step: float
    readout: Readout | None
    voltage: Array
    raw_voltage: Array
    theta: Array
    rate: Array
    variant: str = ""


@dataclass(frozen=True)
class Term:
    """One effect.

    Attributes:
        effect: name in the catalogue.
        stage: one of ``STAGES``.
        equation: the law with the term in it, as text.
        parameters: in the order in which the laws take them.
        source: where it was published.
        lookalikes: effect -> what tells the two apart.
        hidden: scales of the hidden states (angle for angle), at most two. What they do to the mirror is in proportion
            to the first parameter, an amplitude.
        seeds: where the effect grows out of them instead, values of x of the hidden states to search from.
        applies: whether an axis can show the effect at all, from its axis and scales.
        channels: kinds of channel that ``output`` acts on, one variant each: ``"sense"``, ``"angle"``,
            ``"intensity"`` or ``"place"``.
        at_output: whether ``output`` acts last of all, on what the converter sees.
        of_axis: on an electrode that all combs share, whether each axis may have the effect for itself.
        coupled: whether ``torque`` looks at the other axis's angle.
    """

    effect: str
    stage: str
    equation: str
    parameters: tuple[Parameter, ...]
    source: str
    lookalikes: Mapping[str, str] = field(default_factory=dict)
    constants: Callable[[Axis, Sequence[float]], Axis] | None = None
    voltage: Callable[[Array, Sequence[float], View], Array] | None = None
    torque: Callable[..., Any] | None = None
    bell: Callable[..., Any] | None = None
    modulate: Callable[[Array, Sequence[float], View], Array] | None = None
    output: Callable[[Array, Sequence[float], View], Array] | None = None
    clock: Callable[[Array, Sequence[float]], Array] | None = None
    corners: Callable[[Sequence[float]], tuple[float, ...]] | None = None
    hidden: tuple[Callable[[Scales], float], ...] = ()
    seeds: tuple[tuple[float, ...], ...] = ()
    applies: Callable[[Axis, Scales], bool] = lambda axis, scales: True
    channels: tuple[str, ...] = ("sense",)
    at_output: bool = False
    of_axis: bool = False
    coupled: bool = False

    @property
    def on_channel(self) -> bool:
        """Whether the effect acts on a recorded channel, behind all that the mirror does."""
        return not (self.output is None and self.clock is None and self.corners is None)

    def passed(self, signal: Array, p: Sequence[float], view: View) -> Array:
        """``signal`` (n,) of the channel that the effect acts on, as it leaves the effect."""
        if self.output is not None:
            signal = self.output(signal, p, view)
        if self.clock is not None:
            signal = shifted(signal, (self.clock(view.time, p) - view.time) / view.step)
        for corner in self.corners(p) if self.corners is not None else ():
            signal = section(signal, corner, view.step)
        return signal

    def values(self, x: Sequence[float], scales: Scales) -> tuple[float, ...]:
        """Physical values of all parameters from the free ones' ``x``."""
        free = iter(x)
        return tuple(p.value(0.0 if p.kind == "fixed" else next(free), scales) for p in self.parameters)

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The parameters that are not fixed."""
        return tuple(p for p in self.parameters if p.kind != "fixed")


def section(signal: Array, corner: float, step: float) -> Array:
    """First-order low-pass of corner frequency ``corner`` [Hz] over ``signal`` (n,), from its own first value on.

    A negative corner mirrors the change, so that a fit may walk through zero lag.
    """
    if not np.isfinite(corner):
        return signal
    slow = low_passed(signal, abs(corner), step)
    return slow if corner > 0 else 2.0 * signal - slow


def shifted(signal: Array, samples: Array | float) -> Array:
    """``signal`` (n,) read ``samples`` later (negative: earlier) than each sample, by cubic interpolation."""
    at = np.arange(signal.size) + samples
    first = np.clip(np.floor(at).astype(np.intp), 1, signal.size - 3)
    u = np.clip(at - first, -1.0, 2.0)
    a, b, c, d = signal[first - 1], signal[first], signal[first + 1], signal[first + 2]
    return (
        -u * (u - 1) * (u - 2) / 6 * a + (u + 1) * (u - 1) * (u - 2) / 2 * b
        - (u + 1) * u * (u - 2) / 2 * c + (u + 1) * u * (u - 1) / 6 * d
    )  # fmt: skip
