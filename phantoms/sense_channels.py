"""The sense channels of a simulated recording: which readout senses which axes, and the converter."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.stages import MotionSensor, Readout


def quantise(values: Array, bits: int | None, full_range: float) -> Array:
    """Return values after a converter of ``bits`` over +- full_range / 2; unchanged for None."""
    if bits is None:
        return values
    lsb = full_range / 2**bits
    return np.clip(np.round(values / lsb), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) * lsb


def sense_channels(device: Device) -> dict[str, tuple[Readout, tuple[str, ...]]]:
    """Return the sense channels of the device, each with its readout and the axes that it senses.

    Raises:
        DeviceInvalid: a sensor of the motion for several axes.
    """
    if isinstance(device.readout, MotionSensor) and len(device.axes) > 1:
        what = f"a {device.readout.kind} sensor reads one axis"
        raise DeviceInvalid(what, channel="readout", hint="give each axis its own")
    if device.readout is not None:
        return {"sense": (device.readout, tuple(device.axes))}
    return {f"sense_{name}": (axis.readout, (name,)) for name, axis in device.axes.items() if axis.readout}
