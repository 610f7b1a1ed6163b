"""Edge times of a detector that the beam crosses: the channels ``sync_x`` and ``sync_y``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scanner.arrays import Array
from scanner.errors import BadInput, UnitUnknown

EDGE_CHANNELS = ("sync_x", "sync_y")
EDGE_EVENTS = ("zero-crossing-up", "zero-crossing-down", "turn", "both-edges")
EDGE_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Accepted units of edge times, with the factor that converts to seconds."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Times at which a detector saw the beam.

    Attributes:
        name: of the channel.
        times: increasing, shape (n,) [s].
        event: what an edge is, one of ``EDGE_EVENTS``.
        angle: of the mirror at which the beam passes the detector [rad]; None where it is not stated.
        hysteresis: the angle by which the detector switches late, in either direction [rad].
        file: where the edges came from, for messages.
    """

    name: str
    times: Array
    event: str
    angle: float | None = None
    hysteresis: float = 0.0
    file: str | None = None

    @property
    def is_one_direction(self) -> bool:
        """Whether the edges state that the beam passes the detector in one direction."""
        return self.event.startswith("zero-crossing")

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the channel in a file."""
        stated: dict[str, Any] = {"unit": "s", "event": self.event}
        stated |= {} if self.angle is None else {"angle": self.angle}
        return stated | ({"hysteresis": self.hysteresis} if self.hysteresis else {})

    def between(self, t0: float, t1: float) -> Edges:
        """Return the edges with ``t0 <= t < t1`` [s]."""
        return replace(self, times=self.times[slice(*np.searchsorted(self.times, (t0, t1)))])


def make_edges(name: str, values: ArrayLike, stated: Mapping[str, Any], file: str | None = None) -> Edges:
    """Return the edges of a channel after checking everything stated about them.

    Args:
        name: of the channel.
        values: edge times, shape (n,).
        stated: ``unit`` of the times, and ``event`` or ``angle`` [rad] or both, and ``hysteresis`` [rad], 0 by default.
            An angle alone means both edges.
        file: for messages.

    Raises:
        UnitUnknown: the unit is missing or no unit of time.
        BadInput: no list of finite, increasing times, neither event nor angle is stated, or they contradict each other.
    """

    def bad(what: str, hint: str) -> BadInput:
        return BadInput(what, file=file, channel=name, hint=hint)

    times = np.asarray(values)
    unit, angle = stated.get("unit"), stated.get("angle")
    event = stated.get("event", None if angle is None else "both-edges")
    if unit not in EDGE_UNITS:
        what = "unit is missing" if unit is None else f"unit {unit!r} is unknown"
        raise UnitUnknown(what, file=file, channel=name, hint=f"accepted units: {', '.join(EDGE_UNITS)}")
    if times.ndim != 1 or times.dtype.kind not in "iuf":
        raise bad(f"has shape {times.shape} of {times.dtype}", "store edge times as a list of numbers")
    if event not in EDGE_EVENTS:
        what = "states neither event nor angle" if event is None else f"event {event!r} is unknown"
        raise bad(what, f"state event as one of {', '.join(EDGE_EVENTS)}, or angle in rad")
    for key in {"angle", "hysteresis"} & stated.keys():
        if not isinstance(stated[key], (int, float)) or isinstance(stated[key], bool) or not isfinite(stated[key]):
            raise bad(f"{key} is {stated[key]!r}, not a finite number", f"state {key} in rad")
    if angle and event != "both-edges":
        place = "the turning points" if event == "turn" else "the centre"
        hint = "state one of them; an angle alone means the edges of both directions"
        raise bad(f"states event {event}, which is at {place}, and a detector at {angle:g} rad", hint)
    times = times.astype(np.float64) * EDGE_UNITS[unit]
    if not np.isfinite(times).all():
        raise bad(f"edge {int(np.argmin(np.isfinite(times)))} is not finite", "remove it from the list")
    if (np.diff(times) < 0.0).any():
        at = int(np.argmax(np.diff(times) < 0.0)) + 1
        raise bad(f"edge {at} at {times[at]:.9g} s is earlier than the one before", "sort the times")
    times.flags.writeable = False
    return Edges(
        name, times, str(event), None if angle is None else float(angle), float(stated.get("hysteresis", 0)), file
    )
