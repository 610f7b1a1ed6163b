"""chen2020 Table III, figs 8 and 9: phase and angle of ACM, EKF and UKF over the sustained band.

The truth is the circuit simulated at 40 MHz (``phantoms.amdm``), not the estimators' equations. The trials are those of
``table3_trials``. Every second drive frequency serves to identify what the paper identifies (gain, offset, filter
phase); the others are scored.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.papers.figures import Results, entry, figure
from benchmarks.papers.phase import demodulated_error_deg, peak_error_deg, rms
from benchmarks.papers.table3_trials import RATE, Trial, scene, trial
from estimation.filters.inputs import FilterInput, prepare_filter_inputs
from estimation.filters.run import PUBLISHED_ACCELERATION_VARIANCE, run_compiled
from estimation.identification.fits import (
    DrivenRecord,
    fit_mechanics,
)
from estimation.identification.readout_fit import ReadoutFit, fit_readout, readout_features
from phantoms.circuit import AmdmCircuit, envelope_section
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.laws import capacitance
from scanner.lock_in import block_length, block_phasors
from scanner.recording import Recording
from scanner.stages import Mechanics

SCORED_FROM = 0.008  # s. Twice the mirror's 4 ms, after which the model does not depend on its initial state
RESONANCE_SHIFT = 0.002
"""Relative change of stiffness after the lag-modelled identification: a shift of the resonance by 0.1 %."""

MEASUREMENT_FOLLOWING_NOISE = 1e16
"""Process noise with which a filter follows its measurement independently of its resonance [(rad/s2)^2]."""


def filter_input(axis: Axis, sense: Array, drive: Array, late: float = 0.0) -> FilterInput:
    """A filter's input. The sense signal's delay ``late`` [s] against the drive is removed."""
    first = int(np.ceil(max(late, 0.0) * RATE))
    channels = {
        "sense_x": (sense[first:], "V", RATE, first / RATE - late),
        "drive_x": (drive, "V", RATE, 0.0),
    }
    recording = Recording.from_arrays(channels, Device("nominal", {"x": axis}))
    (problem,) = prepare_filter_inputs(recording, recording.device)
    return replace(problem, model=replace(problem.model, offset=axis.require_readout().b_cir))


def constant_phase(of: Trial, half: Sequence[int]) -> tuple[Axis, float]:
    """The paper's readout: one filter delay for the whole sweep, then a_cir and b_cir by least squares (IV-A).

    Returns:
        the axis with that readout and no sections, and the delay [s].
    """
    comb = of.axis.require_capacitance()
    delays = []
    for i in half:
        f = of.scene.frequencies[i]
        block = block_length(f, RATE, 40.0)
        C = capacitance(of.references[i].angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th)
        observed, true = (block_phasors(v, RATE, 0.0, f, block)[1] for v in (-of.senses[i], C))
        delays.append(-np.angle(np.sum(observed * true.conj())) / (2 * np.pi * f))
    late = float(np.mean(delays))
    shift = late * RATE
    shifted = [
        replace(r, angle=np.interp(np.arange(r.angle.size) - shift, np.arange(r.angle.size), r.angle))
        for r in of.references
    ]
    fit = fit_readout(comb, [shifted[i] for i in half], [of.senses[i] for i in half], (), ("a_cir", "b_cir"))
    return with_readout(of.axis, fit, ()), late


def with_readout(axis: Axis, fit: ReadoutFit, sections: tuple[float, ...]) -> Axis:
    values = {key: fit.values[key].value for key in ("a_cir", "b_cir")}
    return replace(axis, readout=replace(axis.require_readout(), lpf_hz=sections, **values))


def with_euler_step(problem: FilterInput, axis: Axis) -> FilterInput:
    """The first-order step as printed (eq 10). Its transition I + A Ts adds energy at the rate w^2 Ts / 2."""
    m, h = axis.require_mechanics(), problem.model.step
    parameters = problem.model.parameters.copy()
    parameters[0, :4] = 1.0, h, -h * m.k / m.J, 1.0 - h * m.b / m.J
    return replace(problem, model=replace(problem.model, parameters=parameters))


def filtered_angle(problem: FilterInput, method: str, height: float) -> Array:
    """The filter's angle at the recording's samples; empty where the filter fails."""
    try:
        result = run_compiled(
            problem, "ekf" if method == "acm" else method, np.array([height]), measured=method != "acm"
        )
    except BadInput:
        return np.empty(0)
    time = problem.sense.channel.time()
    return np.interp(np.arange(time.size) / RATE, time, result.theta[0])


@dataclass(frozen=True)
class Score:
    """Errors of one estimate at one drive frequency [deg]."""

    peak: Array
    demodulated: Array
    angle: float

    @classmethod
    def of(cls, estimate: Array, truth: Array, f: float) -> Score:
        """The errors after ``SCORED_FROM``. A symmetric comb cannot determine the sign: it is the truth's."""
        first = round(SCORED_FROM * RATE)
        estimated, true = estimate[first:], truth[first : estimate.size]
        if estimated.size == 0 or np.abs(estimated).max() < 0.2 * np.abs(true).max():
            return cls(np.array([90.0]), np.array([90.0]), float(np.rad2deg(rms(truth))))  # no motion has no phase
        estimated = estimated * np.sign(estimated @ true)
        return cls(
            peak_error_deg(estimated, true, RATE, f),
            demodulated_error_deg(estimated, true, RATE, f),
            float(np.rad2deg(rms(estimated - true))),
        )


Scores = dict[str, list[Score]]
HEIGHTS = 10.0 ** np.arange(11, 17)


def tune_process_noise(
    problems: Mapping[int, FilterInput], references: Sequence[DrivenRecord], frequencies: Array
) -> float:
    """The process noise, to a decade, with the least phase error at the identification frequencies."""

    def error(height: float) -> float:
        scores = [
            Score.of(filtered_angle(p, "ekf", height), references[i].angle, frequencies[i] / 2)
            for i, p in problems.items()
        ]
        return rms(np.concatenate([s.peak for s in scores]))

    return float(min(HEIGHTS, key=error))


def run_trial(of: Trial) -> tuple[Scores, dict[str, float]]:
    """Scores of all estimators after identification at the other frequencies, and the tuned process noises."""
    scene, count = of.scene, len(of.scene.frequencies)
    identifying, scored = range(0, count, 2), range(1, count, 2)
    constant, late = constant_phase(of, identifying)
    modelled, linearise = lag_modelled(of, identifying)

    def problems(axis: Axis, half: Sequence[int], late: float = 0.0, linear: bool = False) -> dict[int, FilterInput]:
        made = {}
        for i in half:
            drive = of.references[i].voltage
            made[i] = filter_input(axis, of.senses[i], drive, late)
            if linear:
                first = filtered_angle(made[i], "ekf", MEASUREMENT_FOLLOWING_NOISE)
                made[i] = filter_input(axis, linearise(of.senses[i], first, drive), drive)
        return made

    few = identifying[::3]
    heights = {
        "constant": tune_process_noise(problems(constant, few, late), of.references, scene.frequencies),
        "lag": tune_process_noise(problems(modelled, few, linear=True), of.references, scene.frequencies),
    }
    nominal, paper = problems(of.axis, scored), problems(constant, scored, late)
    ours = problems(modelled, scored, linear=True)
    m = modelled.require_mechanics()
    shifted = replace(modelled, mechanics=replace(m, k=m.k * (1.0 + RESONANCE_SHIFT)))
    printed = {i: with_euler_step(p, constant) for i, p in paper.items()}
    variants = {
        "acm": (nominal, "acm", PUBLISHED_ACCELERATION_VARIANCE),
        "ekf": (paper, "ekf", heights["constant"]),
        "ukf": (paper, "ukf", heights["constant"]),
        "ekf_printed_noise": (paper, "ekf", PUBLISHED_ACCELERATION_VARIANCE),
        "ukf_printed_noise": (paper, "ukf", PUBLISHED_ACCELERATION_VARIANCE),
        "ekf_euler": (printed, "ekf", PUBLISHED_ACCELERATION_VARIANCE),
        "lag_ekf": (ours, "ekf", heights["lag"]),
        "lag_ukf": (ours, "ukf", heights["lag"]),
        "lag_moved": (problems(shifted, scored, linear=True), "ukf", MEASUREMENT_FOLLOWING_NOISE),
    }
    scores = {
        name: [
            Score.of(filtered_angle(ps[i], method, q), scene.records[i][1], scene.frequencies[i] / 2) for i in scored
        ]
        for name, (ps, method, q) in variants.items()
    }
    return scores, heights


def lag_modelled(of: Trial, half: Sequence[int]) -> tuple[Axis, Callable[[Array, Array, Array], Array]]:
    """Mechanics with the torque's scale, and a readout with the circuit's sections, squared capacitance and
    feedthrough.

    Returns:
        the identified axis, and a function of sense signal, first estimate of the angle and drive that returns the
        signal of the formula a_cir C + b_cir at that angle.
    """
    comb = of.axis.require_capacitance()
    sections = (*of.axis.require_readout().lpf_hz, envelope_section(AmdmCircuit()))
    records, senses = [of.references[i] for i in half], [of.senses[i] for i in half]
    mechanics = fit_mechanics(of.axis, records)
    full = fit_readout(comb, records, senses, sections)
    line = fit_readout(comb, records, senses, sections, ("a_cir", "b_cir"))
    axis = replace(of.axis, mechanics=Mechanics(*(mechanics[key].value for key in ("J", "b", "k"))))

    def linearised(sense: Array, angle: Array, drive: Array) -> Array:
        features = readout_features(comb, angle, drive, RATE, sections)
        return sense - features @ (full.coefficients - line.coefficients)

    return with_readout(axis, line, sections), linearised


@dataclass(frozen=True)
class Table:
    """All trials: by estimator, one list of scores (scored frequencies) a trial; and the tuned process noises."""

    frequencies: Array
    scores: Mapping[str, Sequence[Sequence[Score]]]
    heights: Sequence[Mapping[str, float]]

    def per_trial(self, name: str, what: str) -> Array:
        """RMS over the band of ``"peak"``, ``"demodulated"`` or ``"angle"`` errors, a trial [deg], (trials,)."""
        return np.array([rms(np.concatenate([np.atleast_1d(getattr(s, what)) for s in t])) for t in self.scores[name]])

    def over_band(self, name: str, what: str) -> Array:
        """RMS over the trials at each scored frequency [deg]."""
        trials = self.scores[name]
        return np.array([
            rms(np.concatenate([np.atleast_1d(getattr(t[j], what)) for t in trials])) for j in range(len(trials[0]))
        ])  # fmt: skip


def run(trials: int, seed: int, count: int = 15, duration: float = 0.016) -> Table:
    of = scene(count, duration)
    outcomes = [run_trial(trial(of, seed + i)) for i in range(trials)]
    names = outcomes[0][0]
    return Table(
        of.frequencies[1::2],
        {name: [scores[name] for scores, _ in outcomes] for name in names},
        [h for _, h in outcomes],
    )


PAPER = {"acm": (2.73, 2.89), "ekf": (0.68, 0.89), "ukf": (0.38, 0.62)}
TRIALS, SEED = 12, 2020


def results() -> Results:
    """Entries of ``results.json``; draws the paper's figs 8 and 9."""
    table = run(TRIALS, SEED)
    draw_signals(trial(scene(3), SEED))
    out: Results = {}
    for name, (phase, angle) in PAPER.items():
        for what, paper in (("peak", phase), ("angle", angle)):
            per_trial = table.per_trial(name, what)
            key = "phase_rmse_deg" if what == "peak" else "angle_rmse_deg"
            spread = {
                "median": float(np.median(per_trial)),
                "sd": float(per_trial.std()),
                "max": float(per_trial.max()),
            }
            out[f"chen2020.table3.{name}.{key}"] = entry(paper, rms(per_trial), TRIALS, SEED, spread_over_draws=spread)
        demodulated = table.per_trial(name, "demodulated")
        out[f"chen2020.table3.{name}.demodulated_phase_rmse_deg"] = entry(phase, rms(demodulated), TRIALS, SEED)
    for name in ("ekf", "ukf"):
        for what, key, column in (("peak", "phase", 0), ("angle", "angle", 1)):
            reduction = 1 - table.per_trial(name, what) / table.per_trial("acm", what)
            out[f"chen2020.table3.{name}.{key}_reduction"] = entry(
                1 - PAPER[name][column] / PAPER["acm"][column],
                1 - rms(table.per_trial(name, what)) / rms(table.per_trial("acm", what)),
                TRIALS, SEED, each_draw=[round(float(r), 3) for r in reduction],
            )  # fmt: skip
    for name in ("ekf_printed_noise", "ukf_printed_noise", "ekf_euler"):
        phase = PAPER[name[:3]][0]
        out[f"chen2020.variant.{name}.phase_rmse_deg"] = entry(phase, rms(table.per_trial(name, "peak")), TRIALS, SEED)
    for name in ("lag_ekf", "lag_ukf"):
        for what, key in (("peak", "peak_phase"), ("demodulated", "phase"), ("angle", "angle")):
            per_trial = table.per_trial(name, what)
            out[f"chen2020.lag_modelled.{name[4:]}.{key}_rmse_deg"] = entry(
                PAPER["ukf"][what == "angle"], rms(per_trial), TRIALS, SEED, worst_draw=float(per_trial.max())
            )
    for what, key in (("demodulated", "phase"), ("angle", "angle")):
        shifted_resonance = table.per_trial("lag_moved", what)
        out[f"chen2020.lag_modelled.resonance_moved.{key}_rmse_deg"] = entry(None, rms(shifted_resonance), TRIALS, SEED)
    both = out["chen2020.lag_modelled.ukf.phase_rmse_deg"], out["chen2020.lag_modelled.ukf.peak_phase_rmse_deg"]
    out["chen2020.lag_modelled.phase_rmse_deg"] = max(both, key=lambda e: e["ours"])
    draw(table)
    return out


def draw_signals(of: Trial) -> None:
    """Fig 8: drive and angle over two periods at the middle of the band, true and estimated."""
    middle = len(of.scene.frequencies) // 2 | 1
    sense, drive, true = of.senses[middle], of.references[middle].voltage, of.scene.records[middle][1]
    paper, late = constant_phase(of, range(0, len(of.senses), 2))
    shown = {
        "ACM": filtered_angle(filter_input(of.axis, sense, drive), "acm", PUBLISHED_ACCELERATION_VARIANCE),
        "EKF": filtered_angle(filter_input(paper, sense, drive, late), "ekf", 1e14),
        "UKF": filtered_angle(filter_input(paper, sense, drive, late), "ukf", 1e14),
    }
    cut = slice(round(SCORED_FROM * RATE), round(SCORED_FROM * RATE) + 640)
    time = 1e6 * np.arange(640) / RATE
    with figure("chen2020_fig8", rows=2, size=(7.0, 4.6)) as axes:
        axes[0, 0].plot(time, drive[cut])
        axes[0, 0].set(ylabel="drive [V]")
        axes[1, 0].plot(time, np.rad2deg(true[cut]), "k", label="true")
        for name, estimated in shown.items():
            signed = estimated[cut] * np.sign(estimated[cut] @ true[cut])
            axes[1, 0].plot(time, np.rad2deg(signed), lw=0.8, label=name)
        axes[1, 0].set(xlabel="time [us]", ylabel="angle [deg]")
        axes[1, 0].legend(fontsize=7)


def draw(table: Table) -> None:
    """Fig 9: RMSE of angle and of phase shift over the drive frequency."""
    styles = {"acm": ("ACM", "s-"), "ekf": ("EKF", "^-"), "ukf": ("UKF", "o--"), "lag_ukf": ("UKF, lag modelled", "d-")}
    with figure("chen2020_fig9", columns=2, size=(9.0, 3.4)) as axes:
        for drawn, what, label in zip(axes[0], ("angle", "peak"), ("angular position", "phase shift"), strict=True):
            for name, (text, style) in styles.items():
                drawn.semilogy(table.frequencies / 1e3, table.over_band(name, what), style, label=text)
            drawn.set(xlabel="drive frequency [kHz]", ylabel=f"RMSE of {label} [deg]")
        axes[0, 1].axhline(0.38, color="k", lw=0.8, ls=":", label="UKF of the paper")
        axes[0, 1].legend(fontsize=7)
