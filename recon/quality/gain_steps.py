"""Steps in the gain of a readout, as of an amplifier that changes its range: no resonator changes its amplitude so.

The amplitude of a resonator changes within its time constant Q / (pi f), whatever its drive does. A change within a few
periods between two steady parts, through which the phase continues, is thus one of the readout.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import exp, pi

import numpy as np

from estimation.reference import dominant_frequency, drive_phasors
from scanner.channel import Channel
from scanner.device import AXES, Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording

CYCLES_PER_AMPLITUDE = 2.0
"""Cycles in which an amplitude is measured: the fewest in which an offset and harmonics do not change it."""

STEADY_STEPS = 4
"""Steps from amplitude to amplitude on either side of a change in which the signal has to be steady."""

MIN_GAIN_STEP = 0.02
"""Smallest relative change that is reported: it displaces the edge of a picture of 400 pixels by 4."""

DETECTION_SDS = 12.0
"""Smallest change in standard deviations of the others: a signal has thousands of them."""

ISOLATION_RATIO = 4.0
"""Smallest change relative to those beside it. An amplitude that approaches a new value within the time constant of
the axis changes by 0.4 times as much or more in each time constant."""

MAX_PHASE_STEP_RAD = 0.3
"""Largest step of the phase in and beside a change: a gain does not turn it, and the phase of noise alone stays within
this with a probability of 1e-4 in four steps."""


def describe_gain_steps(recording: Recording, device: Device) -> list[str]:
    """A line for each sense channel of one axis whose gain steps.

    An axis without mechanics may change its amplitude at any rate, and so may one whose time constant is short.
    """
    lines = []
    for name in AXES:
        axis, channel = device.axes.get(name), recording.channels.get(f"sense_{name}")
        if axis is None or axis.mechanics is None or channel is None:
            continue
        for time, factor in _gain_steps(channel, axis):
            lines.append(
                f"{channel.name}: its amplitude changes by the factor {factor:.3g} at {time:.4g} s, faster than a "
                f"motion with a Q of {axis.quality:.3g} can: the gain or the range of its amplifier has stepped, "
                f"and the picture is scaled wrongly in {name} before or after it; use the part of the recording for "
                "which the device states the gain"
            )
    return lines


def _gain_steps(channel: Channel, axis: Axis) -> Iterator[tuple[float, float]]:
    """Times [s] and factors of the steps of a channel's amplitude, in order of time."""
    try:
        frequency = dominant_frequency(channel, 0.5 * axis.resonance)
    except BadInput:  # nothing oscillates near the resonance
        return
    time, phasors, block = drive_phasors(channel, frequency, CYCLES_PER_AMPLITUDE)
    if 2 * block / channel.sample_rate > axis.quality / (pi * axis.resonance):
        return
    known = np.isfinite(phasors) & (np.abs(phasors) > 0.0)
    step = np.diff(np.log(phasors, out=np.full(time.size, np.nan, np.complex128), where=known))
    if step.size < 2 * STEADY_STEPS + 2:
        return
    turn = np.abs(np.angle(np.exp(1j * step.imag)))
    pair = step.real[:-1] + step.real[1:]  # a change within a block is shared by the steps on both sides
    limit = max(MIN_GAIN_STEP, DETECTION_SDS * 1.48 * float(np.nanmedian(np.abs(pair))))
    inner = pair[STEADY_STEPS : pair.size - STEADY_STEPS]
    for at in STEADY_STEPS + np.flatnonzero(np.abs(inner) > limit):
        change, around = abs(pair[at]), slice(at - STEADY_STEPS, at + 2 + STEADY_STEPS)
        beside = np.abs(np.delete(step.real[around], [STEADY_STEPS, STEADY_STEPS + 1])).max()
        is_largest = change >= np.abs(pair[at - 1 : at + 2]).max()
        is_isolated = change > ISOLATION_RATIO * beside and turn[around].max() < MAX_PHASE_STEP_RAD
        if is_largest and is_isolated:
            yield float(time[at + 1]), exp(pair[at])
