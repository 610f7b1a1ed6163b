"""chen2019 Tables I and III, figs 7 to 10: EKF and HYB on ten free decays, in four segments of decreasing
signal-to-noise ratio.

The truth is integrated by Runge-Kutta at four times the recording's rate. The filters' device differs from the true one
by ``ERRORS``, drawn for each trial.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.papers.figures import Results, entry, figure
from benchmarks.papers.phase import rms
from benchmarks.papers.threshold import lilliefors, sensing_axis
from estimation.filters.hybrid import SIGMA_CYCLES, make_detector, run_hybrid
from estimation.filters.inputs import FilterInput, prepare_filter_inputs
from estimation.filters.run import tune_torque_noise
from estimation.filters.threshold import CrossingDetector, calibrate_crossings, find_crossings
from phantoms.forward import InitialState, Plan, simulate_trajectory
from phantoms.sense_channels import quantise
from phantoms.waveforms import Constant
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.forward_model import sense_signal
from scanner.recording import Recording

RATE, DURATION, BIAS, AMPLITUDE = 500e3, 0.08, 10.0, 0.15
SEGMENTS = ("snr85", "snr22", "snr5", "snr1")
TRIALS, SEED = 10, 2019
SAMPLES_AFTER_CROSSING = 50  # samples after a crossing
PAPER_SIGMA = 15.0

ERRORS = {"k": 0.0045, "b": 0.05, "C0": 0.02, "theta0": 0.02}
"""Relative standard deviation of the filter's nominal values; theta_th has 0.2 mrad. ``k``: the decay's frequency is
fitted once although it depends on amplitude. C0 and theta0: from a fit to the position detector."""
THRESHOLD_SD_RAD = 2e-4

PROCESS_NOISE = 3e7
"""Process noise Q_theta [(rad/s2)^2]. The paper states none; with this value the EKF has the paper's overall RMSE of
3.4 mrad."""


@dataclass(frozen=True)
class Trial:
    """One decay: the filter's input, and the true angle [rad] at its samples."""

    problem: FilterInput
    axis: Axis
    angle: Array
    tuned_height: float


def trial(seed: int) -> Trial:
    rng = np.random.default_rng(seed)
    true = sensing_axis()
    phase, w = rng.uniform(0, 2 * np.pi), 2 * np.pi * true.resonance
    plan = Plan({"x": Constant(BIAS)}, DURATION, RATE, substeps=4)
    start = InitialState(AMPLITUDE * np.cos(phase), -AMPLITUDE * w * np.sin(phase))
    path = simulate_trajectory(true, plan, start, 0.0, DURATION)
    readout, angle = true.require_readout(), path.angle[:-1:4]
    signal = sense_signal(readout, [path])[:-1:4]
    signal = quantise(signal + rng.normal(0.0, readout.noise_sd, signal.size), readout.bits, 10.0)
    nominal = miscalibrated(true, rng)
    channels = {"sense_x": (signal, "V", RATE, 0.0), "bias_x": (np.full(signal.size, BIAS), "V", RATE, 0.0)}
    recording = Recording.from_arrays(channels, Device("nominal", {"x": nominal}))
    (problem,) = prepare_filter_inputs(recording, recording.device)  # type: ignore[arg-type]
    return Trial(problem, nominal, angle, float(tune_torque_noise(problem)[0]))


def miscalibrated(axis: Axis, rng: np.random.Generator) -> Axis:
    off = {key: 1.0 + sd * rng.standard_normal() for key, sd in ERRORS.items()}
    m, comb = axis.require_mechanics(), axis.require_capacitance()
    return replace(
        axis,
        mechanics=replace(m, k=m.k * off["k"], b=m.b * off["b"]),
        capacitance=replace(
            comb,
            C0=comb.C0 * off["C0"],
            theta0=comb.theta0 * off["theta0"],
            theta_th=comb.theta_th + THRESHOLD_SD_RAD * rng.standard_normal(),
        ),
    )


def segments_of(values: Array) -> list[Array]:
    """The four segments, 20 ms each."""
    return np.array_split(values, len(SEGMENTS))


def angle_errors(
    of: Trial, detector: CrossingDetector, full_jacobian: bool, events: bool, tuned: bool = False
) -> Array:
    """Error of the estimated angle at every sample, shape (n,) [rad]; ``tuned``: process noise by likelihood."""
    height = of.tuned_height if tuned else PROCESS_NOISE
    result = run_hybrid(
        of.problem, of.axis, height, detector, full_jacobian=full_jacobian, events=events, floor=THRESHOLD_SD_RAD
    )
    return result.theta[0] - of.angle


def after_crossings(of: Trial, detector: CrossingDetector) -> NDArray[np.bool_]:
    """Samples within ``SAMPLES_AFTER_CROSSING`` of a detected crossing."""
    mask = np.zeros(of.angle.size, dtype=bool)
    for at in np.round(find_crossings(of.problem.signal, detector)).astype(int):
        mask[at : at + SAMPLES_AFTER_CROSSING] = True
    return mask


def crossing_errors(of: Trial, detector: CrossingDetector) -> list[Array]:
    """Error of the angle of each detected crossing, by segment [rad]; its variance is the filter's R_theta,th."""
    crossings = find_crossings(of.problem.signal, detector)
    true = np.interp(crossings, np.arange(of.angle.size), of.angle)
    rate = np.abs(np.interp(crossings, np.arange(of.angle.size), np.gradient(of.angle, 1 / RATE)))
    law = calibrate_crossings(sensing_axis(), detector, sensing_axis().resonance, 1 / RATE)
    error = np.interp(rate, law.rates, law.angles) - true
    edges = np.arange(1, len(SEGMENTS)) * of.angle.size / len(SEGMENTS)
    return np.split(error, np.searchsorted(crossings, edges))


def table(
    trials: list[Trial], sigma: float | None, full_jacobian: bool, tuned: bool = False
) -> dict[str, tuple[list[float], list[float]]]:
    """RMSE of EKF and HYB [rad]: over the four segments and overall, for all samples and after crossings."""
    out = {}
    for name, events in (("ekf", False), ("hyb", True)):
        parts: list[list[Array]] = [[] for _ in SEGMENTS]
        near: list[list[Array]] = [[] for _ in SEGMENTS]
        for of in trials:
            detector = make_detector(of.problem, sigma)
            error, mask = angle_errors(of, detector, full_jacobian, events, tuned), after_crossings(of, detector)
            for i, (part, kept) in enumerate(zip(segments_of(error), segments_of(mask), strict=True)):
                parts[i].append(part)
                near[i].append(part[kept])
        columns = []
        for kind in (parts, near):
            pooled = [np.concatenate(values) for values in kind]
            columns.append([rms(values) if values.size else np.nan for values in (*pooled, np.concatenate(pooled))])
        out[name] = (columns[0], columns[1])
    return out


PAPER = {
    "ekf": (0.0050, 0.0029, 0.0026, 0.0025, 0.0034),
    "hyb": (0.0047, 0.0023, 0.0019, 0.0018, 0.0029),
    "reduction": (0.069, 0.214, 0.276, 0.303, 0.151),
    "ekf_th": (0.0055, 0.0051, 0.0050, 0.0049, 0.0051),
    "hyb_th": (0.0041, 0.0045, 0.0049, 0.0045, 0.0045),
    "reduction_th": (0.260, 0.116, 0.026, 0.081, 0.123),
}
SIGMAS = (1.5, 5.0, 10.0, 15.0, 22.0, 30.0, 45.0, 70.0, 96.0, 120.0)


def results() -> Results:
    """Entries of ``results.json``; draws figs 7 to 10."""
    trials = [trial(SEED + i) for i in range(TRIALS)]
    reduced, full = table(trials, None, False), table(trials, None, True)
    tuned, printed = table(trials, None, True, True), table(trials, PAPER_SIGMA, False)
    out: Results = {}
    for i, segment in enumerate((*SEGMENTS, "overall")):
        for j, kind in enumerate(("", "_th")):
            ekf, hyb = (reduced[name][j][i] for name in ("ekf", "hyb"))
            for name, value in (("ekf", ekf), ("hyb", hyb), ("reduction", 1 - hyb / ekf)):
                out[f"table3.{name}{kind}.{segment}"] = entry(PAPER[name + kind][i], value, TRIALS, SEED)
        for name, rows in (("full_jacobian", full), ("full_jacobian_tuned", tuned)):
            ekf, hyb = (rows[kind][0][i] for kind in ("ekf", "hyb"))
            out[f"{name}.ekf.{segment}"] = entry(PAPER["ekf"][i], ekf, TRIALS, SEED)
            out[f"{name}.hyb.{segment}"] = entry(PAPER["hyb"][i], hyb, TRIALS, SEED)
            out[f"{name}.reduction.{segment}"] = entry(PAPER["reduction"][i], 1 - hyb / ekf, TRIALS, SEED)
        out[f"sigma15.reduction.{segment}"] = entry(
            PAPER["reduction"][i], 1 - printed["hyb"][0][i] / printed["ekf"][0][i], TRIALS, SEED
        )
    best = make_detector(trials[0].problem)
    crossing_angle_errors = [
        np.concatenate(parts) for parts in zip(*(crossing_errors(of, best) for of in trials), strict=True)
    ]
    rng = np.random.default_rng(SEED)
    signals = [segments_of(of.problem.signal) for of in trials]
    for i, segment in enumerate(SEGMENTS):
        power = float(np.mean([np.var(s[i]) for s in signals])) / 0.0435**2 - 1.0
        out[f"segment.snr.{segment}"] = entry(float(segment[3:]), power, TRIALS, SEED)
        out[f"fig7.lilliefors_p.{segment}"] = entry(
            0.05, lilliefors(crossing_angle_errors[i], rng), crossing_angle_errors[i].size, SEED
        )
    spread = {sigma: [rms(v) for v in crossing_errors_by_segment(trials, sigma)] for sigma in SIGMAS}
    nrmse = {sigma: normalised_rmse(trials[:5], sigma) for sigma in SIGMAS}
    for i, segment in enumerate(SEGMENTS):
        out[f"fig10.nrmse_at_sigma_45_over_1.5.{segment}"] = entry(None, nrmse[45.0][i] / nrmse[1.5][i], 5, SEED)
        out[f"fig8.variance_at_sigma_45_over_15.{segment}"] = entry(
            None, (spread[45.0][i] / spread[15.0][i]) ** 2, TRIALS, SEED
        )
    out["sigma_dog_samples"] = entry(PAPER_SIGMA, SIGMA_CYCLES * RATE / sensing_axis().resonance, 1, 0)
    out["causal.latency_of_hyb_ms"] = entry(None, 1e3 * best.latency / RATE, 1, 0)
    draw(trials[0], crossing_angle_errors, spread, nrmse)
    return {f"chen2019.{key}": value for key, value in out.items()}


def crossing_errors_by_segment(trials: list[Trial], sigma: float) -> list[Array]:
    """Crossing-angle errors of all trials in each segment [rad]."""
    errors = [crossing_errors(of, make_detector(of.problem, sigma)) for of in trials]
    joined = [np.concatenate(parts) for parts in zip(*errors, strict=True)]
    return [part if part.size else np.array([np.nan]) for part in joined]


def normalised_rmse(trials: list[Trial], sigma: float) -> list[float]:
    """RMSE of HYB over the segment's mean amplitude (eq 15)."""
    parts = [segments_of(angle_errors(of, make_detector(of.problem, sigma), False, True)) for of in trials]
    size = [np.sqrt(2.0) * rms(part) for part in segments_of(trials[0].angle)]
    return [rms(np.concatenate([p[i] for p in parts])) / size[i] for i in range(len(SEGMENTS))]


def draw(
    of: Trial, crossing_angle_errors: list[Array], spread: dict[float, list[float]], nrmse: dict[float, list[float]]
) -> None:
    with figure("chen2019_fig7", columns=4, size=(10.0, 2.6)) as axes:
        for drawn, values, segment in zip(axes[0], crossing_angle_errors, SEGMENTS, strict=True):
            drawn.hist(1e3 * values, 30, density=True)
            x = np.linspace(*drawn.get_xlim(), 200)
            sd = 1e3 * values.std()
            drawn.plot(x, np.exp(-0.5 * ((x - 1e3 * values.mean()) / sd) ** 2) / sd / np.sqrt(2 * np.pi))
            drawn.set(title=segment.upper(), xlabel="crossing-angle error [mrad]")
    with figure("chen2019_fig8_10", columns=2, size=(9.0, 3.4)) as axes:
        for i, segment in enumerate(SEGMENTS):
            axes[0, 0].loglog(SIGMAS, [spread[s][i] ** 2 for s in SIGMAS], "o-", ms=3, label=segment.upper())
            axes[0, 1].semilogx(SIGMAS, [nrmse[s][i] for s in SIGMAS], "o-", ms=3)
        axes[0, 0].set(xlabel=r"$\sigma_{DOG}$ [samples]", ylabel="variance of the crossing's angle [rad$^2$]")
        axes[0, 1].set(xlabel=r"$\sigma_{DOG}$ [samples]", ylabel="normalised RMSE of HYB")
        axes[0, 0].legend(fontsize=7)
    detector = make_detector(of.problem)
    time = 1e3 * np.arange(of.angle.size) / RATE
    with figure("chen2019_fig9", 2, 4, (11.0, 4.6)) as axes:
        for i, segment in enumerate(SEGMENTS):
            cut = slice(i * time.size // 4 + 500, i * time.size // 4 + 1500)
            axes[0, i].plot(time[cut], of.angle[cut], "k", label="true")
            for name, events in (("EKF", False), ("HYB", True)):
                estimate = of.angle + angle_errors(of, detector, False, events)
                axes[0, i].plot(time[cut], estimate[cut], lw=0.8, label=name)
            axes[1, i].plot(time[cut], of.problem.signal[cut], lw=0.4)
            inside = [p for p in find_crossings(of.problem.signal, detector) if cut.start <= p < cut.stop]
            for position in inside:
                axes[1, i].axvline(1e3 * position / RATE, color="r", lw=0.8)
            axes[0, i].set(title=segment.upper())
            axes[1, i].set(xlabel="time [ms]")
        axes[0, 0].set(ylabel="angle [rad]")
        axes[1, 0].set(ylabel="sense [V]")
        axes[0, 0].legend(fontsize=6)
