"""The nominal device with some terms, as a function of free numbers: what the channels would have shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.experiment import Output, Run, readout_of
from scanner.device import Amdm, Axis, Device, Readout
from scanner.response import (
    Added,
    Inputs,
    Path,
    added_terms,
    move,
    move_abreast,
    move_all,
    reference,
    sense,
    with_constants,
)
from scanner.terms import Parameter, Scales, Term
from scanner.trajectory import LANES

Array = NDArray[np.float64]

START_SD = 3.0
"""Prior of a start value in units of the motion's amplitude: none to speak of."""

REFERENCE_GAIN_SD = 0.02
"""Relative gain of a reference angle, where nothing is stated: the contract's default tolerance."""

OFFSET_SD = 0.05
"""Prior of an offset that nobody states, in units of the signal's deviation."""

MAINS = (50.0, 60.0)
"""Mains frequencies [Hz]. Hum at their first ``HUM_MULTIPLES`` multiples is noise, not physics, as long as it stays
below the noise's own deviation: its quadratures are free with a prior of ``HUM_SD`` of that. A stronger tone is
interference."""

MADE = 64
"""Axes with nominal values of their own that a model remembers."""

HUM_MULTIPLES = 3
HUM_SD = 0.5


@dataclass(frozen=True)
class Candidate:
    """A term that may be missing, on one axis, acting on one of its channels."""

    term: Term
    axis: str
    channel: str

    @property
    def key(self) -> str:
        """For messages and comparisons: ``x.cubic-stiffness``, ``x.channel-delay:angle``."""
        suffix = "" if self.channel == self.term.channels[0] else f":{self.channel}"
        return f"{self.axis}.{self.term.effect}{suffix}"


@dataclass(frozen=True)
class Free:
    """One free number, standard normal a priori: value = centre + scale x, or as its term's parameter says.

    Attributes:
        kind: ``"nominal"``, ``"term"``, ``"start"``, ``"hidden"``, ``"gain"`` or ``"additive"``.
        owner: axis, candidate's key, or channel.
        name: of the value (``"mechanics.k"``, ``"k3"``, ...).
        run: which recording it belongs to, -1 for all.
        precision: of the prior, 1 for a standard normal one.
    """

    kind: str
    owner: str
    name: str
    run: int = -1
    precision: float = 1.0
    parameter: Parameter | None = None


_Key = tuple[object, ...]


class _Motion(NamedTuple):
    """What a motion follows from, its drive aside; see ``move_abreast``."""

    axis: Axis
    added: tuple[Added, ...]
    start: tuple[float, float]

    def key(self, r: int, inputs: Inputs) -> _Key:
        """Equal for equal motions: a readout's numbers do not count."""
        axis, added, start = self
        return (
            r, axis.name, axis.mechanics, axis.capacitance, axis.drive, start, len(inputs.voltage),
            *[(each.term.effect, each.values, each.hidden) for each in added],
        )  # fmt: skip


_NOTHING: tuple[list[int], Array] = [], np.zeros((0, 0))
"""Under a channel: where it stands in x, and its shapes."""


class Model:
    """Simulated channels of one or more recordings against free numbers x.

    Attributes:
        runs: the recordings.
        device: nominal.
        candidates: terms added.
        free: what x holds, in order.
    """

    def __init__(
        self, runs: Sequence[Run], device: Device, candidates: Sequence[Candidate] = (), mains: Sequence[float] = MAINS
    ):
        self.runs, self.device, self.candidates = tuple(runs), device, tuple(candidates)
        self.mains = tuple(mains)
        self.given = {name: added_terms(axis) for name, axis in device.axes.items()}
        self.axes = tuple(name for name in device.axes if any(name in run.inputs for run in runs))
        self.free = tuple(self._free())
        self.precision = np.array([each.precision for each in self.free])
        self._where = {(f.kind, f.owner, f.name, f.run): i for i, f in enumerate(self.free)}
        # Shapes of what lies under a channel: behind all else, or before an output that clips it with the signal.
        self.basis, self._beneath = {}, {}
        terms = [each.term for each in self.candidates] + [each.term for added in self.given.values() for each in added]
        clips = any(term.at_output for term in terms)
        for r, run in enumerate(self.runs):
            for output in run.outputs:
                at, shapes = self._basis(r, output)
                if clips and output.kind == "sense":
                    self._beneath[r, output.name] = at, _on_grid(shapes, output, run)
                    at, shapes = _NOTHING
                self.basis[r, output.name] = at, shapes
        self._paths: dict[_Key, Path] = {}
        self._ready: dict[_Key, Path] = {}
        self._made: dict[_Key, Axis] = {}
        self._nominal = {
            axis: [(self._where[("nominal", axis, name, -1)], name, value, tolerance)
                   for name, value, tolerance in nominal_parameters(device, axis)]
            for axis in self.axes
        }  # fmt: skip
        self._lock = Lock()

    def _free(self) -> list[Free]:
        free = [
            Free("nominal", axis, name) for axis in self.axes for name, _, _ in nominal_parameters(self.device, axis)
        ]
        for each in self.candidates:
            free += [Free("term", each.key, p.name, parameter=p) for p in each.term.free]
        for r, run in enumerate(self.runs):
            for axis in run.inputs:
                free += [Free("start", axis, name, r, START_SD**-2) for name in ("angle", "rate")]
            for each in self.candidates:
                if each.axis in run.inputs:
                    free += [Free("hidden", each.key, str(i), r) for i in range(len(each.term.hidden))]
            for output in run.outputs:
                if output.kind == "angle":
                    free.append(Free("gain", output.name, "gain", r))
                free += [Free("additive", output.name, name, r) for name in self.additives(output)]
        return free

    def additives(self, output: Output) -> dict[str, Array]:
        """What may lie under a channel whatever the mirror does, each shape (n,): an unstated offset, and hum."""
        found = {}
        if output.kind == "angle" or not isinstance(readout_of(self.device, output.axes[0]), Amdm):
            found["offset"] = np.full(output.data.size, OFFSET_SD * output.data.std())
        if output.kind == "sense":
            noise = output.noise_sd or 0.0
            for mains in self.mains:
                found |= {
                    name: HUM_SD * noise * values for name, values in _hum(mains, output.data.size, output.step).items()
                }
        return found

    def _basis(self, r: int, output: Output) -> tuple[list[int], Array]:
        """Where the additives of a channel stand in x, and their shapes, (q, n)."""
        shapes = self.additives(output)
        at = [self._where[("additive", output.name, name, r)] for name in shapes]
        return at, np.stack(list(shapes.values())) if shapes else np.zeros((0, output.data.size))

    def index(self, kind: str, owner: str, name: str, run: int = -1) -> int | None:
        """Place in x of one free number, None where the model has no such."""
        return self._where.get((kind, owner, name, run))

    def scales(self, axis: str) -> Scales:
        """Natural sizes of an axis: of the first recording in which it moves."""
        return next(run.scales[axis] for run in self.runs if axis in run.scales)

    def values(self, candidate: Candidate, x: Array) -> tuple[float, ...]:
        """Physical values of a candidate's parameters."""
        at = [self._where[("term", candidate.key, p.name, -1)] for p in candidate.term.free]
        return candidate.term.values([float(v) for v in x[at]], self.scales(candidate.axis))

    def nominal(self, axis: str, x: Array) -> Axis:
        """An axis with the nominal values that x gives it, a shared readout included."""
        parameters = self._nominal[axis]
        factors = [max(1.0 + tolerance * x[i], 0.02) for i, _, _, tolerance in parameters]
        key = (axis, *factors)
        made = self._made.get(key)
        if made is None:  # checking the numbers of a device takes as long as ten turns of the mirror
            tables: dict[str, dict[str, object]] = {}
            for (_, name, value, _), factor in zip(parameters, factors, strict=True):
                stage, own = name.split(".")
                new = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
                tables.setdefault(stage, {})[own] = new
            bare = replace(self.device.axis(axis), readout=readout_of(self.device, axis))
            made = replace(bare, **{stage: replace(getattr(bare, stage), **table) for stage, table in tables.items()})
            if len(self._made) > MADE:
                self._made.clear()
            self._made[key] = made
        return made

    def added(self, axis: str, r: int, x: Array) -> tuple[Added, ...]:
        """The candidates of an axis as the simulation takes them."""
        made = list(self.given[axis])
        for each in self.candidates:
            if each.axis == axis:
                scales = self.scales(axis)
                hidden = [
                    size(scales) * x[self._where[("hidden", each.key, str(i), r)]]
                    for i, size in enumerate(each.term.hidden)
                ]
                padded = [*hidden, 0.0, 0.0][:2]
                made.append(Added(each.term, self.values(each, x), each.channel, (padded[0], padded[1])))
        return tuple(made)

    def outputs(self, x: Array, stop: float = 1.0) -> list[list[Array]]:
        """Every compared channel of every run, as far as the fraction ``stop`` of the recording goes."""
        axes = {name: self.nominal(name, x) for name in self.axes}
        return [self._run_outputs(run, r, axes, x, stop) for r, run in enumerate(self.runs)]

    def full_signals(self, x: Array, r: int = 0) -> list[Array]:
        """Every channel of one run on the whole integration grid, shape (n + 1,) each, nothing added under it."""
        bare = np.where([each.kind == "additive" for each in self.free], 0.0, x)
        return self._signals(self.runs[r], r, {name: self.nominal(name, x) for name in self.axes}, bare, 1.0)

    def _run_outputs(self, run: Run, r: int, axes: dict[str, Axis], x: Array, stop: float) -> list[Array]:
        signals = self._signals(run, r, axes, x, stop)
        return [self._offset(o, o.sampled(signal), r, x) for o, signal in zip(run.outputs, signals, strict=True)]

    def _signals(self, run: Run, r: int, axes: dict[str, Axis], x: Array, stop: float) -> list[Array]:
        added = {name: self.added(name, r, x) for name in run.inputs}
        paths = self.paths(run, r, axes, added, x, stop)
        signals = []
        for output in run.outputs:
            seen = [paths[name] for name in output.axes]
            if output.kind == "sense":
                readout = axes[output.axes[0]].readout
                assert readout is not None
                at, shapes = self._beneath.get((r, output.name), _NOTHING)
                signals.append(sense(readout, seen, x[at] @ shapes[:, : seen[0].angle.size] if at else 0.0))
            else:
                signals.append(reference(seen[0]))
        return signals

    def paths(self, run: Run, r: int, axes: dict[str, Axis], added: dict[str, tuple[Added, ...]], x: Array,
              stop: float) -> dict[str, Path]:  # fmt: skip
        """The motion of every axis."""

        def moved(name: str, inputs: Inputs, start: tuple[float, float], other: Array | None) -> Path:
            if other is not None:
                return move(axes[name], added[name], inputs, start, other)
            return self._remembered(axes[name], added[name], inputs, start, r)

        inputs = {name: _cut(each, stop) for name, each in run.inputs.items()}
        coupled = any(each.term.coupled for terms in added.values() for each in terms)
        starts = {name: self.start(name, r, x) for name in run.inputs}
        return move_all(inputs, starts, coupled, moved)

    def start(self, name: str, r: int, x: Array) -> tuple[float, float]:
        """Angle [rad] and rate [rad/s] of an axis at the first sample of one run."""
        scales = self.runs[r].scales[name]
        angle, rate = (x[self._where[("start", name, each, r)]] for each in ("angle", "rate"))
        return scales.amplitude * angle, scales.amplitude * scales.rate * rate

    def prepare(self, xs: Sequence[Array], stop: float, every: Callable[..., Iterable[object]] = map) -> None:
        """Integrate side by side the motions that :meth:`outputs` at each of ``xs`` is going to ask for.

        Args:
            every: runs a function on all of a list.
        """
        groups: dict[tuple[int, str, tuple[object, ...]], dict[_Key, _Motion]] = {}
        for x in xs:
            for name in self.axes:
                axis = self.nominal(name, x)
                for r, run in enumerate(self.runs):
                    if name in run.inputs:
                        motion = _Motion(axis, _moving(self.added(name, r, x)), self.start(name, r, x))
                        inputs = _cut(run.inputs[name], stop)
                        key = motion.key(r, inputs)
                        if key not in self._paths:
                            drive = tuple(each.values for each in motion.added if each.term.voltage is not None)
                            groups.setdefault((r, name, drive), {})[key] = motion

        def moved(some: tuple[Inputs, list[tuple[_Key, _Motion]]]) -> None:
            paths = move_abreast([motion for _, motion in some[1]], some[0])
            with self._lock:
                self._ready |= {key: path for (key, _), path in zip(some[1], paths, strict=True)}

        abreast = []
        for (r, name, _), group in groups.items():
            inputs, asked = _cut(self.runs[r].inputs[name], stop), list(group.items())
            parts = max(-(-len(asked) // LANES), 1 + (len(asked) > LANES // 2))  # something for a second processor
            abreast += [(inputs, asked[i::parts]) for i in range(parts)]
        list(every(moved, abreast))

    def _remembered(self, axis: Axis, added: tuple[Added, ...], inputs: Inputs,
                    start: tuple[float, float], r: int) -> Path:  # fmt: skip
        """The last few motions are kept: a changed readout needs no new integration."""
        motion = _Motion(axis, _moving(added), start)
        key = motion.key(r, inputs)
        with self._lock:
            path = self._ready.pop(key, None) or self._paths.pop(key, None)
        if path is None:
            (path,) = move_abreast([motion], inputs)
        with self._lock:  # at the end: the one used last is the last to go
            self._paths[key] = path
            if len(self._paths) > 8 * len(self.runs):
                self._paths.pop(next(iter(self._paths)))
        return replace(path, axis=with_constants(axis, added), added=added)

    def _offset(self, output: Output, signal: Array, r: int, x: Array) -> Array:
        gain = self.index("gain", output.name, "gain", r)
        if gain is not None:
            signal = signal * (1.0 + REFERENCE_GAIN_SD * x[gain])
        at, shapes = self.basis[(r, output.name)]
        if not np.any(x[at]):
            return signal
        return signal + x[at] @ shapes[:, : signal.size]

    def embed(self, other: Model, x: Array) -> Array:
        """``x`` of another model in this one's order; what the other lacks is zero."""
        return np.array(
            [0.0 if (i := other.index(f.kind, f.owner, f.name, f.run)) is None else x[i] for f in self.free]
        )


def _on_grid(shapes: Array, output: Output, run: Run) -> Array:
    """``shapes`` (q, n) on a channel's own clock, on the integration grid, (q, N + 1): they are slow."""
    grid = np.arange(len(run.inputs[output.axes[0]].voltage) + 1)
    at, own = (grid - output.first) / output.stride, np.arange(shapes.shape[1])
    return np.array([np.interp(at, own, shape) for shape in shapes]).reshape(len(shapes), grid.size)


@lru_cache(maxsize=16)
def _hum(mains: float, n: int, step: float) -> dict[str, Array]:
    """Quadratures of the mains' first multiples, the higher the weaker."""
    turn = 2 * np.pi * step * np.arange(n)
    return {
        f"{name} {mains * multiple:g} Hz": wave(mains * multiple * turn) / multiple
        for multiple in range(1, HUM_MULTIPLES + 1)
        for name, wave in (("cos", np.cos), ("sin", np.sin))
    }


def nominal_parameters(device: Device, axis: str) -> list[tuple[str, float | tuple[float, ...], float]]:
    """What of an axis may lie off its nominal value: (``stage.key``, nominal value, relative tolerance)."""
    of = device.axis(axis)
    readout = readout_of(device, axis)
    shared = device.readout is not None and axis != next(iter(device.axes))
    found: list[tuple[str, float | tuple[float, ...], float]] = []
    stages: list[tuple[str, object, tuple[str, ...]]] = [
        ("mechanics", of.mechanics, ("J", "b", "k")),
        ("capacitance", of.capacitance, ("C0", "theta0", "theta_th", *(("Cb",) if isinstance(readout, Amdm) else ()))),
        ("drive", of.drive, ("torque_per_volt",)),
        ("readout", None if shared else readout, _readout_keys(readout)),
    ]
    for stage, table, keys in stages:
        for key in keys:
            value = getattr(table, key, None)
            tolerance = device.tolerance(axis, key)
            if value and tolerance > 0.0:
                found.append((f"{stage}.{key}", value, tolerance))
    return found


def _readout_keys(readout: Readout | None) -> tuple[str, ...]:
    if readout is None:
        return ()
    return {"amdm": ("a_cir", "b_cir", "lpf_hz"), "transimpedance": ("R_s",), "position": ("gain", "offset")}[
        readout.kind
    ]


def _moving(added: Iterable[Added]) -> tuple[Added, ...]:
    """Those that change the motion."""
    return tuple(each for each in added if each.term.stage in ("drive", "mechanics", "capacitance"))


def _cut(inputs: Inputs, stop: float) -> Inputs:
    if stop >= 1.0:
        return inputs
    return replace(inputs, voltage=inputs.voltage[: max(8, int(stop * len(inputs.voltage)))])
