"""Diagnosis of a free decay from its amplitude: consistent, a named law of damping, or an unknown one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from estimation.diagnosis.diagnose import Diagnosis, Finding, ParameterEstimate, Rival
from estimation.lock_in_channels import lock_in_amplitude
from estimation.slow.decay import LAWS, Law
from estimation.slow.selection import DecayFit, compress, covariance_root, fit_free_curve, fit_law
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.lock_in import block_length, block_phasors
from scanner.recording import Recording
from scanner.stages import MotionSensor
from scanner.terms import catalogue

MIN_COMPRESSED_TURNS = 5000.0
"""Turns of a free decay from which its waveform is diagnosed by its amplitude: integrating them takes minutes."""

BLOCK_TURNS = 20.0
"""Turns in a block of such a waveform: its amplitude changes by less than 1 % where Q exceeds 5000."""

MIN_MISFIT = 0.01
"""Misfit of a constant damping, as a fraction of the amplitude (rms), below which no law is claimed: what the offsets
and the linearity of envelope detectors leave."""

MIN_SCORE_GAIN = 12.0
"""Gain of the score over a constant damping from which a law is claimed: odds of 400 to 1."""

MIN_SHARE = 0.9
"""Share of the misfit that a named law explains at least of what a free curve explains; below, the law is unknown."""

METRIC = "whitened misfit of ln A a point"

GAIN_DRIFT = "in a free decay, amplitude is a function of time: a gain that drifts may fit; record another amplitude"


class SlowDecay(NamedTuple):
    """Free decay of the axis ``name``: time [s] and amplitude, shape (n,), in rad or in another unit."""

    name: str
    time: Array
    amplitude: Array
    in_rad: bool


def slow_decay(recording: Recording, device: Device) -> SlowDecay | None:
    """The free decay of a recording that is diagnosed by its amplitude, else None.

    That is an ``amplitude_x`` channel beside no other signal of the motion, or the waveform of a sensor of the motion
    over more than ``MIN_COMPRESSED_TURNS`` turns without a drive.
    """
    for name, axis in device.axes.items():
        found = [kind for kind in ("sense", "angle", "velocity", "acceleration") if f"{kind}_{name}" in recording]
        if f"amplitude_{name}" in recording and not found:
            time, amplitude, in_rad = lock_in_amplitude(recording, axis)
            return SlowDecay(name, time, amplitude, in_rad)
        if axis.mechanics is None or f"drive_{name}" in recording or f"bias_{name}" in recording:
            continue
        order, scale, key = _waveform(recording, axis)
        if key is not None and recording[key].size / recording[key].sample_rate * axis.resonance > MIN_COMPRESSED_TURNS:
            channel, frequency = recording[key], axis.resonance
            block = block_length(frequency, channel.sample_rate, BLOCK_TURNS)
            values = channel.read()
            time, phasors = block_phasors(values - values.mean(), channel.sample_rate, channel.start, frequency, block)
            amplitude = np.abs(phasors) / scale / (2 * np.pi * frequency) ** order
            return SlowDecay(name, time, amplitude, True)
    return None


def _waveform(recording: Recording, axis: Axis) -> tuple[int, float, str | None]:
    """Order of derivative, volts a unit and name of the channel that follows the motion of an axis."""
    if f"angle_{axis.name}" in recording:
        return 0, 1.0, f"angle_{axis.name}"
    if isinstance(axis.readout, MotionSensor) and f"sense_{axis.name}" in recording:
        return axis.readout.order, abs(axis.readout.gain), f"sense_{axis.name}"
    return 0, 1.0, None


def diagnose_decay(measured: SlowDecay, device: Device) -> Diagnosis:
    """Diagnose one free decay against the nominal device.

    If the amplitude is in rad, the parameters have SI units and the device is updated.

    Raises:
        BadInput: too few points of a decay.
    """
    name, in_rad = measured.name, measured.in_rad
    try:
        decay = compress(measured.time, measured.amplitude)
    except BadInput as error:
        raise BadInput(error.what, channel=f"amplitude_{name}", hint=error.hint) from None
    root = covariance_root(decay)
    constant, *fits = (fit_law(decay, law, root) for law in (None, *LAWS))
    free_score, free_error = fit_free_curve(decay, root)
    best = min(fits, key=lambda fit: fit.score)
    gain = constant.score - min(best.score, free_score)
    if constant.rms < MIN_MISFIT or gain < MIN_SCORE_GAIN:
        improved = _with_constants(device, name, constant, float(decay.time[-1]))
        return Diagnosis("consistent", (), None, improved, None, open_loop=_errors(name, constant, constant))
    misfit = constant.rms**2 - free_error**2
    share = float(np.clip((constant.rms**2 - best.rms**2) / misfit, 0.0, 1.0))
    first = decay.first_amplitude
    finding = _finding(name, device, best, fits, constant, share, decay.time, first, in_rad)
    improved = device
    if finding.effect != "unknown" and in_rad and device.axes[name].mechanics is not None:
        values = {each.name: each.value for each in finding.parameters}
        improved = _with_constants(device, name, best, float(decay.time[-1])).with_terms(
            {name: {finding.effect: values}}
        )
    left = 1.0 - share
    remainder = {"share": left, "stage": "mechanics", "channel": f"amplitude_{name}"} if left > 0.005 else None
    unexplained = None if finding.effect != "unknown" else f"the decay of {name} follows no listed law of damping"
    return Diagnosis(
        "mismatch",
        (finding,),
        unexplained,
        improved,
        None,
        remainder=remainder,
        open_loop=_errors(name, constant, best),
    )


def _finding(
    name: str, device: Device, best: DecayFit, fits: Sequence[DecayFit], constant: DecayFit, share: float,
    time: Array, first: float, in_rad: bool,
) -> Finding:  # fmt: skip
    law, n = best.law, time.size
    assert law is not None
    term, named = catalogue()[law.effect], share >= MIN_SHARE
    weights = {fit.law.effect: float(np.exp(-0.5 * min(fit.score - best.score, 1400.0))) for fit in fits if fit.law}
    total = sum(weights.values()) + float(np.exp(-0.5 * min(constant.score - best.score, 1400.0)))
    rivals = [Rival(effect, weight / total) for effect, weight in weights.items() if effect != law.effect]
    rivals = [rival for rival in rivals if rival.probability > 1e-4]
    if not named:
        rivals = [Rival(law.effect, 0.5 * share), *rivals]
    rivals.append(Rival("gain-drift", 0.0))
    return Finding(
        axis=name,
        stage="mechanics",
        effect=law.effect if named else "unknown",
        equation=term.equation if named else "d ln A / dt = -f(A)",
        parameters=_parameters(law, best, device.axes[name], float(time[-1]), first, in_rad) if named else (),
        where=f"the rate of decay changes over the free decay of {name}: a constant one misses the amplitude by "
        f"{constant.rms:.2%} (rms), this law by {best.rms:.2%}",
        probability=weights[law.effect] / total if named else 1.0,
        rivals=tuple(rivals),
        heldout={"metric": METRIC, "before": constant.chi2 / n, "after": best.chi2 / n},
        channel=f"amplitude_{name}",
        source=term.source,
        share=share,
        advice=f"gain-drift: {GAIN_DRIFT}",
    )


def _parameters(
    law: Law, fit: DecayFit, axis: Axis, duration: float, first: float, in_rad: bool
) -> tuple[ParameterEstimate, ...]:
    """Parameters of a law in SI units; without an angle, the rate of decay that it adds at the first amplitude."""
    sd = 1.96 * np.sqrt(np.maximum(np.diag(fit.covariance)[3:], 0.0))
    if law.power is None:
        beta, log_tau = float(fit.x[3]), float(fit.x[4])
        tau = duration * np.exp(log_tau)
        ends = tau * np.exp(-sd[1]), tau * np.exp(sd[1])
        return (
            ParameterEstimate("beta", beta, (beta - float(sd[0]), beta + float(sd[0])), "1"),
            ParameterEstimate("tau", float(tau), (float(ends[0]), float(ends[1])), "s"),
        )
    rate = float(fit.x[3]) / duration
    if not in_rad or axis.mechanics is None:
        ends = rate - float(sd[0]) / duration, rate + float(sd[0]) / duration
        return (ParameterEstimate("rate_at_first_amplitude", rate, ends, "1/s"),)
    J, w = axis.mechanics.J, 2 * np.pi * axis.resonance
    factor = {2.0: 8.0 * J / first**2, 1.0: 0.75 * np.pi * J / (w * first), -1.0: 0.5 * np.pi * J * w * first}[
        law.power
    ]
    ends = factor * (rate - float(sd[0]) / duration), factor * (rate + float(sd[0]) / duration)
    parameter = catalogue()[law.effect].parameters[0]
    found = [ParameterEstimate(parameter.name, factor * rate, ends, parameter.unit)]
    if law.effect == "coulomb-friction":  # the rate at which friction turns over is far below that of the motion
        turnover = 1e-3 * first * w
        found.append(ParameterEstimate("omega_s", turnover, (0.0, 10.0 * turnover), "rad/s"))
    return tuple(found)


def _with_constants(device: Device, name: str, fit: DecayFit, duration: float) -> Device:
    """The device with the damping of the fit, where it states mechanics."""
    axis = device.axes[name]
    if axis.mechanics is None:
        return device
    b = 2.0 * axis.mechanics.J * float(np.exp(fit.x[1])) / duration
    return replace(device, axes={**device.axes, name: replace(axis, mechanics=replace(axis.mechanics, b=b))})


def _errors(name: str, nominal: DecayFit, improved: DecayFit) -> dict[str, object]:
    """Error of the amplitude with constant damping and with the law, as fractions of the amplitude."""
    return {
        f"amplitude_{name}": {
            key: {"rmse": fit.rms, "fraction": fit.rms} for key, fit in (("nominal", nominal), ("improved", improved))
        }
    }
