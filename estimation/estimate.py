"""From a recording to its motion: the estimators by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module

from estimation.signals import device_of
from scanner.device import Device, Position
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording


def _filter(name: str) -> Callable[[Recording, Device], Motion]:
    def run(recording: Recording, device: Device) -> Motion:
        from estimation.filters import follow

        return follow(recording, device, name)

    return run


def _by(module: str, function: str) -> Callable[[Recording, Device], Motion]:
    def run(recording: Recording, device: Device) -> Motion:
        return getattr(import_module(f"estimation.{module}"), function)(recording, device)

    return run


def _tracker(causal: bool) -> Callable[[Recording, Device], Motion]:
    def run(recording: Recording, device: Device) -> Motion:
        from estimation.tracker import track

        return track(recording, device, causal)

    return run


ESTIMATORS: dict[str, tuple[str, Callable[[Recording, Device], Motion]]] = {
    "constant": ("phase and amplitude of the first stretch, held", _by("steady", "constant")),
    "acm": ("process model alone, no measurement (chen2020)", _filter("acm")),
    "ekf": ("extended Kalman filter (chen2020 algorithm 1)", _filter("ekf")),
    "ukf": ("unscented Kalman filter (chen2020 algorithm 2)", _filter("ukf")),
    "hyb": ("EKF with threshold crossings, transimpedance readouts (chen2019 table I)", _by("hybrid", "hybrid")),
    "sine-ukf": ("UKF on the phase of a steady sine, position readouts (wang2019)", _by("sine_ukf", "sine_ukf_motion")),
    "tracker": ("block demodulation and a smoother on the slow flow of phase and amplitude", _tracker(False)),
    "tracker-causal": ("the same, each moment from what came before it", _tracker(True)),
    "picture": (
        "the slow flow under the drive; a reconstruction measures its phases in the picture (no sense signal needed)",
        _by("tracker.driven", "drive_only"),
    ),
    "sensor": ("angle channels or position readouts as they are", _by("steady", "sensor")),
}

MEASURED = ("sensor", "sine-ukf")
"""Estimators whose angle is a sensor's, with whatever harmonics the motion has."""


def default_estimator(recording: Recording, device: Device) -> str:
    """By what was recorded: ``"tracker"`` for a capacitive readout, ``"picture"`` for drives and intensity alone.

    ``"sensor"`` otherwise.
    """
    names = [f"{kind}_{axis}" for axis in device.axes for kind in ("sense", "angle")]
    capacitive = [
        name
        for name, axis in device.axes.items()
        if f"sense_{name}" in recording and axis.readout is not None and not isinstance(axis.readout, Position)
    ]
    if "sense" in recording or capacitive:
        return "tracker"
    driven = "intensity" in recording and all(f"drive_{axis}" in recording for axis in device.axes)
    return "picture" if driven and not any(name in recording for name in names) else "sensor"


def estimate(
    recording: Recording,
    device: Device | None = None,
    method: str | None = None,
    flips: Mapping[str, bool] | None = None,
    before: Motion | None = None,
) -> Motion:
    """The motion of every axis of the device.

    Args:
        device: in place of the recording's own.
        method: a name from ``ESTIMATORS``; ``default_estimator`` otherwise.
        flips: axes whose sign the user turns, for an even capacitance cannot tell theta from -theta.
        before: the tracker's motion of an earlier stretch of the same scan, which shortens its tuning.

    Raises:
        BadInput: no such estimator, or the recording or the device does not serve it.
    """
    from estimation.steady import settle_signs
    from estimation.terms import estimate_with_terms

    device = device_of(recording, device)
    method = method or default_estimator(recording, device)
    if method not in ESTIMATORS:
        raise BadInput(f"no estimator is named {method!r}", hint=f"there are {', '.join(ESTIMATORS)}")

    def run(recording: Recording, device: Device) -> Motion:
        if before is not None and method == "tracker":
            from estimation.tracker import track

            motion = track(recording, device, before=before)
        else:
            motion = ESTIMATORS[method][1](recording, device)
        return settle_signs(motion, recording, flips or {})

    return estimate_with_terms(recording, device, run, modelled=method not in MEASURED)
