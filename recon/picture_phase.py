"""The picture helps the phase: what forward against backward sweeps show goes back into the motion, until it rests.

Map with the motion at hand, measure the phase error that is left in each slice of time (``recon.registration``: least
squares over all samples that fall on one place), give phase plus error to the smoother as measurements, and map again.
Each round measures anew about a better motion, so that no measurement counts twice. Derived in docs/picture_phase.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.signals import reference_of
from estimation.steady import settle_signs
from estimation.terms import estimate_with_terms
from estimation.tracker import PhaseSeen, track
from estimation.tracker.driven import drive_only
from recon.mapping import Grid
from recon.registration import SLICE, PhaseError, registered, slow_period
from recon.undo import placed
from scanner.channel import Channel
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

AXES = ("x", "y")
REGISTERED = 800  # periods of the slower axis that share one picture
ROUNDS = 6
REST = 0.5  # of its least standard deviation: a phase that moves less has come to rest
FINE = 0.1  # pixels at the middle of a line: a sense signal that tells the phase so well needs no help
Smoother = Callable[[Recording, Device, Mapping[str, PhaseSeen]], Motion]


def refined(
    recording: Recording, device: Device, motion: Motion, intensity: Channel, grid: Grid, flips: Mapping[str, bool]
) -> tuple[Motion, list[str]]:
    """The motion with the phases that the picture shows, and a line for each axis on what it showed.

    Axes whose sense signal tells their phase to a tenth of a pixel stay as they are, and so do the motions of other
    estimators than ``tracker`` and ``picture``. Where it tells less, the picture's phases are smoothed with it, and
    without it where it tells less than drive and picture do.

    Args:
        motion: as ``estimate`` gave it with these ``flips``.
    """
    pixels = {"x": grid.width / 2, "y": grid.height / 2}
    helped = [name for name in AXES if _rms(motion.axes[name].phase_sd) * pixels[name] > FINE]
    smoothers = _smoothers(recording, device, motion.estimator) if helped else {}
    if not smoothers:
        return motion, []
    alone = {name: _rms(motion.axes[name].phase_sd) for name in helped}
    rounds, rest = 0, False
    by: dict[str, str] = {}
    while rounds < ROUNDS and not rest:
        # At first amplitudes are wrong too and change: what is taken at different times then shares no picture.
        parts = windows(motion, intensity, REGISTERED if rounds else SLICE)
        errors = registered(placed(motion, device, recording.start), intensity, grid, parts)
        seen = {name: _seen(errors, motion.axes[name], name, flips.get(name, False)) for name in helped}
        found = {way: _smoothed(recording, device, smooth, seen, flips) for way, smooth in smoothers.items()}
        by = {name: _better(found, name, alone[name]) for name in helped}
        before, motion = motion, replace(motion, axes={**motion.axes, **{n: found[by[n]].axes[n] for n in helped}})
        rounds, rest = rounds + 1, all(_rests(before.axes[name], motion.axes[name]) for name in helped)
    told = {name: int(np.isfinite(seen[name].sd).sum()) for name in helped}
    facts = {"rounds": rounds, "slices": len(errors), "told": told, "smoothed_with": by}
    notes = [_note(name, told[name], len(errors), by[name] != motion.estimator) for name in helped]
    return replace(motion, info={**motion.info, "picture": facts}), notes


def _smoothers(recording: Recording, device: Device, estimator: str) -> dict[str, Smoother]:
    """What smooths phases seen, by the name of its estimator: the drive alone only where it sustains the motion."""
    if estimator not in ("tracker", "picture"):
        return {}
    found: dict[str, Smoother] = {"picture": drive_only}
    if estimator == "tracker":
        found["tracker"] = lambda recording, device, seen: track(recording, device, seen=seen)
        try:
            _smoothed(recording, device, drive_only, {}, {})
        except BadInput:
            del found["picture"]
    return found


def _smoothed(
    recording: Recording, device: Device, smooth: Smoother, seen: Mapping[str, PhaseSeen], flips: Mapping[str, bool]
) -> Motion:
    """The motion as ``estimate`` makes it, of a device that may have terms, with phases seen."""

    def run(told: Recording, bare: Device) -> Motion:
        pulled = {name: _against(phases, name, device, recording, told) for name, phases in seen.items()}
        return settle_signs(smooth(told, bare, pulled), told, flips)

    return estimate_with_terms(recording, device, run)


def _against(seen: PhaseSeen, name: str, device: Device, recording: Recording, told: Recording) -> PhaseSeen:
    """Phases against the drive that pulls, where a term makes another one of the recorded drive."""
    key = f"drive_{name}"
    if key not in told or told[key] is recording[key]:
        return seen
    recorded, pulled = (reference_of(each, device, name).phase(seen.time) for each in (recording, told))
    return seen._replace(phase=seen.phase + recorded - pulled)


def windows(motion: Motion, intensity: Channel, periods: int) -> list[tuple[int, int]]:
    """Samples (first, stop) of parts of the scan, of about so many periods of the slower axis at the most."""
    parts = max(1, round(intensity.size / intensity.sample_rate / slow_period(motion) / periods))
    edges = np.linspace(0, intensity.size, parts + 1).round().astype(int)
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def _seen(errors: list[PhaseError], axis: AxisMotion, name: str, turned: bool) -> PhaseSeen:
    """Measured phase: the motion's own at the block nearest to each slice's middle, and the error seen there."""
    middle = axis.angle.start + np.array([error.time for error in errors])
    nearest = np.clip(
        np.round(np.interp(middle, axis.time, np.arange(axis.time.size))).astype(int), 0, axis.time.size - 1
    )
    value, sd = np.array([getattr(error, name) for error in errors]).T
    own = axis.phase[nearest] - (np.pi if turned else 0.0)  # the smoother knows nothing of the user's flips
    return PhaseSeen(axis.time[nearest], own + value, sd)


def _better(found: Mapping[str, Motion], name: str, alone: float) -> str:
    """What to smooth an axis with, which the sense signal alone leaves with a standard deviation of ``alone`` [rad]."""
    if "picture" in found and _rms(found["picture"].axes[name].phase_sd) < alone:
        return "picture"
    return "tracker" if "tracker" in found else "picture"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _rests(before: AxisMotion, after: AxisMotion) -> bool:
    if before.time.size != after.time.size:  # the one smoother's blocks took over from the other's
        return False
    return _rms(after.phase - before.phase) < REST * float(after.phase_sd.min())


def _note(name: str, told: int, slices: int, unheard: bool) -> str:
    if told == 0:
        return f"the picture shows nothing of the phase of {name}: no feature across it, or too few samples"
    note = f"the phase of {name} was measured in the picture itself, in {told} of {slices} slices of the scan"
    return f"{note}; the sense signal tells less and was left out" if unheard else note
