"""Recordings of amplitude and phase at steady tones, one after another, as frequency responses."""

from __future__ import annotations

import numpy as np

from estimation.lock_in_channels import amplitude_tolerance, lock_in_amplitude
from estimation.slow.response import FEEDTHROUGH, MIN_SCORE_GAIN, Response, fit_response
from scanner.channel import Channel
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.wording import counted

MIN_TONES = 10
"""Tones that are needed: a fit has up to ten parameters and a tone has two numbers, and some tones are held out."""


def frequency_responses(recording: Recording, device: Device) -> list[Response]:
    """The axes of a recording whose amplitude and phase were taken at steady tones, whose frequencies a channel holds.

    Raises:
        BadInput: too few tones, channels of different lengths, or a phase of the wrong sign.
    """
    found = []
    for name, axis in device.axes.items():
        key, phase_key = f"amplitude_{name}", f"phase_{name}"
        if key not in recording or phase_key not in recording:
            continue
        reference = recording[phase_key].reference or recording[key].reference
        if not isinstance(reference, str):
            continue
        held = recording.require(reference, f"it is the reference of {phase_key}")
        _, amplitude, in_rad = lock_in_amplitude(recording, axis)
        phase, frequency = recording[phase_key].read(), held.read()
        if not amplitude.size == phase.size == frequency.size:
            hint = "state one amplitude, phase and frequency for every tone"
            raise BadInput("differs from its phase or its frequency in length", channel=key, hint=hint)
        order = np.argsort(frequency)
        finite = np.isfinite(amplitude) & np.isfinite(phase) & np.isfinite(frequency)
        good = order[(finite & (amplitude > 0.0))[order]]
        if np.unique(frequency[good]).size < MIN_TONES:
            what = f"holds {counted(np.unique(frequency[good]).size, 'steady tone')}, {MIN_TONES} are needed"
            raise BadInput(what, channel=key, hint="measure tones on both sides of the resonance")
        scale = float(np.abs(recording[key].read())[good].max() / amplitude[good].max())
        values = amplitude[good] * np.exp(1j * phase[good])
        found.append(Response(name, frequency[good], values, in_rad, scale, amplitude_tolerance(recording, axis)))
        _check_phase_sign(found[-1], recording[phase_key])
    return found


def _check_phase_sign(response: Response, phase: Channel) -> None:
    """Check that the phase falls with the frequency, as it does through every resonance that loses energy.

    Raises:
        BadInput: one mode with or without feedthrough explains the response better with the other sign of the phase.
    """
    stated, turned = (
        min(fit_response(each, effects).score for effects in ((), (FEEDTHROUGH,)))
        for each in (response, response._replace(values=response.values.conj()))
    )
    if stated - turned > MIN_SCORE_GAIN:
        what = "rises with the frequency through the resonance, where the phase of a motion falls"
        hint = "its sign is reversed: state gain = -1 for it, or scale = -1 in its mapping"
        raise BadInput(what, file=phase.file, channel=phase.name, hint=hint)
