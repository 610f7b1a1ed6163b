"""Figures of the diagnosis report: effects in their own variables, waveforms, residuals, detectability."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from estimation.device_fit.posterior import Waveform
from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA, Detectability
from recon.report.effect_curve import EffectCurve
from recon.report.figures import figure_uri, new_figure, use_plain_ticks
from recon.report.page import Figure
from scanner.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BEFORE, AFTER, MEASURED = "#c8553d", "#2f6fb0", "#333333"
"""Colours of the nominal device, of the device with the findings and of measured samples."""

PAIR = ((BEFORE, "nominal device, values fitted"), (AFTER, "with the findings"))
"""Colour and name of the two fits. The device that is written may hold less than the second one: only what a device
file can state, and nothing that predicts worse."""

TIME_BINS = 120
"""Bins of a residual over time: enough to resolve a drift, few enough for the noise of a bin to be small."""

SPECTRUM_BINS = 400
"""Bins of a spectrum, about as many as its figure has columns."""


def one_panel(draw: Callable[[Axes], None], caption: str, height: float = 3.2) -> Figure:
    """A figure of one panel."""
    drawing, axes = new_figure(size=(6.0, height))
    draw(axes[0, 0])
    return Figure(figure_uri(drawing), caption)


def effect_figure(curve: EffectCurve, name: str) -> Figure:
    """An effect in its own variables with its 95 % band."""

    def draw(axes: Axes) -> None:
        axes.fill_between(curve.x, *curve.band, alpha=0.25, color=AFTER, lw=0, label="95 % band")
        axes.plot(curve.x, curve.y, color=AFTER, label="fitted")
        axes.axhline(0.0, color="#888", lw=0.6)
        axes.set(xlabel=curve.x_label, ylabel=curve.y_label, xscale="log" if curve.logarithmic else "linear")
        axes.legend(frameon=False)

    return one_panel(draw, f"{name}: {curve.y_label.split(' (')[0]} over {curve.x_label.split(' (')[0]}")


def measured_curve_figure(curve: Any) -> Figure:
    """The residual curve of an effect that is not in the catalogue, as diagnosis.json has it."""
    x, y, sd = np.array(curve["points"], float).T

    def draw(axes: Axes) -> None:
        axes.fill_between(x, y - 2 * sd, y + 2 * sd, alpha=0.25, color=AFTER, lw=0, label="95 % band")
        axes.plot(x, y, color=AFTER, label="measured")
        axes.axhline(0.0, color="#888", lw=0.6)
        axes.set(xlabel=curve["x"], ylabel=f"{curve['y']} ({curve['unit']})")
        axes.legend(frameon=False)

    return one_panel(draw, "measured curve of the unknown effect")


def waveform_figure(shown: Waveform, name: str, unit: str) -> Figure:
    """Measured and simulated waveform, before and after, and the differences below.

    The name contains that of the recording, in which ``$`` begins no formula.
    """
    drawing, axes = new_figure(2, 1, (6.0, 4.2))
    top, bottom = axes[:, 0]
    time = 1e3 * shown.time
    top.plot(time, shown.measured, ".", ms=3, color=MEASURED, label="measured")
    for values, (colour, label) in zip((shown.before, shown.after), PAIR, strict=True):
        top.plot(time, values, color=colour, lw=1.2, label=label)
        bottom.plot(time, shown.measured - values, color=colour, lw=1.0, label=label)
    top.set_ylabel(f"{name} ({unit})", parse_math=False)
    top.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8)
    bottom.axhline(0.0, color="#888", lw=0.6)
    bottom.set(xlabel="time (ms)", ylabel=f"measured − simulated ({unit})")
    return Figure(figure_uri(drawing), f"{name}: measured and simulated, where the nominal device is most wrong")


def residual_over_time_figure(name: str, time: Array, pair: Sequence[Array]) -> Figure:
    """Root mean square of the whitened residuals in time bins."""

    def draw(axes: Axes) -> None:
        bins = [b for b in np.array_split(np.arange(time.size), TIME_BINS) if b.size]
        for values, (colour, label) in zip(pair, PAIR, strict=True):
            rms = [np.sqrt(np.mean(values[b] ** 2)) for b in bins]
            axes.plot([1e3 * time[b].mean() for b in bins], rms, color=colour, label=label)
        axes.axhline(1.0, color="#888", lw=0.6)
        axes.set(xlabel="time (ms)", ylabel="residual, rms (noise = 1)", yscale="log")
        use_plain_ticks(axes.yaxis)
        axes.legend(frameon=False)

    return one_panel(draw, f"{name}: residual over time")


def residual_spectrum_figure(name: str, frequency: Array, pair: Sequence[Array]) -> Figure:
    """Largest power of the whitened residuals in frequency bins."""

    def draw(axes: Axes) -> None:
        for values, (colour, label) in zip(pair, PAIR, strict=True):
            power = np.abs(np.fft.rfft(values)) ** 2 / values.size
            bins = [b for b in np.array_split(np.arange(1, power.size), SPECTRUM_BINS) if b.size]
            largest = [power[b].max() for b in bins]
            axes.plot([frequency[b].mean() / 1e3 for b in bins], largest, color=colour, label=label, lw=1)
        axes.set(xlabel="frequency (kHz)", ylabel="residual power, maximum (noise = 1)", yscale="log")
        axes.legend(frameon=False)

    return one_panel(draw, f"{name}: spectrum of the residual")


def portrait_figure(before: Array, after: Array, caption: str) -> Figure:
    """Residuals without and with the findings over angle and rate of the mirror."""
    drawing, axes = new_figure(1, 2, (6.0, 3.0))
    largest = max(float(np.nanmax(before)), 2.0)
    for panel, values, (_, name) in zip(axes[0], (before, after), PAIR, strict=True):
        image = panel.imshow(values, origin="lower", extent=(-1, 1, -1, 1), norm="log", vmin=0.5, vmax=largest)
        panel.set(title=name, xlabel="angle / largest angle", xticks=(-1, 0, 1), yticks=(-1, 0, 1))
    axes[0, 0].set_ylabel("rate / largest rate")
    bar = drawing.colorbar(image, ax=axes, label="residual, rms (noise = 1)", shrink=0.8)
    ticks = [tick for tick in (0.5, 1, 2, 5, 10, 20, 50, 100, 1000, 1e4) if tick <= largest]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    return Figure(figure_uri(drawing), caption)


def detectability_figure(effects: Sequence[Detectability]) -> Figure:
    """Size of every effect and its distance to its nearest confounder."""

    def draw(axes: Axes) -> None:
        place = np.arange(len(effects))
        axes.barh(place, [max(e.sigma, 0.1) for e in effects], color=AFTER, alpha=0.35, label="detectability")
        distances = [max(e.distance, 0.1) for e in effects]
        axes.barh(place, distances, color=AFTER, height=0.4, label="after a fit of the nearest confounder")
        axes.axvline(DISCRIMINATION_SIGMA, color=BEFORE, lw=1, label=f"needed: {DISCRIMINATION_SIGMA:g} σ")
        axes.set_yticks(place, [f"{e.candidate.key}  (as {e.nearest.key})" for e in effects], fontsize=8)
        axes.set_ylim(len(effects) - 0.4, -0.6)
        axes.set(xscale="log", xlabel="standard deviations (σ), for an effect of typical size")
        axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8)

    caption = "every effect: detectability, and the part that remains if its nearest confounder (in brackets) is fitted"
    return one_panel(draw, caption, height=1.4 + 0.22 * len(effects))
