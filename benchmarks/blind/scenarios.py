"""The families of recordings: a scanner drawn at random, its drive, and a device file with values within tolerance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.motion import AMPLIFIER, CREEP, MEMORY, MODE, NODES, RATE, STATES, THETA
from benchmarks.blind.scanner_truth import Truth

Array = NDArray[np.float64]
Rng = np.random.Generator

LEAD_TIME_S = 0.3e-3
"""A trajectory starts this long before the recording [s], longer than any channel delay (150 µs)."""


@dataclass(frozen=True)
class Tones:
    """``mean`` plus the sum of ``amplitudes sin(2 pi frequencies t + phases)`` from ``start`` on [s, V, Hz, rad]."""

    start: float
    mean: float = 0.0
    amplitudes: tuple[float, ...] = ()
    frequencies: tuple[float, ...] = ()
    phases: tuple[float, ...] = ()

    def __call__(self, t: Array) -> Array:
        volts = np.full(t.shape, self.mean)
        for amplitude, frequency, phase in zip(self.amplitudes, self.frequencies, self.phases, strict=True):
            volts += amplitude * np.sin(2 * pi * frequency * t + phase)
        return volts


@dataclass(frozen=True, eq=False)
class Partner:
    """The y axis of an imaging scan; no effect is injected into it but the drift of its resonance.

    Attributes:
        truth: the axis.
        drive: its waveform.
        swing: its approximate amplitude [rad].
        shared: both axes are sensed on one electrode.
        steps_per_second: of its integration.
    """

    truth: Truth
    drive: Tones
    swing: float
    shared: bool
    steps_per_second: float


@dataclass(frozen=True)
class Scenario:
    """One scanner under one drive.

    Attributes:
        family: ``"ring"``, ``"drive"`` or ``"tf"``.
        truth: the scanner with nothing injected.
        device: its nominal device, as the table of the device file.
        drive: waveforms, one after another.
        sample_rate: of every channel [Hz].
        samples: of every channel.
        steps_per_second: the integrator's own rate; whole numbers of its steps lie between the drive's switchings.
        initial: states at ``-LEAD_TIME_S``, (STATES,). For a driven mirror, states from which it settles.
        omega: of the motion [rad/s].
        swing: its approximate amplitude, to which sizes of effects refer [rad].
        angle_sd: noise of the reference detector, None where there is none [rad].
        full_scale: of the converter, 0 where it is set to the signal [V].
        partner: the other axis of an imaging scan.
    """

    family: str
    truth: Truth
    device: dict[str, Any]
    drive: tuple[Tones, ...]
    sample_rate: float
    samples: int
    steps_per_second: float
    initial: Array
    omega: float
    swing: float
    angle_sd: float | None
    full_scale: float = 0.0
    partner: Partner | None = None

    @property
    def duration(self) -> float:
        """[s]."""
        return self.samples / self.sample_rate

    @property
    def readout(self) -> dict[str, Any]:
        """The device file's table of the readout, the shared one where both axes have one electrode."""
        table: dict[str, Any] = self.device.get("readout") or self.device["x"]["readout"]
        return table

    @property
    def tolerance(self) -> dict[str, float]:
        """Stated tolerances of x and of a shared readout."""
        return self.device["x"]["tolerance"] | self.device.get("tolerance", {})

    @cached_property
    def times(self) -> Array:
        """Of the samples, (samples,) [s]."""
        return np.arange(self.samples) / self.sample_rate

    def command(self, t: Array) -> Array:
        """The drive's command at any times [V]; a switching time belongs to what follows."""
        part = np.searchsorted([part.start for part in self.drive[1:]], t + 1e-12, side="right")
        return _of_part(self.drive, t, part)

    @cached_property
    def recorded_voltages(self) -> Array:
        """:meth:`voltages` over the recording and a little either side, at the integrator's own rate."""
        return self.voltages(-LEAD_TIME_S, self.duration + LEAD_TIME_S, 1 / self.steps_per_second)

    def voltages(self, start: float, stop: float, step: float) -> Array:
        """The command at the nodes of every step, (n, nodes) [V], by the waveform in which the step lies."""
        return _voltages(self.drive, start, stop, step)


@lru_cache(maxsize=4)
def _voltages(drive: tuple[Tones, ...], start: float, stop: float, step: float) -> Array:
    """See :meth:`Scenario.voltages`; kept, because scenarios with other initial states have the same drive."""
    first = start + step * np.arange(round((stop - start) / step))
    part = np.searchsorted([part.start for part in drive[1:]], first + 0.5 * step, side="right")
    nodes = first[:, None] + NODES * step
    volts = _of_part(drive, nodes, np.broadcast_to(part[:, None], nodes.shape))
    volts.flags.writeable = False
    return volts


def _of_part(drive: tuple[Tones, ...], t: Array, part: NDArray[np.intp]) -> Array:
    volts = np.empty(t.shape)
    for i, tones in enumerate(drive):
        volts[part == i] = tones(t[part == i])
    return volts


def ring(rng: Rng) -> Scenario:
    """A free decay under bias, read by a transimpedance amplifier (the scanner of chen2019)."""
    f0, quality, theta0 = rng.uniform(540, 880), rng.uniform(55, 90), rng.uniform(0.12, 0.18)
    C0, Cb, R_s, bias = rng.uniform(4e-12, 7.5e-12), rng.uniform(6e-12, 12e-12), 1e7, 10.0
    k = C0 / theta0**2 * bias**2 / rng.uniform(0.006, 0.03)
    J = k / (2 * pi * f0) ** 2
    truth = Truth(J=J, b=sqrt(k * J) / quality, k=k, C0=C0, Cb=Cb, theta0=theta0, R_s=R_s)
    swing, phase = rng.uniform(0.12, 0.16), rng.uniform(0, 2 * pi)
    # The largest output is where the product of the comb's slope and the rate is: near theta0/sqrt(2).
    sense_peak = R_s * bias * C0 / theta0 * sqrt(2 / np.e) * 2 * pi * f0 * swing
    readout = {"kind": "transimpedance", "R_s": R_s, "V_bias": bias, "noise_sd": sense_peak / rng.uniform(45, 110)}
    tolerance = {"k": 0.003, "b": 0.08, "C0": 0.04, "theta0": 0.04, "R_s": 0.02}
    return Scenario(
        family="ring",
        truth=truth,
        device=nominal_device(truth, readout | {"bits": 14}, tolerance, rng),
        drive=(Tones(-1.0, mean=bias),),
        sample_rate=500e3,
        samples=40_000,
        steps_per_second=800e3,
        initial=initial_states(swing * np.cos(phase), -2 * pi * f0 * swing * np.sin(phase), swing, bias),
        omega=2 * pi * f0,
        swing=swing,
        angle_sd=4e-4 if rng.random() < 0.7 else None,
    )


def drive(rng: Rng) -> Scenario:
    """Parametric drive at three frequencies in turn and a demodulator (chen2020's scanner, consistent inertia)."""
    f0, quality, J = 15_566 * rng.normal(1, 1e-4), rng.uniform(184, 195), rng.uniform(0.98e-15, 1.15e-15)
    k = J * (2 * pi * f0) ** 2
    truth = Truth(
        J=J,
        b=sqrt(k * J) / quality,
        k=k,
        C0=5.71e-12 * rng.normal(1, 0.003),
        Cb=9.79e-12,
        theta0=0.2 * rng.normal(1, 0.003),
        a_cir=-3.574e11 * rng.normal(1, 0.005),
        offset=6.3945 * rng.normal(1, 0.003),
        section_1=2 * pi * 40_800,
        section_2=2 * pi * 41_100,
        drive_mean=30.0,
    )
    first, spacing = rng.uniform(31_310, 31_350), rng.uniform(35, 55)
    frequencies = [first, first + spacing, first + 2 * spacing]
    phases, switches = [rng.uniform(0, 2 * pi)], (8e-3, 16e-3)
    for at, old, new in zip(switches, frequencies[:2], frequencies[1:], strict=True):
        phases.append(phases[-1] + 2 * pi * (old - new) * at)  # a generator stepped in frequency keeps its phase
    starts = (-1.0, *switches)
    readout = {
        "kind": "amdm", "a_cir": truth.a_cir, "b_cir": truth.offset, "lpf_hz": [40_800.0, 41_100.0],
        "noise_var": 1.92e-4, "bits": 12,
    }  # fmt: skip
    tolerance = {"k": 0.0005, "b": 0.03, "C0": 0.01, "theta0": 0.01, "a_cir": 0.02, "b_cir": 0.02}
    return Scenario(
        family="drive",
        truth=truth,
        device=nominal_device(truth, readout, tolerance, rng),
        drive=tuple(Tones(s, 30.0, (30.0,), (f,), (p,)) for s, f, p in zip(starts, frequencies, phases, strict=True)),
        sample_rate=5e6,
        samples=120_000,
        steps_per_second=6e6,
        initial=initial_states(0.2, 0.0, 0.2, 30.0),
        omega=pi * frequencies[1],
        swing=0.2,
        angle_sd=5e-4 if rng.random() < 0.7 else None,
        full_scale=8.0,
    )


def tf(rng: Rng, qualities: tuple[float, float] = (19, 55)) -> Scenario:
    """A linear actuator and a position sensor: a multisine, then one sine at two levels (the mirrors of wang2019)."""
    f0, quality, J = rng.uniform(680, 1000), rng.uniform(*qualities), 1e-12
    k = J * (2 * pi * f0) ** 2
    swing, gain, detuning = rng.uniform(0.012, 0.03), 40.0 * rng.normal(1, 0.01), rng.uniform(0.985, 0.992)
    response = quality / sqrt(1 + (2 * quality * (1 - detuning)) ** 2)
    truth = Truth(J=J, b=sqrt(k * J) / quality, k=k, torque_per_volt=swing * k / (2.0 * response), gain=gain)
    lines = np.arange(20.0, 2 * f0, rng.uniform(18, 22))
    multisine = Tones(0.0, 0.0, (sqrt(2 * 0.75**2 / len(lines)),) * len(lines), tuple(lines.tolist()),
                      tuple(rng.uniform(0, 2 * pi, len(lines)).tolist()))  # fmt: skip
    tone = detuning * f0
    sines = [Tones(at, 0.0, (level,), (tone,), (0.0,)) for at, level in ((0.6, 0.8), (0.9, 2.0))]
    readout = {"kind": "position", "gain": gain, "offset": 0.0, "noise_sd": gain * swing / rng.uniform(90, 200)}
    tolerance = {"k": 0.01, "b": 0.1, "gain": 0.03, "torque_per_volt": 0.05}
    return Scenario(
        family="tf",
        truth=truth,
        device=nominal_device(truth, readout | {"bits": 16}, tolerance, rng),
        drive=(Tones(-1.0), multisine, *sines),
        sample_rate=100e3,
        samples=120_000,
        steps_per_second=250e3,
        initial=initial_states(0.0, 0.0, 0.0, 0.0),
        omega=2 * pi * f0,
        swing=swing,
        angle_sd=None,
    )


FAMILIES: dict[str, Callable[[Rng], Scenario]] = {"ring": ring, "drive": drive, "tf": tf}


def initial_states(theta: float, rate: float, swing: float, volts: float) -> Array:
    states = np.zeros(STATES)
    states[[THETA, RATE, CREEP, MEMORY, AMPLIFIER]] = theta, rate, theta, 0.5 * swing**2, volts
    states[MODE] = 1e-5  # a parametric mode must start from something; an uncoupled one has no effect
    return states


def nominal_device(truth: Truth, readout: dict[str, Any], tolerance: dict[str, float], rng: Rng) -> dict[str, Any]:
    """The device file's table. Values with a tolerance are drawn within it, with half of it as standard deviation."""

    def stated(name: str, value: Any) -> Any:
        if name not in tolerance:
            return value
        return value * (1 + tolerance[name] * float(np.clip(0.5 * rng.standard_normal(), -1, 1)))

    axis: dict[str, Any] = {"mechanics": {name: stated(name, getattr(truth, name)) for name in ("J", "b", "k")}}
    if truth.C0:
        comb = {name: stated(name, getattr(truth, name)) for name in ("C0", "Cb", "theta0")}
        axis |= {"capacitance": comb | {"theta_th": 0.0}, "drive": {"kind": "electrostatic"}}
    else:
        axis["drive"] = {"kind": "linear", "torque_per_volt": stated("torque_per_volt", truth.torque_per_volt)}
    axis["readout"] = {name: stated(name, value) for name, value in readout.items()}
    axis["tolerance"] = tolerance
    return {"name": "blind", "x": axis}
