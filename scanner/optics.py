"""From the mirror's angles to the intensity, and back: what a device's optics terms make of place and light."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from scanner.device import Device
from scanner.response import Added, added_terms, by_stage
from scanner.terms import View

Array = NDArray[np.float64]
_NOTHING = np.empty(0)
LONG = 4096
"""Samples after which a detector has settled."""


def acting(device: Device, channel: str, axis: str | None = None) -> list[Added]:
    """The device's terms that act on ``channel``, on one axis or on all, in the order of their stages."""
    axes = device.axes.values() if axis is None else (device.axis(axis),)
    return by_stage(each for one in axes for each in added_terms(one) if each.channel == channel)


def through(added: Iterable[Added], signal: Array, time: Array) -> Array:
    """``signal`` (n,) after the output laws of ``added``; ``time`` (n,) is even, from the recording's start on [s]."""
    step = float(time[1] - time[0]) if time.size > 1 else 1.0
    view = View(time, step, None, _NOTHING, _NOTHING, _NOTHING, _NOTHING)
    for each in added:
        if each.term.output is not None:
            signal = each.term.output(signal, each.values, view)
    return signal


def place(device: Device, axis: str, angle: Array, time: Array) -> Array:
    """Where on the sample the beam stands (n,), told as an angle [rad], when the mirror stands at ``angle`` (n,)."""
    return through(acting(device, "place", axis), angle, time)


def recorded(device: Device, light: Array, time: Array) -> Array:
    """What becomes of the light (n,) on its way to the intensity channel, noise apart."""
    return through(acting(device, "intensity"), light, time)


def delay(device: Device, step: float) -> float:
    """How late the intensity is [s]: what its laws make of a ramp against what they make of a constant."""
    time = step * np.arange(LONG, dtype=np.float64)
    added = acting(device, "intensity")
    ramp, gain = through(added, time, time), through(added, np.ones(LONG), time)
    middle = LONG // 2  # behind the start's transient, before the end, where a delay has nothing to look at
    return float(time[middle] - ramp[middle] / gain[middle])


def gain(device: Device, time: Array) -> Array:
    """What the intensity's laws make of a steady light of 1 at ``time`` (n,) [s]."""
    return through(acting(device, "intensity"), np.ones_like(time), time)
