"""From a recording to its motion, section by section: the estimators ``tracker`` and ``tracker-causal``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from estimation.held_samples import without_held_samples
from estimation.reference import MIN_RELATIVE_FREQUENCY, PhaseReference
from estimation.signals import SenseChannel, intensity_clock, is_capacitive, phase_reference, sense_channels
from estimation.tracker.block_tracking import LOOKAHEAD_BLOCKS, average_over_noise, expand_clipped_blocks, track_blocks
from estimation.tracker.continuation import TrackEnd, Tuning, continued_prior, end_of_track, find_end
from estimation.tracker.drive_consistency import without_contradicted_pauses
from estimation.tracker.drive_ends import describe_pauses, with_whole_drives
from estimation.tracker.initial_state import choose_signs, initial_estimate
from estimation.tracker.kalman_filter import StateEstimate
from estimation.tracker.observations import BlockLayout, BlockObservations, demodulate_blocks, lay_out_blocks
from estimation.tracker.phase_measurements import PhaseMeasurement, with_phase_measurements
from estimation.tracker.process_noise import (
    INITIAL_DENSITIES,
    mean_nis,
    noise_posterior,
    tune_between_motion_and_offset,
    tune_process_noise,
    tuning_parts,
    with_offset_density,
)
from estimation.tracker.readout_curve import ReadoutCurve, describe_curves, fit_readout_curve, straightened_channel
from estimation.tracker.to_motion import AxisKnots, axis_knots, join_knots, motion_of_knots
from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

SECTION_BLOCKS = 16384
"""Blocks whose samples are projected at a time, some 10 s: bounds the memory of a long recording."""

MAX_CURVE_ROUNDS = 4
"""Largest number of times that a curve of the readout is estimated and removed; where there is none, the first one ends
it, and after a smooth curve the second or third."""

MAX_NOISE_ROUNDS = 5
"""Largest number of rounds in which process noise and noise level are estimated alternately."""

LOG_NOISE_TOLERANCE = 0.2
"""Change of the log noise variance that ends these rounds: 10 % of a standard deviation, which changes no interval."""


def track(
    recording: Recording,
    device: Device,
    causal: bool = False,
    phases: Mapping[str, PhaseMeasurement] | None = None,
    previous: Motion | None = None,
) -> Motion:
    """Phase and amplitude of all axes from their sense signals.

    Args:
        causal: estimate each block from the samples up to its end only (filter); the latency is half a block. By
            default each block is estimated from the whole recording (smoother).
        phases: further measurements of an axis's phase, for instance from the picture, by axis.
        previous: motion of an earlier segment of the same scan, from whose process noise the tuning starts. Where the
            recording begins at ``track_end`` of it, the state is continued as well.

    Returns:
        The motion. ``info`` has an entry for each sense channel, see ``_summarise``.

    Raises:
        BadInput: a channel shows no motion, or cannot be used. ChannelMissing: an axis has no sense channel.
        DeviceInvalid: the device lacks a value.
    """
    axes: dict[str, AxisMotion] = {}
    info: dict[str, object] = {}
    ends: dict[str, object] = {}
    notes: list[str] = []
    for sense in sense_channels(recording, device, gaps_ok=True):
        even = is_capacitive(sense.readout)
        end = find_end(previous, sense.channel)
        frequencies = end.w / (2 * np.pi) if end else [None] * len(sense.axes)
        references = {
            name: phase_reference(recording, device, name, sense.channel, even, frequency)
            for name, frequency in zip(sense.axes, frequencies, strict=True)
        }
        _check_resonant(sense, device, references)
        slowest = min(reference.frequency for reference in references.values())
        sense = replace(sense, channel=without_held_samples(sense.channel, slowest))
        curves = list(end.tuning.curves) if end else []
        for curve in curves:
            sense = replace(sense, channel=straightened_channel(sense.channel, curve))
        driven = with_whole_drives(recording, sense.channel, sense.axes)
        layout = lay_out_blocks(driven, device, sense, references, end and (end.start, end.length))
        layout, contradicted = without_contradicted_pauses(driven, device, layout)
        notes += describe_pauses(recording, driven, sense, contradicted)
        signs, prior = (list(end.signs), continued_prior(end, layout)) if end else ([], None)
        densities = _previous_densities(previous, sense)
        offset_density = _previous_offset_density(previous, sense)
        knots: list[list[AxisKnots]] = [[] for _ in sense.axes]
        acquired = np.zeros(len(sense.axes), bool)
        results: list[SectionResult] = []
        inherited = end and end.inherited_tuning(layout)
        for first, stop in section_ranges(layout.drive_share):
            part = first, stop + LOOKAHEAD_BLOCKS
            if inherited and prior:
                observations = demodulate_blocks(layout, *part, inherited.spectrum)
                section = inherit_tuning(observations, prior, signs, inherited, causal)
            else:
                tune = partial(
                    tune_section, part=part, device=device, prior=prior, densities=densities, causal=causal,
                    known_offset_density=offset_density,
                )  # fmt: skip
                section = tune(layout)
                if first == 0:
                    section, layout, found = straighten_section(section, layout, tune, causal)
                    curves += found
            observations, densities = section.observations, section.tuning.densities
            offset_density = section.tuning.offset_density
            signs = signs or section.signs
            measured = with_phase_measurements(observations, phases or {})
            states = average_over_noise(measured, section.prior, section.tuning.posterior, causal, stop - first)
            for a, axis_parts in enumerate(knots):
                axis_parts.append(axis_knots(observations, states.states, states.sds, a))
            prior, acquired = states.next_prior, acquired | states.acquired
            used, noise_var = observations.used_fraction, observations.noise_var
            results.append(SectionResult(stop - first, used, noise_var, states.mean_nis, states.log_likelihood))
        if all(np.isnan(result.noise_var) for result in results):
            least = 2 * len(layout.lines) + 2  # one more than the coefficients of the lines
            raise BadInput(
                f"holds too few samples that can be used: no block of {layout.length} has {least}, as its lines need",
                file=sense.channel.file,
                channel=sense.channel.name,
                hint="check that it was recorded",
            )
        clock = intensity_clock(recording, sense.channel)
        for a, name in enumerate(sense.axes):
            if not acquired[a]:
                raise BadInput(
                    f"shows no motion of axis {name} near {references[name].frequency:.6g} Hz",
                    file=sense.channel.file,
                    channel=sense.channel.name,
                    hint="the resonance did not start; check drive voltage and frequency",
                )
            axes[name] = motion_of_knots(layout.references[name], join_knots(knots[a]), clock, signs[a])
        info[sense.channel.name] = _summarise(layout, results, densities, offset_density)
        tuned_blocks = end.tuned_blocks if end and inherited else layout.starts.size
        notes += describe_curves(curves, sense.channel)
        tuning = section.tuning._replace(curves=tuple(curves))
        ends[sense.channel.name] = end_of_track(layout, states.next_prior, signs, tuning, tuned_blocks)
    return Motion(axes, "tracker-causal" if causal else "tracker", info, tuple(notes), ends)


def track_end(motion: Motion) -> float | None:
    """Time from which the next segment continues the track of a motion [s]; None if it cannot be continued."""
    starts = [end.start for end in motion.ends.values() if isinstance(end, TrackEnd)]
    return min(starts) if len(starts) == len(motion.ends) and starts else None


class SectionResult(NamedTuple):
    """Quality figures of a section, as in ``BlockObservations`` and ``StateTrack``."""

    blocks: int
    used_fraction: float
    noise_var: float
    mean_nis: float
    log_likelihood: float


def _check_resonant(sense: SenseChannel, device: Device, references: Mapping[str, PhaseReference]) -> None:
    """Raise BadInput for an axis that moves far below its resonance, where the averaged dynamics do not hold."""
    for name in sense.axes:
        frequency, resonance = references[name].frequency, device.axis(name).resonance
        if frequency < MIN_RELATIVE_FREQUENCY * resonance:
            raise BadInput(
                f"moves at {frequency:.6g} Hz, far below its resonance of {resonance:.6g} Hz, "
                "where the tracker's model does not hold",
                file=sense.channel.file,
                channel=sense.channel.name,
                hint="use --estimator sensor or ukf; if it should resonate, check the drive, and J and k of the device",
            )


def section_ranges(drive_share: Array) -> Iterator[tuple[int, int]]:
    """First and stop block of the sections that are tracked one after the other.

    No section ends with a block after which the drive switches. drive_share: see ``BlockSignal``, (blocks, axes).
    """
    first, blocks = 0, len(drive_share)
    steady = (drive_share == 0.5).all(axis=1)
    while first < blocks:
        stop = min(first + SECTION_BLOCKS, blocks)
        while not steady[stop - 1]:
            stop += 1
        yield first, stop
        first = stop


class TunedSection(NamedTuple):
    """A section with its process noise, ready to be tracked.

    Attributes:
        observations: with clipped samples expanded. prior: before its first block.
        signs: see ``choose_signs``. tuning: most probable process noise, its posterior, and the noise level.
    """

    observations: BlockObservations
    prior: StateEstimate
    signs: list[str]
    tuning: Tuning


def tune_section(
    layout: BlockLayout,
    part: tuple[int, int],
    device: Device,
    prior: StateEstimate | None,
    densities: Array,
    causal: bool,
    known_offset_density: float | None = None,
) -> TunedSection:
    """Process noise and noise level of a section from its own blocks.

    The residuals of a block give the noise averaged over all frequencies. With a pole of the amplifier or a curved
    characteristic, the noise at the harmonics of the motion is larger. The variance is therefore increased until the
    mean NIS is 1. Otherwise the tuning would attribute that noise to the motion.

    External phases are not used: a few of them would be fitted by an increased process noise.

    Args:
        part: first and stop block of the section.
        prior: estimate at the end of the previous section, None for the first section.
        densities: at which the tuning starts, shape (axes, 4). known_offset_density: the same of the offset.
    """
    observations = demodulate_blocks(layout, *part)
    if known_offset_density is not None:
        observations = observations.with_offset_density(known_offset_density)
    start, signs = choose_signs(observations, initial_estimate(observations, device))
    residual_var, scale = observations.signal.noise_var, 1.0
    for noise_round in range(MAX_NOISE_ROUNDS):
        observations = expand_clipped_blocks(observations, prior or start, densities, causal)
        parts = tuning_parts(observations.signal)
        tune = tune_process_noise if noise_round else tune_between_motion_and_offset
        densities, offset_density = tune(observations, start, parts, densities)
        observations = observations.with_offset_density(offset_density)
        parts = with_offset_density(parts, offset_density)
        found = max(1.0, scale * mean_nis(observations, start, parts, densities))
        if abs(np.log(found / scale)) < LOG_NOISE_TOLERANCE:
            break
        scale = found
        observations = replace(observations, signal=observations.signal._replace(noise_var=scale * residual_var))
    if observations.clipped.block.size:
        observations = expand_clipped_blocks(observations, prior or start, densities, causal)
        parts = tuning_parts(observations.signal)
    posterior = noise_posterior(observations, start, parts, densities)
    tuning = Tuning(densities, posterior, scale, offset_density, observations.signal.spectrum)
    return TunedSection(observations, prior or start, signs, tuning)


def straighten_section(
    section: TunedSection, layout: BlockLayout, tune: Callable[[BlockLayout], TunedSection], causal: bool
) -> tuple[TunedSection, BlockLayout, list[ReadoutCurve]]:
    """Remove a curve of the readout that the device file does not state.

    Args:
        section: the first one of the channel. layout: of the channel.
        tune: tunes the section of a layout with other samples.

    Returns:
        The section and the layout of the straightened channel, and the curves that were removed one after the other.
    """
    curves: list[ReadoutCurve] = []
    for _ in range(MAX_CURVE_ROUNDS):
        track = track_blocks(section.observations, section.prior, section.tuning.densities[None], causal)[0]
        curve = fit_readout_curve(layout, section.observations, track.states)
        if curve is None:
            break
        layout = layout.with_channel(straightened_channel(layout.sense.channel, curve))
        section = tune(layout)
        curves.append(curve)
    return section, layout, curves


def inherit_tuning(
    observations: BlockObservations, prior: StateEstimate, signs: list[str], tuning: Tuning, causal: bool
) -> TunedSection:
    """A section with the process noise and the noise level of an earlier one."""
    noise_var = tuning.noise_scale * observations.signal.noise_var
    observations = replace(observations, signal=observations.signal._replace(noise_var=noise_var))
    observations = observations.with_offset_density(tuning.offset_density)
    observations = expand_clipped_blocks(observations, prior, tuning.densities, causal)
    return TunedSection(observations, prior, signs, tuning)


def _previous_densities(motion: Motion | None, sense: SenseChannel) -> Array:
    """Process noise of one channel in an earlier motion, shape (axes, 4); INITIAL_DENSITIES if there is none."""
    channel_info = {} if motion is None else motion.info.get(sense.channel.name, {})
    by_axis = channel_info.get("walk") if isinstance(channel_info, Mapping) else None
    if by_axis is None:
        return np.tile(INITIAL_DENSITIES, (len(sense.axes), 1))
    return np.array([list(by_axis[axis].values()) for axis in sense.axes])


def _previous_offset_density(motion: Motion | None, sense: SenseChannel) -> float | None:
    """Density of the readout's offset [V^2/s] of one channel in an earlier motion; None if there is none."""
    channel_info = {} if motion is None else motion.info.get(sense.channel.name, {})
    return channel_info.get("offset_walk") if isinstance(channel_info, Mapping) else None


def _summarise(
    layout: BlockLayout, results: Sequence[SectionResult], densities: Array, offset_density: float | None
) -> dict[str, object]:
    """Quality figures of one channel; ``walk`` has the process noise of its last section by axis.

    ``offset_walk`` is that of the readout's offset.
    """
    blocks, used_fraction, noise_var, mean_nis, log_likelihood = np.array(results).T
    names = ("white_phase", "stiffness_trend", "damping", "gain")
    return {
        "block_s": layout.length / layout.sense.channel.sample_rate,
        "used": float(np.average(used_fraction, weights=blocks)),
        "noise_sd": float(np.sqrt(np.nanmedian(noise_var))),
        "mean_squared_innovation": float(np.average(mean_nis, weights=blocks)),
        "log_likelihood": float(log_likelihood.sum()),
        "walk": {
            axis: dict(zip(names, row.tolist(), strict=True))
            for axis, row in zip(layout.sense.axes, densities, strict=True)
        },
        "offset_walk": offset_density,
    }
