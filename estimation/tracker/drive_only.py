"""Motion of axes without a sense signal: from drive and averaged dynamics, corrected by phases from the picture.

The motion begins in the steady state under the drive. The tolerances of stiffness and damping give the covariance of
its phase and amplitude. The two are correlated, so that a phase measured in the picture corrects the amplitude too.
A phase that only another stiffness within the tolerance explains selects that stiffness.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimation.signals import SenseChannel, drive_channel, intensity_clock, phase_reference
from estimation.tracker.amplitude_table import MAX_AMPLITUDE_THETA0
from estimation.tracker.averaged_dynamics import axis_parameters
from estimation.tracker.block_signal import MIN_OFFSET_DENSITY_V2_PER_S, BlockSignal
from estimation.tracker.block_tracking import track_blocks
from estimation.tracker.demodulation import NoiseSpectrum
from estimation.tracker.drive_blocks import BlockDrive, demodulate_drive
from estimation.tracker.initial_state import RELATIVE_STIFFNESS_SD, STIFFNESS_RATE_SD_PER_S
from estimation.tracker.kalman_filter import StateEstimate
from estimation.tracker.observations import MIN_BLOCKS, NO_CLIPPED_BLOCKS, BlockObservations
from estimation.tracker.phase_measurements import UNKNOWN_PHASE_SD, PhaseMeasurement, with_phase_measurements
from estimation.tracker.process_noise import MIN_DENSITIES
from estimation.tracker.state_space import (
    AXIS_STATES,
    DAMPING,
    LOG_AMPLITUDE,
    MIN_AMPLITUDE_THETA0,
    PHASE,
    STIFFNESS,
    STIFFNESS_RATE,
)
from estimation.tracker.steady_motion import PHASE_STEP_RAD, SteadyBranch, find_steady_branch, steady_motion_at
from estimation.tracker.to_motion import axis_knots, motion_of_knots
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.stages import Position

BLOCK_CYCLES = 2.0
"""Length of a block in cycles of the axis; shorter where the recording holds fewer than ``MIN_BLOCKS`` of them."""

NO_READOUT = Position(gain=1.0, noise_sd=0.0)
"""Stands in where a readout is required; no sample is read through it."""

INITIAL_SD = (0.01, 0.005)
"""Standard deviations of phase [rad] and ln A about the steady motion, in addition to those from stiffness and
damping."""

FIRST_PHASE_SD_RAD = np.deg2rad(4.0)
"""Standard deviation with which the first measured phase selects the stiffness at the start: the phase drifts until it
is measured, and the filter uses the measurement itself with its own standard deviation."""

MAX_UNEXPLAINED_PHASE_RAD = np.deg2rad(15.0)
"""Difference of a phase from the steady motions up to which a stiffness explains it: the registration corrects it."""

STIFFNESS_RATE_DENSITIES = 10.0 ** np.arange(-1.5, 2.0)
"""Spectral densities of the stiffness rate that are compared [1/s^3]. The least one is 0.05 % in 30 ms.

A few measured phases cannot prove a slower drift.
"""


def track_drive_only(
    recording: Recording, device: Device, phases: Mapping[str, PhaseMeasurement] | None = None
) -> Motion:
    """Motion of all axes from their drives and, if there are any, from measured phases.

    Args:
        phases: as in ``track``. Without them the phase's standard deviation, from the device's tolerances, is degrees.

    Raises:
        ChannelMissing: a drive was not recorded. DeviceInvalid: the device lacks a value.
        BadInput: a drive cannot be used, sustains no motion, or none that has the measured phases.
    """
    axes, best_densities = {}, {}
    for name in device.axes:
        observations = with_phase_measurements(drive_only_observations(recording, device, name), phases or {})
        start = steady_state_estimate(observations, device)
        densities = np.array([[[MIN_DENSITIES[0], q, *MIN_DENSITIES[2:]]] for q in STIFFNESS_RATE_DENSITIES])
        tracks = track_blocks(observations, start, densities)
        drive = observations.sense.channel
        in_range = [k for k, track in enumerate(tracks) if _is_in_range(track.states[:, LOG_AMPLITUDE], observations)]
        if not in_range:
            raise BadInput(
                f"no motion of axis {name} under this drive has the phases that the picture shows",
                file=drive.file,
                channel=drive.name,
                hint="check Q, resonance and tolerances of the device",
            )
        best = max(in_range, key=lambda k: tracks[k].log_likelihood)
        sign = "ambiguous" if observations.parameters[0].electrostatic_factor else "known: the drive"
        knots = axis_knots(observations, tracks[best].states, tracks[best].sds, 0)
        axis = motion_of_knots(observations.references[name], knots, intensity_clock(recording, drive), sign)
        is_measured = bool(np.isfinite(observations.signal.external_var).any())
        axes[name] = axis if is_measured else _state_unmeasured(axis, start)
        best_densities[name] = float(STIFFNESS_RATE_DENSITIES[best])
    return Motion(axes, "picture", {"stiffness_trend_walk": best_densities})


def _is_in_range(log_amplitude: Array, observations: BlockObservations) -> bool:
    """Whether a smoothed amplitude stays where the filter keeps it: few phases leave a fast drift undetermined, and the
    smoother is linear."""
    theta0 = observations.parameters[0].theta0
    low, high = np.log(MIN_AMPLITUDE_THETA0 * theta0), np.log(MAX_AMPLITUDE_THETA0 * theta0)
    return bool(log_amplitude.min() >= low and log_amplitude.max() <= high)


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

    Where a phase was measured, the motion is that of a stiffness which explains it, within the tolerance.

    Raises:
        BadInput: the drive sustains no motion.
    """
    (name,) = observations.sense.axes
    branch = _steady_branch(observations, device)
    here, probability = _select_motion(observations, branch)
    stiffness, phase, log = (float(each[here]) for each in (branch.stiffness, branch.phase, branch.log_amplitude))
    motion = steady_motion_at(observations, stiffness, phase, log)
    x, P = np.zeros(AXIS_STATES + 1), np.zeros((AXIS_STATES + 1, AXIS_STATES + 1))
    x[PHASE], x[LOG_AMPLITUDE], x[STIFFNESS] = motion.phase, motion.log_amplitude, stiffness
    pair = [PHASE, LOG_AMPLITUDE]
    is_measured = bool(np.isfinite(observations.signal.external_var).any())
    stiffness_var = float(probability @ (branch.stiffness - stiffness) ** 2)
    if is_measured:  # the filter follows the slope, and measurements correct it
        change = np.array([*motion.by_parameters[:, 0], 1.0])
        spread = stiffness_var * np.outer(change, change)
    else:
        each = (branch.phase, branch.log_amplitude, branch.stiffness)
        deviations = np.array([values - values[here] for values in each])
        spread = deviations * probability @ deviations.T
    P[np.ix_([*pair, STIFFNESS], [*pair, STIFFNESS])] = spread
    # The calibrated damping is used as it is: it determines the amplitude, which the picture does not show.
    by_damping, damping_var = motion.by_parameters[:, 1], device.tolerance(name, "b") ** 2
    P[np.ix_(pair, pair)] += damping_var * np.outer(by_damping, by_damping) + np.diag(np.square(INITIAL_SD))
    P[pair, DAMPING] = P[DAMPING, pair] = damping_var * by_damping
    P[DAMPING, DAMPING] = damping_var
    P[STIFFNESS_RATE, STIFFNESS_RATE] = STIFFNESS_RATE_SD_PER_S**2
    P[-1, -1] = P[AXIS_STATES - 1, AXIS_STATES - 1] = 1.0  # offset and gain of the absent readout
    return StateEstimate(x, P, np.array([True]))


def explain_phase(recording: Recording, device: Device, name: str, phase: float) -> tuple[float, float] | None:
    """The steady motion that a phase known up to half a turn belongs to.

    Args:
        recording, device: of the scan. name: of the axis.
        phase: against the reference of the axis, up to half a turn [rad].

    Returns:
        The phase plus the half-turns of the motion [rad], and the relative deviation of the stiffness that explains it
        best within the tolerance. None where none explains it.
    """
    branch = _steady_branch(drive_only_observations(recording, device, name), device)
    turns = np.round((branch.phase - phase) / np.pi)
    error = np.abs(branch.phase - phase - np.pi * turns)
    if error.min() > MAX_UNEXPLAINED_PHASE_RAD:
        return None
    cost = (error / PHASE_STEP_RAD) ** 2 - 2.0 * np.log(branch.probability)
    best = int(np.argmin(np.where(error < MAX_UNEXPLAINED_PHASE_RAD, cost, np.inf)))
    return phase + np.pi * float(turns[best]), float(branch.stiffness[best])


def _steady_branch(observations: BlockObservations, device: Device) -> SteadyBranch:
    """Steady motions within the tolerance of the stiffness.

    Raises:
        BadInput: there is none.
    """
    (name,) = observations.sense.axes
    branch = find_steady_branch(observations, stiffness_sd(device, name))
    if branch is None:
        raise _no_motion(observations)
    return branch


def stiffness_sd(device: Device, name: str) -> float:
    """Relative standard deviation of the stiffness of an axis when a recording begins."""
    return float(np.hypot(device.tolerance(name, "k"), RELATIVE_STIFFNESS_SD))


def _no_motion(observations: BlockObservations) -> BadInput:
    """The error for a drive that sustains no motion."""
    (name,) = observations.sense.axes
    return BadInput(
        f"sustains no motion of axis {name} by the device's values when the recording begins",
        file=observations.sense.channel.file,
        channel=observations.sense.channel.name,
        hint="check voltage and frequency of the drive, and the device",
    )


def _select_motion(observations: BlockObservations, branch: SteadyBranch) -> tuple[int, Array]:
    """Number of the steady motion at the start, and the probabilities of all, shape (n,).

    It is the most probable one where a phase was measured, else that of the device's stiffness, or of the mean one
    where the device's sustains no motion.
    """
    measured = observations.signal.external_phase[np.isfinite(observations.signal.external_var[:, 0]), 0]
    if measured.size == 0:
        is_sustained = branch.stiffness[0] <= 0.0 <= branch.stiffness[-1]
        stiffness = 0.0 if is_sustained else float(branch.probability @ branch.stiffness)
        return branch.nearest(stiffness), branch.probability
    period = 2 * np.pi / observations.signal.main_order
    error = branch.phase - measured[0]
    error -= period * np.round(error / period)
    log = np.log(branch.probability) - 0.5 * (error / FIRST_PHASE_SD_RAD) ** 2
    probability = np.exp(log - log.max())
    return int(np.argmax(log)), probability / probability.sum()


def _state_unmeasured(axis: AxisMotion, start: StateEstimate) -> AxisMotion:
    """An axis without a measured phase, with the standard deviation of all motions that the tolerances allow.

    The filter's own is that of the slope at the device's values, which is no measure of a phase that turns by much.
    """
    sd = np.clip(axis.phase_sd, np.sqrt(start.covariance[PHASE, PHASE]), None)
    return replace(axis, phase_sd=np.minimum(sd, UNKNOWN_PHASE_SD))
