"""Motion of axes without a sense signal: from drive and averaged dynamics, corrected by phases from the picture.

The motion begins in the steady state under the drive. The tolerances of stiffness and damping give the covariance of
its phase and amplitude. The two are correlated, so that a phase measured in the picture corrects the amplitude too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from estimation.signals import SenseChannel, drive_channel, intensity_clock, phase_reference
from estimation.tracker.amplitude_table import MAX_AMPLITUDE_THETA0
from estimation.tracker.averaged_dynamics import average_cycle, axis_parameters, unpack_parameters
from estimation.tracker.block_signal import MIN_OFFSET_DENSITY_V2_PER_S, BlockSignal
from estimation.tracker.block_tracking import track_blocks
from estimation.tracker.demodulation import NoiseSpectrum
from estimation.tracker.drive_blocks import BlockDrive, demodulate_drive
from estimation.tracker.initial_state import RELATIVE_STIFFNESS_SD, STIFFNESS_RATE_SD_PER_S
from estimation.tracker.kalman_filter import StateEstimate
from estimation.tracker.observations import MIN_BLOCKS, NO_CLIPPED_BLOCKS, BlockObservations
from estimation.tracker.phase_measurements import PhaseMeasurement, with_phase_measurements
from estimation.tracker.process_noise import MIN_DENSITIES
from estimation.tracker.state_space import AXIS_STATES, DAMPING, LOG_AMPLITUDE, PHASE, STIFFNESS, STIFFNESS_RATE
from estimation.tracker.to_motion import axis_knots, motion_of_knots
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.stages import Position

BLOCK_CYCLES = 2.0
"""Length of a block in cycles of the axis; shorter where the recording holds fewer than ``MIN_BLOCKS`` of them."""

NO_READOUT = Position(gain=1.0, noise_sd=0.0)
"""Stands in where a readout is required; no sample is read through it."""

START_AMPLITUDE_THETA0 = 0.75
"""Amplitude at which the search for the steady motion starts, in units of theta0: near the largest torque of a comb."""

MAX_DECAY_TIMES = 30.0
"""Decay times over which the search for the steady motion is integrated: transients are then below 1e-13."""

STEP_DECAY_TIMES = 0.1
"""Step of that integration in decay times. The linearly implicit Euler method follows growth and decay with it, and is
stable for a drive beside the resonance, under which the phase turns many times in a decay time."""

MAX_STEP_CHANGE = 1.0
"""Largest change of phase [rad] and ln A in one step. Under a linear drive both rates grow as 1/A while the motion
passes a small amplitude. The limit changes the way to the steady motion, not the steady motion."""

MAX_STEADY_CHANGE = 1e-5
"""Change of phase [rad] and ln A over the last step at which the motion counts as steady."""

INITIAL_SD = (0.01, 0.005)
"""Standard deviations of phase [rad] and ln A about the steady motion, in addition to those from stiffness and
damping."""

STIFFNESS_RATE_DENSITIES = 10.0 ** np.arange(-1.5, 2.0)
"""Spectral densities of the stiffness rate that are compared [1/s^3]. The least one is 0.05 % in 30 ms.

A few measured phases cannot prove a slower drift.
"""


class SteadyMotion(NamedTuple):
    """Steady motion under a drive.

    Attributes:
        phase: [rad]. log_amplitude: ln A.
        by_parameters: derivatives of the two by relative changes of k and b, shape (2, 2).
    """

    phase: float
    log_amplitude: float
    by_parameters: Array


def track_drive_only(
    recording: Recording, device: Device, phases: Mapping[str, PhaseMeasurement] | None = None
) -> Motion:
    """Motion of all axes from their drives and, if there are any, from measured phases.

    Args:
        phases: as in ``track``. Without them the phase's standard deviation, from the device's tolerances, is degrees.

    Raises:
        ChannelMissing: a drive was not recorded. DeviceInvalid: the device lacks a value.
        BadInput: a drive cannot be used, or sustains no motion.
    """
    axes, best_densities = {}, {}
    for name in device.axes:
        observations = with_phase_measurements(drive_only_observations(recording, device, name), phases or {})
        start = steady_state_estimate(observations, device)
        densities = np.array([[[MIN_DENSITIES[0], q, *MIN_DENSITIES[2:]]] for q in STIFFNESS_RATE_DENSITIES])
        tracks = track_blocks(observations, start, densities)
        best = int(np.argmax([track.log_likelihood for track in tracks]))
        drive = observations.sense.channel
        sign = "ambiguous" if observations.parameters[0].electrostatic_factor else "known: the drive"
        knots = axis_knots(observations, tracks[best].states, tracks[best].sds, 0)
        axes[name] = motion_of_knots(observations.references[name], knots, intensity_clock(recording, drive), sign)
        best_densities[name] = float(STIFFNESS_RATE_DENSITIES[best])
    return Motion(axes, "picture", {"stiffness_trend_walk": best_densities})


def drive_only_observations(recording: Recording, device: Device, name: str) -> BlockObservations:
    """Observations of one axis that contain its drive, but no projections of a sense signal.

    Raises:
        ChannelMissing: the drive was not recorded. BadInput: it cannot be used. DeviceInvalid: a value is missing.
    """
    channel = recording.require(f"drive_{name}", "without a sense signal the motion is computed from it")
    reference = phase_reference(recording, device, name)
    law = axis_parameters(device.axis(name), NO_READOUT)
    time, width = _block_times(channel, reference.frequency)
    drive = demodulate_drive(drive_channel(recording, name), reference, time, width, law)
    main_order = 2 if law.electrostatic_factor else 1
    signal = _signal_without_lines(drive, width, main_order, MAX_AMPLITUDE_THETA0 * law.theta0)
    sense, references = SenseChannel(channel, NO_READOUT, (name,)), {name: drive.reference}
    return BlockObservations(sense, references, (law,), time, signal, 0.0, NO_CLIPPED_BLOCKS, 1.0)


def _block_times(channel: Channel, frequency: float) -> tuple[Array, float]:
    """Middles of the blocks, shape (blocks,), and width of a block [s]."""
    length = min(round(BLOCK_CYCLES / frequency * channel.sample_rate), channel.size // MIN_BLOCKS)
    starts = np.arange(channel.size // length) * length
    return channel.start + (starts + 0.5 * (length - 1)) / np.float64(channel.sample_rate), length / channel.sample_rate


def _signal_without_lines(drive: BlockDrive, step: float, main_order: int, max_amplitude: float) -> BlockSignal:
    """A signal whose only projection, the mean, has no samples in any block."""
    blocks = drive.psi.size
    zeros = np.zeros((blocks, 1))
    return BlockSignal(
        psi=drive.psi[:, None],
        w=drive.w[:, None],
        force=np.ascontiguousarray(drive.force[:, None]),
        drive_share=drive.drive_share[:, None],
        step=step,
        lines=np.zeros((0, 2), np.int64),
        response=np.zeros((blocks, 0), np.complex128),
        response_slope=np.zeros((blocks, 0), np.complex128),
        mean_gain=0.0,
        mean_delay=0.0,
        table_w=drive.w[:, None],
        spectrum=NoiseSpectrum(1.0, np.zeros(1)),
        whitened=zeros,
        whitened_moments=np.zeros((1, 3, 1, 1)),
        solvers=np.zeros((1, 1, 1)),
        geometry=np.zeros(blocks, np.int64),
        noise_var=np.ones(blocks),
        offset_density=MIN_OFFSET_DENSITY_V2_PER_S,
        external_phase=zeros.copy(),
        external_var=np.full((blocks, 1), np.inf),
        amplitude_table=np.array([[[0.0, max_amplitude], [0.0, max_amplitude]]]),
        main_order=main_order,
    )


def steady_state_estimate(observations: BlockObservations, device: Device) -> StateEstimate:
    """Steady motion under the first block's drive, with the covariance from the device's tolerances.

    Raises:
        BadInput: the drive sustains no motion.
    """
    (name,) = observations.sense.axes
    motion = find_steady_motion(observations)
    if motion is None:
        raise BadInput(
            f"sustains no motion of axis {name} by the device's values when the recording begins",
            file=observations.sense.channel.file,
            channel=observations.sense.channel.name,
            hint="check voltage and frequency of the drive, and the device",
        )
    x, P = np.zeros(AXIS_STATES + 1), np.zeros((AXIS_STATES + 1, AXIS_STATES + 1))
    x[PHASE], x[LOG_AMPLITUDE] = motion.phase, motion.log_amplitude
    parameters, pair = [STIFFNESS, DAMPING], [PHASE, LOG_AMPLITUDE]
    # The calibrated damping is used as it is: it determines the amplitude, which the picture does not show.
    spread = np.square([np.hypot(device.tolerance(name, "k"), RELATIVE_STIFFNESS_SD), device.tolerance(name, "b")])
    P[parameters, parameters] = spread
    P[np.ix_(pair, parameters)] = motion.by_parameters * spread
    P[np.ix_(parameters, pair)] = P[np.ix_(pair, parameters)].T
    P[np.ix_(pair, pair)] = motion.by_parameters * spread @ motion.by_parameters.T + np.diag(np.square(INITIAL_SD))
    P[STIFFNESS_RATE, STIFFNESS_RATE] = STIFFNESS_RATE_SD_PER_S**2
    P[-1, -1] = P[AXIS_STATES - 1, AXIS_STATES - 1] = 1.0  # offset and gain of the absent readout
    return StateEstimate(x, P, np.array([True]))


def find_steady_motion(observations: BlockObservations) -> SteadyMotion | None:
    """The steady motion of largest amplitude under the first block's drive; None where every motion decays.

    The averaged equations are integrated from four initial phases.
    """
    law, signal = unpack_parameters(observations.parameter_rows[0]), observations.signal
    w, force = float(signal.w[0, 0]), signal.force[0, 0]
    step = STEP_DECAY_TIMES * 2.0 * law.J / law.b
    log_limit = np.log(MAX_AMPLITUDE_THETA0 * law.theta0)
    best = None
    for phase in np.pi * np.arange(4) / 4:
        log = float(np.log(START_AMPLITUDE_THETA0 * law.theta0))
        for _ in range(round(MAX_DECAY_TIMES / STEP_DECAY_TIMES)):
            cycle = average_cycle(law, np.exp(log), phase, w, law.k, law.b, force)
            slope = np.eye(2) - step * _phase_and_log_rows(cycle.by_phase, cycle.by_log)
            change = np.linalg.solve(slope, (step * cycle.rate.imag, step * cycle.rate.real))
            turn, growth = np.clip(change, -MAX_STEP_CHANGE, MAX_STEP_CHANGE).tolist()
            phase, log = phase + turn, min(log + growth, log_limit)
        cycle = average_cycle(law, np.exp(log), phase, w, law.k, law.b, force)
        if abs(cycle.rate) * step < MAX_STEADY_CHANGE and (best is None or log > best.log_amplitude):
            by_state = _phase_and_log_rows(cycle.by_phase, cycle.by_log)
            by_parameters = _phase_and_log_rows(cycle.by_stiffness, cycle.by_damping)
            best = SteadyMotion(
                float(np.angle(np.exp(1j * signal.main_order * phase))) / signal.main_order,
                log,
                np.asarray(-np.linalg.solve(by_state, by_parameters), np.float64),
            )
    return best


def _phase_and_log_rows(*rates: complex) -> Array:
    """Rates of phase in the first row and of ln A in the second, one column for each argument."""
    return np.array([[rate.imag for rate in rates], [rate.real for rate in rates]])
