"""Axes that nothing listens to: their motion as drive and slow flow have it, for a picture to correct.

The motion begins in the steady state that the drive holds. How far stiffness and damping may be from their calibration
says how far its phase and amplitude may be from the computed ones, and that the two go together: a phase seen in the
picture tells the amplitude too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.signals import Sense, drive_voltage, intensity_clock, reference_of
from estimation.tracker.course import axis_motion, course
from estimation.tracker.orbit import axis_law, law_of, turn_of
from estimation.tracker.signal import NEVER_CLIPPED, Driven, Prepared, driven_blocks
from estimation.tracker.step import DAMPING, LOG, PHASE, STATES, STIFFNESS, TREND, Signal
from estimation.tracker.track import (
    STIFFNESS_SPREAD,
    TREND_SD,
    PhaseSeen,
    follow,
    with_phases,
)
from estimation.tracker.tuning import LEAST_WALK, Belief
from scanner.channel import Channel
from scanner.device import Device, Position
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

BLOCK_CYCLES = 2.0
UNREAD = Position(gain=1.0, noise_sd=0.0)  # stands where a readout is asked for; no sample is seen through it
LARGE, LARGEST = 0.75, 1.6  # of theta0: where the motion starts, and what it may reach
DECAYS, STEP = 30.0, 0.1  # decay times until the motion is steady, and of a step towards it
STEADY = 1e-5  # change of phase [rad] and ln A over a step
UNSTEADY = (0.01, 0.005)  # sd of phase [rad] and ln A off the steady motion, beside what stiffness and damping do to it
TRENDS = 10.0 ** np.arange(-1.5, 2.0)  # of the stiffness's walking trend [1/s3]; few phases prove no smoother drift


class Steady(NamedTuple):
    """Steady motion: phase [rad], ln A, and the derivatives of both by relative changes of k and b, shape (2, 2)."""

    phase: float
    log: float
    by_law: Array


def drive_only(recording: Recording, device: Device, seen: Mapping[str, PhaseSeen] | None = None) -> Motion:
    """Motion of all axes from their drives, and from phases seen in a picture where there are some.

    Args:
        seen: as in ``track``. Without it phases are as uncertain as the device's tolerances make them: by degrees.

    Raises:
        ChannelMissing: a drive was not recorded. DeviceInvalid: the device lacks a value.
        BadInput: a drive cannot be used, or sustains no motion.
    """
    axes, trends = {}, {}
    for name in device.axes:
        prepared = with_phases(prepare_driven(recording, device, name), seen or {})
        start = steady_belief(prepared, device)
        walks = np.array([[[LEAST_WALK[0], trend, LEAST_WALK[2]]] for trend in TRENDS])
        tracks = follow(prepared, start, walks)
        best = int(np.argmax([each.log_likelihood for each in tracks]))
        drive = prepared.sense.channel
        sign = "ambiguous" if prepared.laws[0].pull else "known: the drive"
        along = course(prepared, tracks[best].states, tracks[best].sds, 0)
        axes[name] = axis_motion(prepared.references[name], along, intensity_clock(recording, drive), sign)
        trends[name] = float(TRENDS[best])
    return Motion(axes, "picture", {"stiffness_trend_walk": trends})


def prepare_driven(recording: Recording, device: Device, name: str) -> Prepared:
    """Blocks of one axis with its drive and no projections.

    Raises:
        ChannelMissing: the drive was not recorded. BadInput: it cannot be used. DeviceInvalid: a value is missing.
    """
    channel = recording.require(f"drive_{name}", "without a sense signal it is the only one to tell the motion")
    reference = reference_of(recording, device, name)
    law = axis_law(device.axis(name), UNREAD)
    time, width = _blocks(channel, reference.frequency)
    driven = driven_blocks(drive_voltage(recording, name), reference, time, width, law)
    signal = _silent(driven, width, 2 if law.pull else 1, LARGEST * law.theta0)
    sense, references = Sense(channel, UNREAD, (name,)), {name: driven.reference}
    return Prepared(sense, references, (law,), time, signal, 0.0, NEVER_CLIPPED, 1.0)


def _blocks(channel: Channel, frequency: float) -> tuple[Array, float]:
    """Middles and width of the blocks [s]."""
    length = round(BLOCK_CYCLES / frequency * channel.sample_rate)
    starts = np.arange(channel.size // length) * length
    return channel.start + (starts + 0.5 * (length - 1)) / np.float64(channel.sample_rate), length / channel.sample_rate


def _silent(driven: Driven, step: float, main: int, largest: float) -> Signal:
    """A signal of no lines: its one projection, the mean, has no samples in any block."""
    blocks = driven.psi.size
    nothing = np.zeros((blocks, 1))
    return Signal(
        psi=driven.psi[:, None],
        w=driven.w[:, None],
        force=np.ascontiguousarray(driven.force[:, None]),
        share=driven.share[:, None],
        step=step,
        lines=np.zeros((0, 2), np.int64),
        passed=np.zeros((blocks, 0), np.complex128),
        passed_by_w=np.zeros((blocks, 0), np.complex128),
        mean_gain=0.0,
        mean_delay=0.0,
        tuned=driven.w[:, None],
        whitened=nothing,
        roots=np.zeros((1, 3, 1, 1)),
        unroots=np.zeros((1, 1, 1)),
        geometry=np.zeros(blocks, np.int64),
        noise_var=np.ones(blocks),
        known=nothing.copy(),
        known_var=np.full((blocks, 1), np.inf),
        ladder=np.array([[[0.0, largest], [0.0, largest]]]),
        main=main,
    )


def steady_belief(prepared: Prepared, device: Device) -> Belief:
    """Steady motion under the first block's drive, with the covariance that the device's tolerances give it.

    Raises:
        BadInput: the drive sustains no motion.
    """
    (name,) = prepared.sense.axes
    motion = steady(prepared)
    if motion is None:
        raise BadInput(
            f"sustains no motion of axis {name} by the device's values when the recording begins",
            file=prepared.sense.channel.file,
            channel=prepared.sense.channel.name,
            hint="check voltage and frequency of the drive, and the device",
        )
    x, P = np.zeros(STATES + 1), np.zeros((STATES + 1, STATES + 1))
    x[PHASE], x[LOG] = motion.phase, motion.log
    law, pair = [STIFFNESS, DAMPING], [PHASE, LOG]
    # The damping is the calibrated one: of what the picture does not show, the amplitude's scale, it would decide.
    spread = np.square([np.hypot(device.tolerance(name, "k"), STIFFNESS_SPREAD), device.tolerance(name, "b")])
    P[law, law] = spread
    P[np.ix_(pair, law)] = motion.by_law * spread
    P[np.ix_(law, pair)] = P[np.ix_(pair, law)].T
    P[np.ix_(pair, pair)] = motion.by_law * spread @ motion.by_law.T + np.diag(np.square(UNSTEADY))
    P[TREND, TREND] = TREND_SD**2
    P[-1, -1] = P[STATES - 1, STATES - 1] = 1.0  # offset and gain of the readout that there is not
    return Belief(x, P, np.array([True]))


def steady(prepared: Prepared) -> Steady | None:
    """The largest steady motion under the first block's drive; None where every motion dies."""
    law, w, force = law_of(prepared.rows[0]), float(prepared.signal.w[0, 0]), prepared.signal.force[0, 0]
    step = STEP * 2.0 * law.J / law.b
    best = None
    for phase in np.pi * np.arange(4) / 4:
        log = float(np.log(LARGE * law.theta0))
        for _ in range(round(DECAYS / STEP)):
            rate = turn_of(law, np.exp(log), phase, w, law.k, law.b, force).rate
            phase, log = phase + step * rate.imag, min(log + step * rate.real, np.log(LARGEST * law.theta0))
        turn = turn_of(law, np.exp(log), phase, w, law.k, law.b, force)
        if abs(turn.rate) * step < STEADY and (best is None or log > best.log):
            flow, push = _parts(turn.by_phase, turn.by_log), _parts(turn.by_stiffness, turn.by_damping)
            main = prepared.signal.main
            best = Steady(
                float(np.angle(np.exp(1j * main * phase))) / main,
                log,
                np.asarray(-np.linalg.solve(flow, push), np.float64),
            )
    return best


def _parts(*rates: complex) -> Array:
    """Rates of phase, then of ln A, a column each."""
    return np.array([[rate.imag for rate in rates], [rate.real for rate in rates]])
