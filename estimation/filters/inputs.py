"""Recordings prepared for the sample-by-sample filters: signal, drive, model and initial state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estimation.filters.model import FilterModel, filter_model
from estimation.initial import InitialMotion, fit_initial_motion, initial_section_states
from estimation.reference import PhaseReference, not_covered
from estimation.signals import SenseChannel, drive_channel, is_capacitive, phase_reference, sense_channels
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import Device
from scanner.recording import Recording

INITIAL_RELATIVE_SD = 0.02
"""Relative standard deviation of the initial amplitude and of the initial low-pass sections from the calibration of the
device: the tolerance of a nominal value that states none."""


@dataclass(frozen=True)
class FilterInput:
    """One sense channel prepared for a filter, for either engine.

    Attributes:
        sense, start, references: channel, initial motion and phase references of its axes.
        model: of its axes and its readout.
        signal: sense samples, shape (n,) [V].
        voltage: drive of each axis at the samples, shape (axes, n) [V].
        x, P: state, shape (states,), and covariance, shape (states, states), at the first sample.
    """

    sense: SenseChannel
    start: InitialMotion
    references: Mapping[str, PhaseReference]
    model: FilterModel
    signal: Array
    voltage: Array
    x: Array
    P: Array


def prepare_filter_inputs(recording: Recording, device: Device) -> list[FilterInput]:
    """One ``FilterInput`` per sense channel.

    Raises:
        BadInput: as ``sense_channels`` and ``fit_initial_motion``, or a drive does not cover its sense channel.
    """
    return [_prepare(recording, device, sense) for sense in sense_channels(recording, device)]


def _prepare(recording: Recording, device: Device, sense: SenseChannel) -> FilterInput:
    even = is_capacitive(sense.readout)
    references = {name: phase_reference(recording, device, name, sense.channel, even) for name in sense.axes}
    start = fit_initial_motion(sense, device, references)
    model = filter_model(device, sense.axes, sense.readout, 1.0 / sense.channel.sample_rate, start.offset)
    t0 = np.array([sense.channel.start])
    x, variances = [], []
    for name in sense.axes:
        motion, rate = start.axes[name], 2 * np.pi * float(references[name].frequency_at(t0)[0])
        phase = float(references[name].phase(t0)[0]) + motion.phase
        x += [motion.amplitude * np.sin(phase), motion.amplitude * rate * np.cos(phase)]
        sd = np.hypot(INITIAL_RELATIVE_SD * motion.amplitude, motion.amplitude * motion.phase_sd)
        variances += [sd**2, (rate * sd) ** 2]
    sections = initial_section_states(sense, device, start, references)
    total_C0 = sum(device.axis(name).require_capacitance().C0 for name in sense.axes) if sections.size else 0.0
    return FilterInput(
        sense,
        start,
        references,
        model,
        sense.channel.read(),
        np.array([_at_samples(drive_channel(recording, name), sense.channel) for name in sense.axes]),
        np.array([*x, *sections]),
        np.diag([*variances, *[(INITIAL_RELATIVE_SD * total_C0) ** 2] * sections.size]),
    )


def _at_samples(voltage: Channel | None, sense: Channel) -> Array:
    """The voltage at the samples of ``sense``, shape (n,); 0 V where none was recorded."""
    if voltage is None:
        return np.zeros(sense.size)
    if (voltage.sample_rate, voltage.start, voltage.size) == (sense.sample_rate, sense.start, sense.size):
        return voltage.read()
    if voltage.start > sense.start + 1.0 / voltage.sample_rate or voltage.end < sense.end - 1.0 / voltage.sample_rate:
        raise not_covered(voltage, sense.name, sense.start, sense.end, ", or use the estimator tracker")
    return np.interp(sense.time(), voltage.time(), voltage.read())
