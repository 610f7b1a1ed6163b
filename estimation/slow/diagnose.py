"""Diagnosis of free decays from their amplitudes: consistent, a named law of damping, or an unknown one."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.candidate_terms.significance import MIN_RIVAL_PROBABILITY
from estimation.device_fit.open_loop import OpenLoop, is_worse
from estimation.diagnosis.diagnose import Diagnosis
from estimation.diagnosis.finding import Finding, ParameterEstimate, Rival
from estimation.diagnosis.free_decay import confounders_in_one_decay, decay_advice
from estimation.least_squares import Z_95
from estimation.lock_in_channels import amplitude_tolerance, lock_in_amplitude
from estimation.reference import MIN_SAMPLES_PER_PERIOD, dominant_frequency
from estimation.slow.decay import LAWS, Law
from estimation.slow.law_units import law_estimate, relative_unit_sd
from estimation.slow.selection import (
    UNKNOWN_LAW_ERRORS,
    DecayFit,
    Decays,
    compress,
    fit_curve,
    fit_law,
    prediction_errors,
    rate_price,
)
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import DEFAULT_TOLERANCE, Axis, Device
from scanner.errors import BadInput
from scanner.lock_in import block_length, block_phasors
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.stages import MotionSensor
from scanner.terms import catalogue

MIN_COMPRESSED_TURNS = 5000.0
"""Turns of a free decay from which its waveform is diagnosed by its amplitude: integrating them takes minutes."""

BLOCK_TURNS = 20.0
"""Turns in a block of such a waveform: its amplitude changes by less than 1 % where Q exceeds 5000."""

MAX_DETUNING = 1.25
"""Frequency of a decay over the nominal resonance, or its reciprocal, up to which its line is searched. At the nominal
frequency, the amplitude of a block is 2.5 % low where the stiffness is 2 % off, and 46 % where it is 10 % off."""

MIN_SCORE_GAIN = 12.0
"""Gain of the score over a constant damping from which a law is claimed: odds of 400 to 1."""

MIN_SHARE = 0.9
"""Share of the misfit that a named law explains at least of what a free curve explains; below, the law is unknown."""

MIN_REMAINDER = 0.005
"""Share of the misfit below which no remainder is reported: the accuracy of a share."""

METRIC = "error of the amplitude on samples not used in the fit, as a fraction of the amplitude (rms)"


class SlowDecay(NamedTuple):
    """Free decay of one axis.

    Attributes:
        name: of the axis.
        channel: from which the amplitude was taken.
        time: [s], amplitude: in rad or in another unit, shape (n,).
        in_rad: whether the amplitude is in rad.
        scale: unit of the channel over the unit of ``amplitude``.
        tolerance: relative standard uncertainty of ``amplitude``, by that of the sensor's gain.
    """

    name: str
    channel: str
    time: Array
    amplitude: Array
    in_rad: bool
    scale: float
    tolerance: float = 0.0


def slow_decays(recording: Recording, device: Device) -> list[SlowDecay]:
    """The free decays of a recording that are diagnosed by their amplitude, at most one an axis.

    That is an ``amplitude_x`` channel beside no other signal of the motion, or the waveform of a sensor of the motion
    over more than ``MIN_COMPRESSED_TURNS`` turns without a drive. A block of a waveform with a sample that is not
    finite has no amplitude (NaN).

    Raises:
        BadInput: a channel holds no sample that can be used.
    """
    decays = []
    for name, axis in device.axes.items():
        found = [kind for kind in ("sense", "angle", "velocity", "acceleration") if f"{kind}_{name}" in recording]
        if f"amplitude_{name}" in recording and not found:
            time, amplitude, in_rad = lock_in_amplitude(recording, axis)
            scale = _largest(recording[f"amplitude_{name}"].read()) / _largest(amplitude)
            uncertain = amplitude_tolerance(recording, axis)
            decays.append(SlowDecay(name, f"amplitude_{name}", time, amplitude, in_rad, scale, uncertain))
            continue
        if axis.mechanics is None or f"drive_{name}" in recording or f"bias_{name}" in recording:
            continue
        order, gain, key = _waveform(recording, axis)
        turns = 0.0 if key is None else recording[key].size / recording[key].sample_rate * axis.resonance
        if key is not None and turns > MIN_COMPRESSED_TURNS:
            channel = recording[key]
            if channel.sample_rate < MIN_SAMPLES_PER_PERIOD * axis.resonance:
                continue  # refused by the diagnosis of waveforms
            check_signal(channel, gaps_ok=True)
            frequency = _motion_frequency(channel, axis.resonance)
            block = block_length(frequency, channel.sample_rate, BLOCK_TURNS)
            values = channel.read()
            values -= values[np.isfinite(values)].mean()
            time, phasors = block_phasors(values, channel.sample_rate, channel.start, frequency, block)
            scale = gain * (2 * np.pi * frequency) ** order
            uncertain = axis.tolerance.get("gain", DEFAULT_TOLERANCE) if key.startswith("sense") else 0.0
            decays.append(SlowDecay(name, key, time, np.abs(phasors) / scale, True, scale, uncertain))
    return decays


def _motion_frequency(channel: Channel, resonance: float) -> float:
    """Frequency [Hz] of the strongest line near the nominal ``resonance`` [Hz], which is it where there is no line."""
    with suppress(BadInput):
        return dominant_frequency(channel, resonance / MAX_DETUNING, resonance * MAX_DETUNING)
    return resonance


def _largest(values: Array) -> float:
    """Largest magnitude; 1 where there is none."""
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size and finite.max() > 0.0 else 1.0


def _waveform(recording: Recording, axis: Axis) -> tuple[int, float, str | None]:
    """Order of derivative, volts a unit and name of the channel that follows the motion of an axis."""
    if f"angle_{axis.name}" in recording:
        return 0, 1.0, f"angle_{axis.name}"
    if isinstance(axis.readout, MotionSensor) and f"sense_{axis.name}" in recording:
        return axis.readout.order, abs(axis.readout.gain), f"sense_{axis.name}"
    return 0, 1.0, None


def diagnose_decays(measured: Sequence[SlowDecay], device: Device) -> Diagnosis:
    """Diagnose free decays against the nominal device; those of one axis have one law.

    If amplitudes are in rad, the parameters have SI units and the device is updated.

    Raises:
        BadInput: too few points of a decay, or amplitudes of one axis with and without rad.
    """
    whole = Diagnosis("consistent", (), None, device, None)
    for name in dict.fromkeys(each.name for each in measured):
        of_axis = [each for each in measured if each.name == name]
        if len({each.in_rad for each in of_axis}) > 1:
            hint = "record all of them in rad, or all in volts"
            raise BadInput("is in rad in one recording and not in another", channel=of_axis[0].channel, hint=hint)
        found = _diagnose_axis(of_axis, whole.device)
        whole = replace(
            found,
            verdict="mismatch" if "mismatch" in (whole.verdict, found.verdict) else "consistent",
            findings=(*whole.findings, *found.findings),
            unexplained="; ".join(filter(None, (whole.unexplained, found.unexplained))) or None,
            remainder=max(
                filter(None, (whole.remainder, found.remainder)), key=lambda each: float(each["share"]), default=None
            ),
            open_loop={**whole.open_loop, **found.open_loop},
        )
    return whole


def _diagnose_axis(measured: Sequence[SlowDecay], device: Device) -> Diagnosis:
    name, channel, axis = measured[0].name, measured[0].channel, device.axes[measured[0].name]
    try:
        decays = Decays.of([compress(each.time, each.amplitude) for each in measured])
    except BadInput as error:
        raise BadInput(error.what, channel=channel, hint=error.hint) from None
    constant, *laws = (fit_law(decays, law) for law in (None, *LAWS))
    stated = None if axis.mechanics is None else 0.5 * axis.mechanics.b / axis.mechanics.J
    nominal = fit_law(decays, None, stated) if stated else constant
    improved = _with_law(device, name, constant, decays)
    if nominal.score < constant.score + rate_price(decays):
        constant, improved = nominal, device
    nominal_errors, constant_errors = (prediction_errors(decays, fit.predicted) for fit in (nominal, constant))
    best, curve = min(laws, key=lambda fit: fit.score), fit_curve(decays)
    law_errors, curve_errors = (prediction_errors(decays, fit.predicted) for fit in (best, curve))
    total = _squares(constant_errors) - _squares(curve_errors)
    share = float(np.clip((_squares(constant_errors) - _squares(law_errors)) / max(total, 1e-300), 0.0, 1.0))
    named = share >= MIN_SHARE and constant.score - best.score >= MIN_SCORE_GAIN
    found_errors = law_errors if named else curve_errors
    unlisted = fit_law(decays, None, model_errors=UNKNOWN_LAW_ERRORS)
    is_unknown = not named and constant.score - unlisted.score >= MIN_SCORE_GAIN
    if not (named or is_unknown) or _is_worse(constant_errors, found_errors) or _is_worse(nominal_errors, found_errors):
        loops = _open_loop(measured, nominal_errors, constant_errors)
        return Diagnosis("consistent", (), None, improved, None, open_loop=loops)

    finding = _finding(measured, axis, best, constant, laws, decays, share if named else 1.0, named)
    before, after = (float(np.sqrt(_squares(errors) / len(errors))) for errors in (constant_errors, found_errors))
    finding = replace(
        finding,
        where=f"the rate of decay changes over the free decay of {name}: a constant one misses the amplitude by "
        f"{before:.2%} (rms), {'this law' if named else 'a free curve'} by {after:.2%}",
        heldout={"metric": METRIC, "before": before, "after": after},
    )
    if not named:
        unexplained = f"the decay of {name} follows no listed law of damping"
        loops = _open_loop(measured, nominal_errors, nominal_errors)
        return Diagnosis("mismatch", (finding,), unexplained, device, None, open_loop=loops)
    improved = device
    if measured[0].in_rad and axis.mechanics is not None:
        values = {each.name: each.value for each in finding.parameters}
        improved = _with_law(device, name, best, decays).with_terms({name: {finding.effect: values}})
    left = 1.0 - share
    remainder = {"share": left, "stage": "mechanics", "channel": channel} if left > MIN_REMAINDER else None
    loops = _open_loop(measured, nominal_errors, law_errors)
    return Diagnosis("mismatch", (finding,), None, improved, None, remainder=remainder, open_loop=loops)


def _finding(
    measured: Sequence[SlowDecay], axis: Axis, best: DecayFit, constant: DecayFit, laws: Sequence[DecayFit],
    decays: Decays, share: float, named: bool,
) -> Finding:  # fmt: skip
    law = best.law
    assert law is not None
    term = catalogue()[law.effect]
    weights = {fit.law.effect: float(np.exp(-0.5 * (fit.score - best.score))) for fit in laws if fit.law}
    total = sum(weights.values()) + float(np.exp(-0.5 * (constant.score - best.score)))
    others = {effect: weight / total for effect, weight in weights.items() if named and effect != law.effect}
    rivals = [Rival(effect, p) for effect, p in others.items() if p > MIN_RIVAL_PROBABILITY]
    advice = None
    if fit_curve(decays, common=True).score < best.score + MIN_SCORE_GAIN or len(decays.parts) == 1:
        known = {rival.effect for rival in rivals}
        confounders = [each for each in confounders_in_one_decay(law.effect) if each not in known]
        rivals += [Rival(confounder, others.get(confounder, 0.0)) for confounder in confounders]
        advice = decay_advice(confounders)
    return Finding(
        axis=axis.name,
        stage="mechanics",
        effect=law.effect if named else "unknown",
        equation=term.equation if named else "d ln A / dt = -f(A)",
        parameters=_parameters(law, best, axis, decays, measured[0]) if named else (),
        where="",
        probability=weights[law.effect] / total if named else 1.0,
        rivals=tuple(rivals),
        heldout={},
        channel=measured[0].channel,
        source=term.source if named else "free curve of the decay",
        share=share,
        advice=advice,
    )


def _squares(errors: Sequence[OpenLoop]) -> float:
    """Sum over decays of the squared error as a fraction of the amplitude."""
    return sum((each.error / each.deviation) ** 2 for each in errors)


def _is_worse(before: Sequence[OpenLoop], after: Sequence[OpenLoop]) -> bool:
    first, second = ({str(i): error for i, error in enumerate(errors)} for errors in (before, after))
    return is_worse(first, second)


def _open_loop(
    measured: Sequence[SlowDecay], nominal: Sequence[OpenLoop], improved: Sequence[OpenLoop]
) -> dict[str, object]:
    """Error of the amplitude on held-out samples, by channel and device; rms over the decays of a channel."""
    loops: dict[str, object] = {}
    for channel in dict.fromkeys(each.channel for each in measured):
        rows = [i for i, each in enumerate(measured) if each.channel == channel]
        by_device = {}
        for key, errors in (("nominal", nominal), ("improved", improved)):
            error, deviation = (
                float(np.sqrt(np.mean([(getattr(errors[i], of) * measured[i].scale) ** 2 for i in rows])))
                for of in ("error", "deviation")
            )
            by_device[key] = {"rmse": error, "fraction": error / max(deviation, 1e-300)}
        loops[channel] = by_device
    return loops


def _parameters(
    law: Law, fit: DecayFit, axis: Axis, decays: Decays, measured: SlowDecay
) -> tuple[ParameterEstimate, ...]:
    """Parameters of a law in SI units; without an angle, the rate of decay that it adds at the first amplitude."""
    sd = np.sqrt(np.maximum(np.diag(fit.covariance)[1:], 0.0))
    duration, first = decays.duration, decays.reference
    if law.power is None:
        beta, log_tau = float(fit.shared[1]), float(fit.shared[2])
        tau = float(duration * np.exp(log_tau))
        ends = float(tau * np.exp(-Z_95 * sd[1])), float(tau * np.exp(Z_95 * sd[1]))
        return law_estimate("beta", "1", beta, float(sd[0])), ParameterEstimate("tau", tau, ends, "s")
    rate, rate_sd = float(fit.shared[1]) / duration, float(sd[0]) / duration
    if not measured.in_rad or axis.mechanics is None:
        return (law_estimate("rate_at_first_amplitude", "1/s", rate, rate_sd),)
    J, w = axis.mechanics.J, 2 * np.pi * axis.resonance
    number, rate_power = {2.0: (8.0, 0.0), 1.0: (0.75 * np.pi, -1.0), -1.0: (0.5 * np.pi, 1.0)}[law.power]
    factor = number * J * w**rate_power / first**law.power
    relative_sd = relative_unit_sd(axis, measured.tolerance, law.power, rate_power)
    parameter = catalogue()[law.effect].parameters[0]
    found = [law_estimate(parameter.name, parameter.unit, factor * rate, factor * rate_sd, relative_sd)]
    if law.effect == "coulomb-friction":  # the rate at which friction turns over is far below that of the motion
        turnover = 1e-3 * first * w
        found.append(ParameterEstimate("omega_s", turnover, (0.0, 10.0 * turnover), "rad/s"))
    return tuple(found)


def _with_law(device: Device, name: str, fit: DecayFit, decays: Decays) -> Device:
    """The device with the damping of the fit, where it states mechanics."""
    axis = device.axes[name]
    if axis.mechanics is None:
        return device
    b = 2.0 * axis.mechanics.J * float(np.exp(fit.shared[0])) / decays.duration
    return replace(device, axes={**device.axes, name: replace(axis, mechanics=replace(axis.mechanics, b=b))})
