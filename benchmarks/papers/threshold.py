"""chen2019 V and VI-A, figs 5 to 8: timing error of a crossing over sampling rate, slope, noise and sigma_DOG."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.papers.figures import Results, entry, figure
from benchmarks.papers.phase import rms
from estimation.filters.threshold import CrossingDetector, find_crossings, find_crossings_in_blocks, timing_variance
from scanner.arrays import Array
from scanner.device import Axis
from scanner.devices import load
from scanner.laws import capacitance_slope

RATE, FREQUENCY, AMPLITUDE = 500e3, 625.0, 0.15  # Table II
NOISE, WIDTH, SIGMA = 0.0435, 400, 15.0
RATES = np.round(np.geomspace(50e3, 5e6, 17), -2)
SLOPES = np.array([0.2, 0.5, 1.0, 2.0, 3.5, 5.0])
SEED = 5


def sensing_axis() -> Axis:
    """The device chen2019 with the sensing comb that the paper's signal-to-noise ratios imply.

    Drive and sense are separate combs in the paper, and it states neither. With the stated resonance, damping, readout
    and noise, a decay from 0.15 rad has the four ratios 85, 22, 5 and 1 in its quarters of 20 ms, each to 18 %, for
    this capacitance only.
    """
    axis = load("chen2019").axis("x")
    return replace(axis, capacitance=replace(axis.require_capacitance(), C0=1.425e-12, theta0=0.0786))


def sensor_gain(theta: Array, slope_factor: float = 1.0) -> Array:
    """h_cap(theta) = N_g (logistic(N_theta theta) - 1/2) [V s/rad] (eq 12), matched to the device at slope_factor 1.

    N_g and the base N_theta give the device's slope at the threshold and its largest gain.
    """
    comb, readout = sensing_axis().require_capacitance(), sensing_axis().require_readout()
    scale = readout.R_s * readout.V_bias  # type: ignore[union-attr]
    largest = scale * np.abs(capacitance_slope(np.linspace(0, 0.3, 301), comb.C0, comb.theta0, 0.0)).max()
    slope = scale * 2.0 * comb.C0 / comb.theta0**2
    steepness = slope_factor * 4.0 * slope / (2.0 * largest)
    return 2.0 * largest * (1.0 / (1.0 + np.exp(-steepness * theta)) - 0.5)


def signal(rate: float, cycles: int, rng: np.random.Generator, slope_factor: float = 1.0) -> tuple[Array, Array]:
    """Noiseless sense signal of a steady motion [V], and the true crossings [samples]; the clock's phase is random."""
    time = np.arange(round(cycles * rate / FREQUENCY)) / rate
    turn = 2 * np.pi * (FREQUENCY * time + rng.uniform())
    omega = AMPLITUDE * 2 * np.pi * FREQUENCY * np.cos(turn)
    halves = np.arange(np.ceil(turn[0] / np.pi), turn[-1] / np.pi)
    at = (halves * np.pi - turn[0]) / (2 * np.pi * FREQUENCY) * rate
    return sensor_gain(AMPLITUDE * np.sin(turn), slope_factor) * omega, at


def timing_errors(
    detector: CrossingDetector,
    rate: float,
    noise: float,
    rng: np.random.Generator,
    cycles: int = 200,
    slope_factor: float = 1.0,
    whole_samples: bool = False,
) -> Array:
    """Timing errors of the detected crossings [s]; ``whole_samples`` places them on samples, as the paper does."""
    clean, true = signal(rate, cycles, rng, slope_factor)
    crossings = find_crossings(clean + noise * rng.standard_normal(clean.size), detector)
    crossings = np.round(crossings) if whole_samples else crossings
    nearest = true[np.abs(crossings[:, None] - true[None, :]).argmin(axis=1)]
    return (crossings - nearest) / rate


def detector(sigma: float = SIGMA, rate: float = RATE, noise: float = NOISE) -> CrossingDetector:
    return CrossingDetector(sigma, round(WIDTH * rate / RATE), round(0.2 * rate / FREQUENCY), noise)


def canny_variance(of: CrossingDetector, rate: float, noise: float, slope_factor: float = 1.0) -> float:
    """Eq 3 for the simulated edge [s^2]."""
    half = of.kernel.size // 2
    time = np.arange(-half, half + 1) / rate
    turn = 2 * np.pi * FREQUENCY * time
    edge = sensor_gain(AMPLITUDE * np.sin(turn), slope_factor) * AMPLITUDE * 2 * np.pi * FREQUENCY * np.cos(turn)
    return timing_variance(np.gradient(edge, 1 / rate), replace(of, noise_sd=noise), 1 / rate)


def lilliefors(values: Array, rng: np.random.Generator, draws: int = 2000) -> float:
    """P-value of the Kolmogorov-Smirnov test of normality with mean and variance estimated (Lilliefors 1967).

    Its null distribution depends on the number of values only and is simulated.
    """
    from scipy.stats import norm

    def distance(x: Array) -> Array:
        x = np.sort((x - x.mean(axis=-1, keepdims=True)) / x.std(axis=-1, ddof=1, keepdims=True))
        steps = np.arange(x.shape[-1] + 1) / x.shape[-1]
        below = norm.cdf(x)
        return np.maximum((steps[1:] - below).max(axis=-1), (below - steps[:-1]).max(axis=-1))

    null = distance(rng.standard_normal((draws, values.size)))
    return float((null >= distance(values)).mean())


def pooled_errors(
    of: CrossingDetector, rate: float, noise: float, rng: np.random.Generator, runs: int = 40, **options: Any
) -> Array:
    """Errors over ``runs`` short recordings, each with another phase of the clock [s]."""
    return np.concatenate([timing_errors(of, rate, noise, rng, 4, **options) for _ in range(runs)])


def variance_by_rate(factor: float, runs: int = 40) -> tuple[Array, Array]:
    """Fig 5a at one noise level: variance on crossings samples and Canny's with T^2 / 12, at every rate [s^2].

    sigma_DOG is 15 samples at every rate. As in the paper, the window scales with the rate and the Gaussian does not;
    if it did, the variance would decrease with the rate without limit.
    """
    rng, noise = np.random.default_rng(SEED), NOISE * factor
    detectors = [detector(SIGMA, rate, noise) for rate in RATES]
    variance = [
        rms(pooled_errors(d, r, noise, rng, runs, whole_samples=True)) ** 2
        for d, r in zip(detectors, RATES, strict=True)
    ]
    theory = [canny_variance(d, r, noise) + 1 / (12 * r * r) for d, r in zip(detectors, RATES, strict=True)]
    return np.array(variance), np.array(theory)


def variance_by_slope(factor: float, runs: int = 40) -> tuple[Array, Array]:
    """Fig 5b at one noise level: variance and Canny's over the slope factor [s^2]."""
    rng, noise = np.random.default_rng(SEED), NOISE * factor
    of = detector(noise=noise)
    variance = [rms(pooled_errors(of, RATE, noise, rng, runs, slope_factor=s)) ** 2 for s in SLOPES]
    return np.array(variance), np.array([canny_variance(of, RATE, noise, s) for s in SLOPES])


def results() -> Results:
    """Entries of ``results.json``; draws figs 5 and 6."""
    rng, runs = np.random.default_rng(SEED), 40
    rates = {factor: variance_by_rate(factor) for factor in (0.1, 1.0, 10.0)}
    slopes = {factor: variance_by_slope(factor) for factor in (0.1, 1.0)}
    scaled = [rms(pooled_errors(detector(SIGMA * r / RATE, r), r, NOISE, rng)) for r in (RATES[0], RATES[-1])]
    of, clean = detector(), signal(RATE, 100, rng)[0]
    noisy = clean + NOISE * rng.standard_normal(clean.size)
    crossings = find_crossings(noisy, of)
    parts = [block for block, _ in find_crossings_in_blocks(np.array_split(noisy, 400), of)]
    draw(rates, slopes)
    ratio = [variance / theory for variance, theory in (rates[0.1], slopes[0.1], slopes[1.0])]
    out = {
        "fig5a.optimum_hz": entry(1.25e6, RATES[rates[0.1][0].argmin()], runs, SEED, noise_factor=0.1),
        "fig5a.optimum_hz_at_the_stated_noise": entry(1.25e6, RATES[rates[1.0][0].argmin()], runs, SEED),
        "fig5a.optimum_hz_at_ten_times_the_noise": entry(1.25e6, RATES[rates[10.0][0].argmin()], runs, SEED),
        "fig5a.variance_gain_50khz_to_5mhz_sigma_scaled": entry(None, (scaled[0] / scaled[1]) ** 2, runs, SEED),
        "fig5b.variance_fall_over_slopes": entry(None, slopes[1.0][0][0] / slopes[1.0][0][-1], runs, SEED),
        "eq3.median_ratio_to_simulation": entry(1.0, float(np.median(np.concatenate(ratio))), runs, SEED),
        "fig7.lilliefors_p_simulated": entry(0.05, lilliefors(pooled_errors(of, RATE, NOISE, rng), rng), runs, SEED),
        "causal.latency_ms": entry(None, 1e3 * of.latency / RATE, 1, SEED),
        "causal.largest_difference_samples": entry(
            0.0, np.abs(np.concatenate(parts) - crossings).max(), crossings.size, SEED
        ),
    }
    return {f"chen2019.{key}": value for key, value in out.items()}


def draw(rates: Mapping[float, tuple[Array, Array]], slopes: Mapping[float, tuple[Array, Array]]) -> None:
    with figure("chen2019_fig5", columns=2, size=(9.0, 3.4)) as axes:
        for drawn, x, curves in ((axes[0, 0], RATES / 1e3, rates), (axes[0, 1], SLOPES, slopes)):
            for factor, (variance, theory) in curves.items():
                (line,) = drawn.loglog(x, variance, "o", ms=4, label=f"noise x {factor:g}")
                drawn.loglog(x, theory, color=line.get_color(), lw=0.8)
            drawn.set(ylabel="variance of the crossing's time [s$^2$]")
            drawn.legend(fontsize=7)
        axes[0, 0].set(xlabel="sampling rate [kHz]", ylim=(1e-14, 1e-8))
        axes[0, 1].set(xlabel="slope of the sensor's gain, $N_\\theta$ relative to the device's")
        axes[0, 1].set_xticks(SLOPES, [f"{slope:g}" for slope in SLOPES])
        axes[0, 1].minorticks_off()
    theta = np.linspace(-0.15, 0.15, 301)
    with figure("chen2019_fig6", columns=2, size=(9.0, 3.0)) as axes:
        for factor in SLOPES:
            h = sensor_gain(theta, factor)
            axes[0, 0].plot(theta, -np.cumsum(h) * (theta[1] - theta[0]) * 1e4, label=f"{factor:g}")
            axes[0, 1].plot(theta, h)
        axes[0, 0].set(xlabel="angle [rad]", ylabel="capacitance, shifted [pF]")
        axes[0, 1].set(xlabel="angle [rad]", ylabel="sensor gain [V s/rad]")
        axes[0, 0].legend(title="$N_\\theta$", fontsize=7)
