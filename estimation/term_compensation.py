"""Estimation for a device with terms by an estimator of nominal devices: the contribution of the terms is subtracted.

Terms that are equivalent to other nominal values or to a corrected recording are replaced by these
(``estimation.term_absorption``). Every other law depends on the unknown motion, so it is compensated iteratively: the
motion estimated so far is passed through ``scanner.forward_model`` with and without the terms, the difference is
subtracted from the measured channels, and the motion is estimated again. A torque enters as its equivalent stiffness
and damping at the motion's amplitude and by the harmonics that it adds (``estimation.describing_function``). A mode
that grows from its hidden states has no steady torque at an amplitude: an estimator follows what it does to the motion
as changes of stiffness and damping. Thus every estimator handles every term by its single definition in the term's
file, and the equations of the estimators are the nominal ones. An estimator that treats clipped samples itself gets
them as such, without a correction of the clipping, which would be the motion estimated so far in their place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from estimation.clipped_samples import clip_again, find_rails
from estimation.describing_function import (
    DescribingFunction,
    add_term_motion,
    describing_function,
    linearised_device,
)
from estimation.signals import drive_phase_change
from estimation.term_absorption import (
    Terms,
    absorb_constants,
    drive_input,
    measured_channels,
    remaining_term,
    trajectory,
    with_clocks,
    with_drives,
    with_outputs,
    without_visible_clipping,
)
from scanner.active_terms import ActiveTerm, stated_terms
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.coupled_motion import beside_each_other
from scanner.device import Device
from scanner.forward_model import AxisTrajectory, reference_signal, sense_signal
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.replaced_samples import with_samples

NominalEstimator = Callable[[Recording, Device], Motion]
"""Estimates the motion of a device without terms."""

Functions = Mapping[str, DescribingFunction]
"""Describing functions by axis."""

MAX_ITERATIONS = 8
"""Bound on the iteration where a correction does not converge; the last estimate is then returned."""

CORRECTION_TOLERANCE = 0.02
"""Change of the correction, relative to the readout's noise, below which the iteration has converged: far below what
the estimate can show."""

SIGN_SIGMA = 5.0
"""Standard deviations by which one sign of an axis has to explain a recording better than the other."""

MIN_NOISE_RATIO = 1e-3
"""Noise that is assumed at least for that, relative to the signal: a channel may state none."""


def estimate_with_terms(
    recording: Recording,
    device: Device,
    run: NominalEstimator,
    is_model_based: bool = True,
    treats_clipping: bool = False,
) -> Motion:
    """The motion of a device that may state terms.

    Args:
        run: estimates the motion of a nominal device.
        is_model_based, treats_clipping: of the estimator; see ``estimation.estimators.Estimator``.

    Raises:
        BadInput: a term that no catalogue has, or as ``run``.
    """
    stated = {name: stated_terms(axis) for name, axis in device.axes.items()}
    if not any(stated.values()):
        return run(recording, device)
    bare = absorb_constants(device, stated)
    absorbed = with_drives(with_clocks(recording, stated), device, stated)
    remaining: Terms = {
        name: tuple(
            remaining_term(active, bare.sensed_axis(name)) for active in axis_terms if not active.term.initial_seeds
        )
        for name, axis_terms in stated.items()
    }
    if treats_clipping:
        remaining = without_visible_clipping(absorbed, bare, remaining)
    absorbed, terms = with_outputs(absorbed, bare, remaining, treats_clipping)
    without_intensity = absorbed.without_channel(
        "intensity"
    )  # angles at the sense signal's samples serve the iteration
    corrected = without_intensity
    motion, functions = run(without_intensity, bare), dict[str, DescribingFunction]()

    def with_signs(motion: Motion) -> Motion:
        return _with_signs(without_intensity, bare, terms, functions, motion)

    for _ in range(MAX_ITERATIONS if any(map(_acts, (active for group in terms.values() for active in group))) else 0):
        if is_model_based:
            functions = {
                name: describing_function(bare.axis(name), terms[name], motion, name, without_intensity.duration)
                for name in terms
            }
            motion = with_signs(motion)
        previous, corrected = corrected, _corrected(without_intensity, bare, terms, functions, motion, treats_clipping)
        motion = run(corrected, linearised_device(bare, functions))
        if _converged(previous, corrected, bare):
            break
    if "intensity" in absorbed:
        complete = corrected.with_channel(absorbed["intensity"])
        motion = run(complete, linearised_device(bare, functions))
    motion = with_signs(motion)
    axes = {name: _with_term_motion(axis, motion, functions, name) for name, axis in motion.axes.items()}
    axes = {
        name: replace(axis, phase=axis.phase + drive_phase_change(recording, absorbed, bare, name, axis.time))
        for name, axis in axes.items()
    }
    return replace(motion, axes=axes, notes=_notes(terms))


def _acts(active: ActiveTerm) -> bool:
    """Whether a term still changes a signal or the motion."""
    term = active.term
    return any((term.torque, term.capacitance, term.pre_demodulation)) or bool(term.acts_on_channel)


def _with_signs(recording: Recording, bare: Device, terms: Terms, functions: Functions, motion: Motion) -> Motion:
    """The motion with the signs with which the terms explain the recording, where an even capacitance leaves them open.

    A torque that is even in the angle moves the mean of the oscillation to one side. With the mean, the sense signal
    contains odd harmonics, whose sign is that of the motion.
    """
    for name, function in functions.items():
        axis = motion.axes[name]
        if axis.sign != "ambiguous" or not function.harmonics[::2].any():
            continue
        negated = replace(motion, axes={**motion.axes, name: axis.negated()})
        misfit, other = (_misfit(recording, bare, terms, functions, each) for each in (motion, negated))
        if abs(other - misfit) > SIGN_SIGMA**2:
            axis = negated.axes[name] if other < misfit else axis
            axis = replace(axis, sign="known: a torque of the stated terms that is even in the angle")
            motion = replace(motion, axes={**motion.axes, name: axis})
    return motion


def _misfit(recording: Recording, bare: Device, terms: Terms, functions: Functions, motion: Motion) -> float:
    """Minus twice the log likelihood of the recording along a motion, for white noise of unknown variance."""
    signals = [
        (channel.read(), complete) for _, channel, _, complete in _signals(recording, bare, terms, functions, motion)
    ]
    residuals = [measured - np.clip(complete, *find_rails(measured)) for measured, complete in signals]
    return float(sum(each.size * np.log(np.nanvar(each)) for each in residuals))


def _corrected(
    recording: Recording, bare: Device, terms: Terms, functions: Functions, motion: Motion, treats_clipping: bool
) -> Recording:
    """The recording without the terms' contribution along ``motion`` to its sense and angle channels."""
    channels = dict(recording.channels)
    for key, channel, nominal, complete in _signals(recording, bare, terms, functions, motion):
        measured = channel.read()
        corrected = measured - (complete - nominal)
        channels[key] = with_samples(channel, clip_again(corrected, measured) if treats_clipping else corrected)
    return replace(recording, channels=MappingProxyType(channels))


def _signals(
    recording: Recording, bare: Device, terms: Terms, functions: Functions, motion: Motion
) -> Iterator[tuple[str, Channel, Array, Array]]:
    """Name, channel, and signals without and with the terms along ``motion``, of its sense and angle channels."""
    for key, kind, axes in measured_channels(recording, bare):
        channel = recording[key]
        angles = _angles_at_samples(channel, motion)
        motions: tuple[dict[str, AxisTrajectory], dict[str, AxisTrajectory]] = {}, {}
        for name in angles:
            drive = drive_input(recording.channels.get(f"drive_{name}"), recording, channel)
            axis = bare.sensed_axis(name)
            with_terms = add_term_motion(angles, channel.sample_rate, motion, functions, name)
            motions[0][name] = trajectory(axis, (), drive, angles[name])
            motions[1][name] = trajectory(axis, tuple(terms[name]), drive, with_terms)
        nominal, complete = ([beside_each_other(each)[name] for name in axes] for each in motions)
        if kind == "angle":
            without, full = reference_signal(nominal[0]), reference_signal(complete[0])
        else:
            readout = bare.sensed_axis(axes[0]).require_readout()
            without, full = sense_signal(readout, nominal), sense_signal(readout, complete)
        yield key, channel, without[:-1], full[:-1]


def _angles_at_samples(channel: Channel, motion: Motion) -> dict[str, Array]:
    """Every axis's angle at the samples of a channel, shape (n,) [rad]; 0 where the motion is unknown."""
    from scipy.interpolate import CubicSpline

    angles = {}
    for name, axis in motion.axes.items():
        track = axis.angle
        values = track.read(0, track.size)
        if (track.sample_rate, track.start, track.size) != (channel.sample_rate, channel.start, channel.size):
            known = np.isfinite(values)
            time = track.start + np.arange(track.size)[known] / track.sample_rate
            values = CubicSpline(time, values[known], extrapolate=False)(channel.time())
        angles[name] = np.nan_to_num(values)
    return angles


def _converged(previous: Recording, current: Recording, device: Device) -> bool:
    """Whether the correction of every channel changed by far less than its readout's noise."""
    for key, channel in current.channels.items():
        if key.startswith(("sense", "angle")):
            new, old = channel.read(), previous[key].read()
            axis = device.sensed_axis(key.partition("_")[2] or next(iter(device.axes)))
            noise = axis.readout.noise_sd if key.startswith("sense") and axis.readout else 0.0
            scale = max(noise, MIN_NOISE_RATIO * float(np.nanstd(new)))
            if np.sqrt(np.nanmean((new - old) ** 2)) > CORRECTION_TOLERANCE * scale:
                return False
    return True


def _with_term_motion(axis: AxisMotion, motion: Motion, functions: Functions, name: str) -> AxisMotion:
    """The axis with the motion that its terms cause added to its angle."""
    function = functions.get(name)
    if function is None or not function.changes_angle:
        return axis
    angles = {key: other.angle.read(0, other.angle.size) for key, other in motion.axes.items()}
    values = add_term_motion(angles, axis.angle.sample_rate, motion, functions, name)
    return replace(axis, angle=SampledAngle(values, axis.angle.sample_rate, axis.angle.start))


def _notes(terms: Terms) -> tuple[str, ...]:
    """How terms were represented that do not enter the estimate by their own law."""
    notes = []
    for name, active_terms in terms.items():
        for active in active_terms:
            if active.term.torque is not None:
                notes.append(
                    f"{active.term.effect} of {name}: as the stiffness, damping and harmonics at the amplitude"
                )
            if active.term.capacitance is not None:
                notes.append(f"{active.term.effect} of {name}: in the readout; its torque as that of the nominal comb")
    return tuple(notes)
