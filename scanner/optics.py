"""The device's optics terms: from mirror angles to beam positions, and from light to the recorded intensity."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from scanner.active_terms import ActiveTerm, in_signal_order, stated_terms
from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import BadInput
from scanner.terms import SignalContext

_EMPTY = np.empty(0)

MIN_RAMP_SAMPLES, MIN_RAMP_DELAYS = 4096, 16
"""Least length of the ramp that measures a delay, in samples and in delays. In half of it a detector settles to
exp(-8) = 3e-4 of its time constant."""

MAX_DELAY_SAMPLES = 1 << 20
"""Longest delay that is measured [samples]: 0.2 s at 5 MHz, longer than many frames. The ramp takes 0.1 GB."""


def terms_on_channel(device: Device, channel: str, axis: str | None = None) -> list[ActiveTerm]:
    """Return the terms that the device states for a channel, of one axis or of all, in signal order.

    Raises:
        DeviceInvalid: the device has no such axis.
        BadInput: as :func:`scanner.active_terms.stated_terms`.
    """
    axes = device.axes.values() if axis is None else (device.axis(axis),)
    return in_signal_order(term for one in axes for term in stated_terms(one) if term.channel == channel)


def apply_terms(terms: Iterable[ActiveTerm], signal: Array, time: Array) -> Array:
    """Return a signal (n,) after the effects of ``terms`` on their channel.

    Args:
        terms: in the order in which they act.
        signal: shape (n,).
        time: uniform, from the start of the recording, shape (n,) [s].
    """
    step = float(time[1] - time[0]) if time.size > 1 else 1.0
    context = SignalContext(time, step, None, _EMPTY, _EMPTY, _EMPTY, _EMPTY)
    for active in terms:
        signal = active.term.apply(signal, active.values, context)
    return signal


def beam_position(device: Device, axis: str, angle: Array, time: Array) -> Array:
    """Return the position of the beam on the sample, as the mirror angle that would put it there, shape (n,) [rad].

    Args:
        device: states the terms.
        axis: name of the axis.
        angle: of the mirror, shape (n,) [rad].
        time: as in :func:`apply_terms`.
    """
    return apply_terms(terms_on_channel(device, "place", axis), angle, time)


def apply_intensity_terms(device: Device, light: Array, time: Array) -> Array:
    """Return the noiseless intensity channel for light (n,) on the detector; ``time`` as in :func:`apply_terms`."""
    return apply_terms(terms_on_channel(device, "intensity"), light, time)


def intensity_delay(device: Device, step: float) -> float:
    """Return the delay of the intensity channel against the light [s], measured with a ramp.

    Args:
        device: states the terms.
        step: sampling interval of the channel [s].

    Raises:
        BadInput: the delay is longer than ``MAX_DELAY_SAMPLES``, or no light reaches the channel.
    """
    terms, samples = terms_on_channel(device, "intensity"), MIN_RAMP_SAMPLES
    while True:
        time = step * np.arange(samples, dtype=np.float64)
        ramp, gain = apply_terms(terms, time, time), apply_terms(terms, np.ones(samples), time)
        middle = samples // 2  # after the transient of the start, and before the samples that a shift runs out of
        if not gain[middle] > 0.0:
            what = f"holds no light {time[middle]:.3g} s after the start by the terms of {device.name}"
            raise BadInput(what, channel="intensity", hint="check tau of its terms, in seconds")
        delay = float(time[middle] - ramp[middle] / gain[middle])
        if MIN_RAMP_DELAYS * abs(delay) <= samples * step:
            return delay
        if abs(delay) > MAX_DELAY_SAMPLES * step:
            what = f"comes {delay:.3g} s or more after the light by the terms of {device.name}"
            raise BadInput(what, channel="intensity", hint="check tau and f_c of its terms; both are in SI units")
        samples *= 2


def intensity_gain(device: Device, time: Array) -> Array:
    """Return the intensity for constant light of 1, shape (n,); ``time`` as in :func:`apply_terms`."""
    return apply_terms(terms_on_channel(device, "intensity"), np.ones_like(time), time)
