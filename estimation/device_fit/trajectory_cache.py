"""Simulated motions that are kept, so that a change of the readout needs no new integration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from threading import Lock
from typing import NamedTuple

from estimation.parallel import map_parallel
from scanner.active_terms import ActiveTerm, with_constants
from scanner.device import Axis
from scanner.forward_model import AxisTrajectory, DriveInput, simulate_batch
from scanner.integrator.abi import LANES

_Key = tuple[object, ...]


class MotionRequest(NamedTuple):
    """Everything that determines the motion of one axis.

    Attributes:
        run: number of the recording.
        axis: with its nominal values.
        active_terms: added terms, of all stages.
        start: initial angle [rad] and rate [rad/s].
        inputs: the drive.
    """

    run: int
    axis: Axis
    active_terms: tuple[ActiveTerm, ...]
    start: tuple[float, float]
    inputs: DriveInput

    @property
    def motion_terms(self) -> tuple[ActiveTerm, ...]:
        """The terms that change the motion."""
        return tuple(each for each in self.active_terms if each.term.stage in ("drive", "mechanics", "capacitance"))

    @property
    def key(self) -> _Key:
        """Key that is equal for equal motions; the readout does not affect the motion."""
        axis = self.axis
        return (
            self.run, axis.name, axis.mechanics, axis.capacitance, axis.drive, self.start, len(self.inputs.voltage),
            *[(active.term.effect, active.values, active.hidden_state) for active in self.motion_terms],
        )  # fmt: skip

    @property
    def motion(self) -> tuple[Axis, tuple[ActiveTerm, ...], tuple[float, float]]:
        """Input of ``simulate_batch``."""
        return self.axis, self.motion_terms, self.start


class TrajectoryCache:
    """The motions of a model that were simulated last, and those that were simulated in advance.

    Args:
        capacity: number of motions that are kept.
    """

    def __init__(self, capacity: int):
        self._capacity = capacity
        self._kept: dict[_Key, AxisTrajectory] = {}
        self._prefetched: dict[_Key, AxisTrajectory] = {}
        self._lock = Lock()

    def trajectory(self, request: MotionRequest) -> AxisTrajectory:
        """The motion from the cache or by integration, with the readout of the request."""
        key = request.key
        with self._lock:
            trajectory = self._prefetched.pop(key, None) or self._kept.pop(key, None)
        if trajectory is None:
            (trajectory,) = simulate_batch([request.motion], request.inputs)
        with self._lock:  # reinserted at the end: the least recently used one is dropped first
            self._kept[key] = trajectory
            if len(self._kept) > self._capacity:
                self._kept.pop(next(iter(self._kept)))
        constants = with_constants(request.axis, request.active_terms)
        return replace(trajectory, axis=constants, active_terms=request.active_terms)

    def prefetch(self, requests: Iterable[MotionRequest], parallel_steps: int) -> None:
        """Integrate in batches the motions that are not kept.

        Args:
            requests: of the motions.
            parallel_steps: integration steps of the model if the batches may run on several processors, else 0.
        """
        groups: dict[tuple[int, str], dict[_Key, MotionRequest]] = {}
        for request in requests:
            if (key := request.key) not in self._kept:
                groups.setdefault((request.run, request.axis.name), {})[key] = request

        def simulate_part(part: list[tuple[_Key, MotionRequest]]) -> None:
            trajectories = simulate_batch([request.motion for _, request in part], part[0][1].inputs)
            with self._lock:
                self._prefetched |= {key: trajectory for (key, _), trajectory in zip(part, trajectories, strict=True)}

        batches = []
        for group in groups.values():
            members = list(group.items())
            parts = -(-len(members) // LANES)
            if parallel_steps and len(members) > LANES // 2:
                parts = max(parts, 2)  # for a second processor
            batches += [members[i::parts] for i in range(parts)]
        map_parallel(simulate_part, batches, parallel_steps)
