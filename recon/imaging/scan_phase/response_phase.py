"""The phase that drive, J, b and k give, compared with the phase that the picture shows, over half a turn.

The registration corrects errors up to 15°. A stiffness off by its tolerance turns the phase of a resonance by more. The
phases are therefore searched first (:mod:`recon.imaging.scan_phase.phase_search`). Where they are beyond that reach and
a stiffness within the tolerance explains them, the motion starts with them. Where none does, picture and device
contradict each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi
from typing import NamedTuple

import numpy as np

from estimation.tracker import PhaseMeasurement
from estimation.tracker.drive_only import explain_phase, stiffness_sd
from estimation.tracker.steady_motion import TOLERANCE_REACH
from recon.imaging.scan_phase.bidirectional_phase import slow_period
from recon.imaging.scan_phase.bidirectional_search import SEARCH_REACH_RAD
from recon.imaging.scan_phase.phase_search import (
    MIN_FOUND_FRACTION,
    PERIODS_PER_SEARCH,
    PHASE_CELLS,
    PhaseFound,
    continue_phases,
    cut_slices,
)
from recon.imaging.scan_phase.slice_search import search_slices
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import AXES, Device
from scanner.motion import Motion
from scanner.recording import Recording

SEARCHED_PHASE_SD = pi / PHASE_CELLS
"""Standard deviation of a phase by the search, one cell of it [rad]. The registration measures it anew."""


class ResponseCheck(NamedTuple):
    """What the picture shows of the phases of a motion computed from drive and device.

    Attributes:
        phases: of axes beyond the registration's reach that a stiffness within the tolerance explains.
        contradicted: axes that none explains.
        notes: a line on each of both.
    """

    phases: dict[str, PhaseMeasurement]
    contradicted: list[str]
    notes: list[str]


def check_response(
    recording: Recording, device: Device, motion: Motion, beam: Motion, intensity: Channel, flips: Mapping[str, bool]
) -> ResponseCheck:
    """Search the phases of a motion in the picture, and compare them with the device's response.

    Args:
        recording, device: with the drives and the mechanics.
        motion: from drive and device, with these ``flips``. beam: its motion of the beam.
        intensity: shape (n,) or (n, detectors).
        flips: axes whose sign is inverted.
    """
    check = ResponseCheck({}, [], [])
    slices = cut_slices(intensity, slow_period(motion) * PERIODS_PER_SEARCH)
    searched = search_slices(beam, intensity, slices)
    for name in AXES:
        found = [(intensity.start + each.time, each.phase(name)) for each in searched]
        clear = [(middle, phase) for middle, phase in found if phase.is_clear]
        if not clear or len(clear) < MIN_FOUND_FRACTION * len(slices):
            continue
        time = np.array([middle for middle, _ in clear])
        error = _nearest_errors([each for _, each in clear])
        if abs(float(np.median(error))) <= SEARCH_REACH_RAD:
            continue
        axis = motion.axes[name]
        phase = np.interp(time, axis.time, axis.phase) + error - (pi if flips.get(name, False) else 0.0)
        explained = explain_phase(recording, device, name, float(phase[0]))
        away = f"{name}: the picture shows a phase {np.degrees(np.median(error)):+.0f}° from that of drive and device"
        allowed = f"{100 * TOLERANCE_REACH * stiffness_sd(device, name):.2g} %"
        if explained is None:
            check.contradicted.append(name)
            check.notes.append(
                f"{away}, which no stiffness within {allowed} explains: check [{name}.mechanics] and the frequency and "
                "start of the channels; the phases are those of the picture, and the amplitudes fill the field"
            )
            continue
        turned, stiffness = explained
        phases = PhaseMeasurement(time, phase + (turned - phase[0]), np.full(time.size, SEARCHED_PHASE_SD))
        check.phases[name] = phases
        check.notes.append(
            f"{away}; a stiffness {100 * stiffness:+.2f} % from k of the device explains it (allowed: {allowed}), and "
            "determines the amplitude"
        )
    return check


def _nearest_errors(found: list[PhaseFound]) -> Array:
    """Phase errors of slices up to half a turn, without jumps, about the smallest possible; shape (slices,) [rad].

    Of two phases a quarter of a turn apart that a symmetric specimen allows, the one nearer to the device's counts.
    """
    value, is_unique = continue_phases(found)
    period = pi if is_unique else pi / 2
    return np.asarray(value - period * np.round(np.median(value) / period))
