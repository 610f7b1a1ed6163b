"""Simulated channels of the nominal device with added terms, as a function of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimation.device_fit.data import Output, Run, readout_of
from estimation.device_fit.mains import NOMINAL_MAINS, Mains, hum_quadratures
from estimation.device_fit.parameters import (
    OFFSET_RELATIVE_SD,
    REFERENCE_GAIN_RELATIVE_SD,
    Candidate,
    ParameterSpec,
    nominal_parameters,
)
from estimation.device_fit.trajectory_cache import MotionRequest, TrajectoryCache
from scanner.active_terms import ActiveTerm, stated_terms
from scanner.arrays import Array
from scanner.coupled_motion import simulate_coupled
from scanner.device import Axis, Device
from scanner.forward_model import AxisTrajectory, DriveInput, reference_signal, sense_signal, simulate_axis
from scanner.integrator.abi import MAX_TERMS_PER_STAGE
from scanner.stages import Amdm
from scanner.terms import NaturalScales, Term

START_STATE_SD = 3.0
"""Prior standard deviation of the initial angle and rate, and of the states of stated terms, in their natural sizes: so
wide that the data determine them."""

AXIS_CACHE_SIZE = 64
"""Axes with fitted nominal values that a model caches: about as many as one Jacobian has columns."""


_EMPTY_BASIS: tuple[list[int], Array] = [], np.zeros((0, 0))
"""Basis of a channel without additive parameters: indices in x, and waveforms, shape (0, 0)."""


class Model:
    """Simulated channels of one or more recordings as a function of parameters x.

    Attributes:
        runs: the recordings.
        steps: integration steps of all axes and recordings.
        device: the nominal device.
        candidates: added terms.
        mains: whose hum is part of the noise model.
        given: terms that the device states, by axis.
        axes: axes that the recordings contain.
        parameters: specification of each element of x.
        precision: 1 / variance of the prior of each element of x, shape (p,).
        basis: by (run, channel) the indices in x and the waveforms of what is added to the channel.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        device: Device,
        candidates: Sequence[Candidate] = (),
        mains: Sequence[Mains] = NOMINAL_MAINS,
    ):
        self.runs, self.device, self.candidates = tuple(runs), device, tuple(candidates)
        self.steps = sum(run.steps for run in runs)
        self.mains = tuple(mains)
        self.given = {name: stated_terms(axis) for name, axis in device.axes.items()}
        self.axes = tuple(name for name in device.axes if any(name in run.inputs for run in runs))
        self.parameters = tuple(self._parameter_specs())
        self.precision = np.array([spec.precision for spec in self.parameters])
        self._indices = {(f.kind, f.owner, f.name, f.run): i for i, f in enumerate(self.parameters)}
        # Additive waveforms of each channel: added last, or before the output law if that clips.
        self.basis, self._pre_saturation_basis = {}, {}
        terms = [candidate.term for candidate in self.candidates]
        terms += [active.term for of_axis in self.given.values() for active in of_axis]
        self.clips = any(term.after_noise for term in terms)
        for r, run in enumerate(self.runs):
            for output in run.outputs:
                indices, waveforms = self._additive_basis(r, output)
                if self.clips and output.kind == "sense":
                    self._pre_saturation_basis[r, output.name] = indices, _on_grid(waveforms, output, run)
                    indices, waveforms = _EMPTY_BASIS
                self.basis[r, output.name] = indices, waveforms
        self._trajectories = TrajectoryCache(8 * len(self.runs))
        self._axis_cache: dict[tuple[object, ...], Axis] = {}
        self._nominal = {
            axis: [(self._indices[("nominal", axis, name, -1)], name, value, tolerance)
                   for name, value, tolerance in nominal_parameters(device, axis)]
            for axis in self.axes
        }  # fmt: skip

    def _parameter_specs(self) -> list[ParameterSpec]:
        specs = [
            ParameterSpec("nominal", axis, name)
            for axis in self.axes
            for name, _, _ in nominal_parameters(self.device, axis)
        ]
        for candidate in self.candidates:
            specs += [ParameterSpec("term", candidate.key, p.name, parameter=p) for p in candidate.term.free_parameters]
        for r, run in enumerate(self.runs):
            for axis in run.inputs:
                specs += [ParameterSpec("start", axis, name, r, START_STATE_SD**-2) for name in ("angle", "rate")]
                specs += [
                    ParameterSpec("hidden", _stated_key(axis, active.term), str(i), r, START_STATE_SD**-2)
                    for active in self.given[axis]
                    for i in range(len(active.term.hidden_state_scales))
                ]
            for candidate in self.candidates:
                if candidate.axis in run.inputs:
                    specs += [
                        ParameterSpec("hidden", candidate.key, str(i), r)
                        for i in range(len(candidate.term.hidden_state_scales))
                    ]
            for output in run.outputs:
                if output.kind != "sense":
                    specs.append(ParameterSpec("gain", output.name, "gain", r))
                specs += [ParameterSpec("additive", output.name, name, r) for name in self.additive_terms(output)]
        return specs

    def additive_terms(self, output: Output) -> dict[str, Array]:
        """Waveforms that may add to a channel and do not depend on the motion, each shape (n,): an unstated offset, and
        hum."""
        waveforms = {}
        if output.kind != "sense" or not isinstance(readout_of(self.device, output.axes[0]), Amdm):
            waveforms["offset"] = np.full(output.data.size, OFFSET_RELATIVE_SD * output.data.std())
        if output.kind == "sense":
            noise = output.noise_sd or 0.0
            for mains in self.mains:
                lines = hum_quadratures(mains.frequency, mains.harmonics, output.data.size, output.step)
                waveforms |= {name: mains.relative_sd * noise * values for name, values in lines.items()}
        return waveforms

    def _additive_basis(self, r: int, output: Output) -> tuple[list[int], Array]:
        """Indices in x of the additive parameters of a channel, and their waveforms, shape (q, n)."""
        waveforms = self.additive_terms(output)
        indices = [self._indices[("additive", output.name, name, r)] for name in waveforms]
        return indices, np.stack(list(waveforms.values())) if waveforms else np.zeros((0, output.data.size))

    def index(self, kind: str, owner: str, name: str, run: int = -1) -> int | None:
        """Index in x of one parameter, None if the model does not have it."""
        return self._indices.get((kind, owner, name, run))

    def indices(self, kind: str, owner: str | None = None) -> list[int]:
        """Indices in x of all parameters of a kind, of one owner or of all."""
        return [i for i, f in enumerate(self.parameters) if f.kind == kind and owner in (None, f.owner)]

    def has_room_for(self, axis: str, term: Term) -> bool:
        """Whether the integrator takes one more term on an axis beside the stated ones and the candidates."""
        terms = [active.term for active in self.given[axis]]
        terms += [candidate.term for candidate in self.candidates if candidate.axis == axis]
        torques, capacitances = sum(bool(each.torque) for each in terms), sum(bool(each.capacitance) for each in terms)
        return (not term.torque or torques < MAX_TERMS_PER_STAGE) and (
            not term.capacitance or capacitances < MAX_TERMS_PER_STAGE
        )

    def with_candidates(self, candidates: Sequence[Candidate]) -> Model:
        """The model of the same recordings, device and mains with other added terms."""
        return Model(self.runs, self.device, candidates, self.mains)

    def scales(self, axis: str) -> NaturalScales:
        """Natural scales of an axis, from the recording with the strongest drive, then with the smallest motion.

        A ringdown among driven recordings has no drive, with whose scales no term of the drive would apply. The priors
        of nonlinear laws are widest by the smallest motion.
        """
        of_runs = (run.scales[axis] for run in self.runs if axis in run.scales)
        return max(of_runs, key=lambda scales: (scales.voltage_rms, -scales.amplitude))

    def values(self, candidate: Candidate, x: Array) -> tuple[float, ...]:
        """Physical values of the parameters of a candidate."""
        indices = [self._indices[("term", candidate.key, p.name, -1)] for p in candidate.term.free_parameters]
        return candidate.term.values([float(v) for v in x[indices]], self.scales(candidate.axis))

    def nominal(self, axis: str, x: Array) -> Axis:
        """An axis with the nominal values from x, including a shared readout."""
        parameters = self._nominal[axis]
        factors = [max(1.0 + tolerance * x[i], 0.02) for i, _, _, tolerance in parameters]
        key = (axis, *factors)
        result = self._axis_cache.get(key)
        if result is None:  # cached, because the validation of a device takes as long as the simulation of ten periods
            tables: dict[str, dict[str, object]] = {}
            for (_, name, value, _), factor in zip(parameters, factors, strict=True):
                stage, value_key = name.split(".")
                new = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
                tables.setdefault(stage, {})[value_key] = new
            stated = replace(self.device.axis(axis), readout=readout_of(self.device, axis))
            result = replace(
                stated, **{stage: replace(getattr(stated, stage), **table) for stage, table in tables.items()}
            )
            if len(self._axis_cache) > AXIS_CACHE_SIZE:
                self._axis_cache.clear()
            self._axis_cache[key] = result
        return result

    def active_terms(self, axis: str, r: int, x: Array) -> tuple[ActiveTerm, ...]:
        """The stated and the added terms of an axis with their values, as the simulation takes them."""
        terms = [
            replace(active, hidden_state=self._hidden_state(active.term, _stated_key(axis, active.term), axis, r, x))
            for active in self.given[axis]
        ]
        for candidate in self.candidates:
            if candidate.axis == axis:
                hidden = self._hidden_state(candidate.term, candidate.key, axis, r, x)
                terms.append(ActiveTerm(candidate.term, self.values(candidate, x), candidate.channel, hidden))
        return tuple(terms)

    def _hidden_state(self, term: Term, owner: str, axis: str, r: int, x: Array) -> tuple[float, float]:
        """Hidden states of a term at the first sample of run ``r``; 0 where it has none."""
        states = [
            size(self.scales(axis)) * x[self._indices[("hidden", owner, str(i), r)]]
            for i, size in enumerate(term.hidden_state_scales)
        ]
        first, second, *_ = [*states, 0.0, 0.0]
        return first, second

    def outputs(self, x: Array, stop: float = 1.0) -> list[list[Array]]:
        """Every compared channel of every run, up to the fraction ``stop`` of the recording.

        Those of a diverging trajectory are not finite.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return [self._run_outputs(r, x, stop) for r in range(len(self.runs))]

    def full_signals(self, x: Array, r: int = 0) -> list[Array]:
        """Every channel of a run on the integration grid, shape (n + 1,), without additive waveforms."""
        without_additive = np.where([spec.kind == "additive" for spec in self.parameters], 0.0, x)
        return self._signals(r, without_additive, 1.0)

    def _run_outputs(self, r: int, x: Array, stop: float) -> list[Array]:
        signals = zip(self.runs[r].outputs, self._signals(r, x, stop), strict=True)
        return [self._offset(output, output.sampled(signal), r, x) for output, signal in signals]

    def _signals(self, r: int, x: Array, stop: float) -> list[Array]:
        trajectories = self.trajectories(r, x, stop)
        signals = []
        for output in self.runs[r].outputs:
            of_channel = [trajectories[name] for name in output.axes]
            if output.kind == "sense":
                readout = self.nominal(output.axes[0], x).readout
                assert readout is not None
                indices, waveforms = self._pre_saturation_basis.get((r, output.name), _EMPTY_BASIS)
                signals.append(
                    sense_signal(
                        readout, of_channel, x[indices] @ waveforms[:, : of_channel[0].angle.size] if indices else 0.0
                    )
                )
            else:
                signals.append(reference_signal(of_channel[0], output.kind))
        return signals

    def trajectories(self, r: int, x: Array, stop: float = 1.0) -> dict[str, AxisTrajectory]:
        """Trajectories of all axes of run ``r``, up to the fraction ``stop`` of the recording."""
        run = self.runs[r]
        axes = {name: self.nominal(name, x) for name in run.inputs}
        active = {name: self.active_terms(name, r, x) for name in run.inputs}

        def simulate(name: str, inputs: DriveInput, start: tuple[float, float], other: Array | None) -> AxisTrajectory:
            if other is not None:
                return simulate_axis(axes[name], active[name], inputs, start, other)
            return self._trajectories.trajectory(MotionRequest(r, axes[name], active[name], start, inputs))

        inputs = {name: _truncate(drive, stop) for name, drive in run.inputs.items()}
        coupled = any(each.term.couples_motions for terms in active.values() for each in terms)
        starts = {name: self.start(name, r, x) for name in run.inputs}
        return simulate_coupled(inputs, starts, coupled, simulate)

    def start(self, name: str, r: int, x: Array) -> tuple[float, float]:
        """Initial angle [rad] and rate [rad/s] of an axis in one run."""
        scales = self.runs[r].scales[name]
        angle, rate = (x[self._indices[("start", name, quantity, r)]] for quantity in ("angle", "rate"))
        return scales.amplitude * angle, scales.amplitude * scales.rate * rate

    def prefetch_trajectories(self, xs: Sequence[Array], stop: float, parallel: bool = False) -> None:
        """Integrate in batches the trajectories that :meth:`outputs` needs at each of ``xs``.

        Args:
            parallel: integrate the batches on several processors, if the recordings are long enough. Not within a
                function that runs in parallel itself.
        """
        requests = (
            MotionRequest(
                r, axis, self.active_terms(name, r, x), self.start(name, r, x), _truncate(run.inputs[name], stop)
            )
            for x in xs
            for name, axis in ((name, self.nominal(name, x)) for name in self.axes)
            for r, run in enumerate(self.runs)
            if name in run.inputs
        )
        self._trajectories.prefetch(requests, self.steps if parallel else 0)

    def _offset(self, output: Output, signal: Array, r: int, x: Array) -> Array:
        """A simulated channel with the gain of a reference channel and the additive waveforms of x."""
        gain = self.index("gain", output.name, "gain", r)
        if gain is not None:
            signal = signal * (1.0 + REFERENCE_GAIN_RELATIVE_SD * x[gain])
        indices, waveforms = self.basis[(r, output.name)]
        if not np.any(x[indices]):
            return signal
        return signal + x[indices] @ waveforms[:, : signal.size]

    def map_parameters_from(self, other: Model, x: Array) -> Array:
        """``x`` of another model in the order of this one; parameters that the other lacks are zero."""
        return np.array(
            [0.0 if (i := other.index(f.kind, f.owner, f.name, f.run)) is None else x[i] for f in self.parameters]
        )


def _stated_key(axis: str, term: Term) -> str:
    """Owner of the hidden states of a term that the device states."""
    return f"stated {axis}.{term.effect}"


def _on_grid(waveforms: Array, output: Output, run: Run) -> Array:
    """Waveforms (q, n) from the clock of a channel to the integration grid, (q, N + 1), linearly: they are slow."""
    grid = np.arange(len(run.inputs[output.axes[0]].voltage) + 1)
    positions, samples = (grid - output.first) / output.stride, np.arange(waveforms.shape[1])
    return np.array([np.interp(positions, samples, waveform) for waveform in waveforms]).reshape(
        len(waveforms), grid.size
    )


def _truncate(inputs: DriveInput, stop: float) -> DriveInput:
    if stop >= 1.0:
        return inputs
    return replace(inputs, voltage=inputs.voltage[: max(8, int(stop * len(inputs.voltage)))])


def uncertain(model: Model) -> list[Candidate]:
    """The terms of a model that a fit can decide on: those recognised in the samples have no free parameter."""
    return [candidate for candidate in model.candidates if candidate.term.free_parameters]
