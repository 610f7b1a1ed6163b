"""The estimator ``edges``: axes with edges from these, other axes from a position sensor."""

from __future__ import annotations

from estimation.filters.baselines import axis_motion_from_sensor
from estimation.sync.motion import axis_motion_from_edges
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording


def estimate_from_edges(recording: Recording, device: Device) -> Motion:
    """Motion from the edges of every axis; an axis without edges is taken from its angle or position channel.

    Raises:
        BadInput: no axis has edges, edges are not regular, or an axis has neither edges nor a position sensor.
    """
    if not any(f"sync_{name}" in recording.edges for name in device.axes):
        what = "is not in the recording and this estimator needs it"
        raise BadInput(what, file=recording.path, channel="sync_x", hint="choose another estimator")
    axes, notes, info = {}, [], {}
    for name in device.axes:
        edges = recording.edges.get(f"sync_{name}")
        if edges is None:
            axes[name], own_notes = axis_motion_from_sensor(recording, device, name)
            notes += own_notes
            continue
        axes[name], own_notes, info[f"sync_{name}"] = axis_motion_from_edges(
            recording, device, edges, _clock(recording)
        )
        notes += own_notes
    return Motion(axes, "edges", info, tuple(notes))


def _clock(recording: Recording) -> tuple[float, float, int]:
    """Rate [Hz], start [s] and samples of the intensity, else of the fastest channel."""
    channels = recording.channels
    if not channels:
        hint = "record the intensity beside the edges"
        raise BadInput("holds edges only, no samples to locate", file=recording.path, hint=hint)
    channel = channels.get("intensity") or max(channels.values(), key=lambda each: each.sample_rate)
    return channel.sample_rate, channel.start, channel.size
