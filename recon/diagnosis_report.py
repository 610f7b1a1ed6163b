"""The report of a diagnosis: at a glance where, what, how sure and how much better."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from estimation.mismatch.diagnosis import Diagnosis, Finding
from estimation.mismatch.search import Round, Search
from estimation.mismatch.sensitivity import APART, Visible, visibility
from recon import views
from recon.evidence import AFTER, BEFORE, HALF_LINE, draw_law, draw_phase_cost, law, phase_cost, portrait
from recon.report import Figure, Section, Table, render
from scanner.terms import catalogue

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def diagnosis_report(diagnosis: Diagnosis, names: Sequence[str]) -> str:
    """One diagnosis as a page."""
    lead = f"{', '.join(names)}: {diagnosis.verdict}. {_headline(diagnosis)}"
    sections = [
        _overview(diagnosis),
        *(_finding_section(f, i, diagnosis.search) for i, f in enumerate(diagnosis.findings)),
    ]
    if diagnosis.search is not None:
        sections += _motion_sections(diagnosis, diagnosis.search)
    sections += [_optics(table) for table in diagnosis.optics]
    notes = [diagnosis.unexplained] if diagnosis.unexplained else []
    return render("Diagnosis", lead, sections, notes)


def _headline(diagnosis: Diagnosis) -> str:
    if not diagnosis.findings:
        return "No missing physics: what differs lies within the noise and the tolerances of the nominal values."
    return " ".join(
        f"{f.axis} {f.stage}: {f.effect} ({f.probability:.1%}), held-out chi-square {f.heldout['before']:.3g} → "
        f"{f.heldout['after']:.3g}."
        for f in diagnosis.findings
    )


def _overview(diagnosis: Diagnosis) -> Section:
    rows = [
        [
            f.effect,
            f"{f.axis} {f.stage}",
            f"{f.probability:.2%}",
            f"{f.heldout['before']:.3g} → {f.heldout['after']:.3g}",
        ]
        for f in diagnosis.findings
    ]
    if not rows:
        return Section("What was found", "Nothing is missing.")
    return Section("What was found", "", Table(["effect", "where", "probability", "held-out χ²"], rows))


def _finding_section(finding: Finding, index: int, found: Search | None) -> Section:
    text = f"{finding.equation}. {finding.where}. Source: {finding.source}."
    if finding.advice:
        text += f" To tell it from its rivals: {finding.advice}."
    rows = [[p.name, f"{p.value:.5g}", f"{p.ci95[0]:.5g} … {p.ci95[1]:.5g}", p.unit] for p in finding.parameters] + [
        [
            f"rival: {r.effect}",
            f"{r.probability:.2%}" if r.probability > 1e-4 else "fits as well, with more numbers",
            "" if r.distance is None else f"{r.distance:.1f} σ away",
            "",
        ]
        for r in finding.rivals
    ]
    figures = [_curve_figure(finding.curve)] if finding.curve and "columns" in finding.curve else []
    if found is not None:
        figures += _law_figures(finding, found)
    table = Table(["", "value", "95 %", "unit"], rows) if rows else None
    return Section(f"{index + 1}. {finding.effect}", text, table, figures, least="26rem")


def _law_figures(finding: Finding, found: Search) -> list[Figure]:
    named = (finding.axis, finding.effect, finding.channel)
    terms = [c for c in found.final.model.candidates if (c.axis, c.term.effect, c.channel) == named]
    laws = [shown for each in terms if (shown := law(found.final, each)) is not None]
    return [_figure(draw_law(each), f"{finding.effect}: the law along the motion, with its 95 % band") for each in laws]


def _curve_figure(curve: Any) -> Figure:
    x, y, sd = np.array(curve["points"], float).T

    def draw(axes: Axes) -> None:
        axes.fill_between(x, y - 2 * sd, y + 2 * sd, alpha=0.25, color=AFTER, lw=0)
        axes.plot(x, y, color=AFTER)
        axes.set(xlabel=curve["x"], ylabel=f"{curve['y']} ({curve['unit']})")

    return _figure(draw, f"the law that the free correction measured, with its 95 % band; in short: {curve['formula']}")


def _motion_sections(diagnosis: Diagnosis, found: Search) -> list[Section]:
    """From the drive to the readout: what was compared with a prediction."""
    sections = [_residuals(found), _portraits(found)]
    if found.rounds:
        sections.insert(0, _cost(found))
        text = "Distances in -2 log evidence: 10 over nothing is certain, a lead of 6 over the next names alone."
        rows = evidence_table(found.rounds)
        sections.append(Section("Candidates", text, Table(["effect", "behind", "over nothing"], rows)))
    told = visibility(found.comparison, found.final, catalogue().values())
    return [*sections, _visible(told), _nominal(diagnosis)]


def _cost(found: Search) -> Section:
    """What a picture would have had of the missing physics."""
    rows, figures = [], []
    for r, run in enumerate(found.comparison.runs):
        for axis in run.inputs:
            cost = phase_cost(found.nominal, found.final, axis, r)
            if cost is not None:
                before, after = cost.pixels(cost.before), cost.pixels(cost.after)
                rows.append([f"{run.name}: {axis}", f"{before:.3g}", f"{after:.2g}"])
                figures.append(_figure(draw_phase_cost(cost), f"{run.name}, axis {axis}: blur at the centre of a line"))
    text = (
        f"A phase error δφ moves the centre of a line by m δφ, m = {HALF_LINE} in a picture of {2 * HALF_LINE} pixels, "
        "and p = 1 pixel is tolerated. Before: the motion that the nominal device, fitted as well as it can be, tells "
        "without a sense signal to follow, against the improved one. After: how sure the improved one is."
    )
    if not rows:
        return Section("What it costs a picture", "The axis follows its drive: its motion has no phase of its own.")
    table = Table(["rms, pixels", "before", "after (95 %)"], rows)
    return Section("What it costs a picture", text, table, figures, least="24rem")


def _portraits(found: Search) -> Section:
    """Where in the motion the residual stands."""
    figures = []
    pair = (found.nominal.residual, found.final.residual)
    for r, run in enumerate(found.comparison.runs):
        for channel, output in enumerate(run.outputs):
            before, after = portrait(found.comparison, found.final, pair, r, channel)
            drawing, axes = views.figure(1, 2, (6.0, 3.0))
            largest = max(float(np.nanmax(before)), 2.0)
            for each, values, name in zip(axes[0], (before, after), ("nominal", "improved"), strict=True):
                image = each.imshow(values, origin="lower", extent=(-1, 1, -1, 1), norm="log", vmin=0.5, vmax=largest)
                each.set(title=name, xlabel="angle / largest", ylabel="rate / largest")
            drawing.colorbar(image, ax=axes, label="rms residual / noise", shrink=0.8)
            caption = f"{run.name}: {output.name}, residual over angle and rate of axis {output.axes[0]}"
            figures.append(Figure(views.figure_uri(drawing), caption))
    return Section("Where in the motion", "", figures=figures, least="24rem")


def _optics(table: Mapping[str, Any]) -> Section:
    """What the picture of one recording can tell of the optics."""
    rows = [
        [f"{e['effect']}, {e['axis']}", f"{e['sigma']:.1f}", "told" if e["told"] else "this recording cannot tell"]
        for e in table["effects"]
    ]
    text = (
        f"{table['recording']}: no picture is known beforehand, so samples of one place must agree, whenever and "
        "whichever way the beam passed. Size of every effect of natural size, in standard deviations. A field that "
        "bends, or a swing that is wrong, changes every picture alike: a known target is needed."
    )
    return Section("Optics", text, Table(["effect", "σ", ""], rows))


def _residuals(found: Search) -> Section:
    figures = []
    first = 0
    for run, whiteners in zip(found.comparison.runs, found.comparison.whiteners, strict=True):
        for output, whiten in zip(run.outputs, whiteners, strict=True):
            part = slice(first, first + whiten.samples)
            first += whiten.samples
            pair = [found.nominal.residual[part], found.final.residual[part]]
            frequency = np.arange(whiten.psd.size) / (output.data.size * output.step)
            figures.append(_time_figure(f"{run.name}: {output.name}", whiten.time * run.duration, pair))
            figures.append(_spectrum_figure(f"{run.name}: {output.name}", frequency, pair))
    text = "Whitened residuals of the nominal device and of the improved one: noise alone has a deviation of 1."
    return Section("Before and after", text, figures=figures, least="24rem")


def _time_figure(name: str, time: np.ndarray, pair: Sequence[np.ndarray]) -> Figure:
    def draw(axes: Axes) -> None:
        slots = np.array_split(np.arange(time.size), 120)
        for values, colour, label in zip(pair, (BEFORE, AFTER), ("nominal", "improved"), strict=True):
            axes.plot(
                [1e3 * time[s].mean() for s in slots],
                [np.sqrt(np.mean(values[s] ** 2)) for s in slots],
                color=colour, label=label,
            )  # fmt: skip
        axes.set(xlabel="time (ms)", ylabel="rms residual / noise", yscale="log")
        axes.legend(frameon=False)

    return _figure(draw, f"{name}: residual over time")


def _spectrum_figure(name: str, frequency: np.ndarray, pair: Sequence[np.ndarray]) -> Figure:
    def draw(axes: Axes) -> None:
        for values, colour, label in zip(pair, (BEFORE, AFTER), ("nominal", "improved"), strict=True):
            power = np.abs(np.fft.rfft(values)) ** 2 / values.size
            slots = [s for s in np.array_split(np.arange(1, power.size), 400) if s.size]
            axes.plot(
                [frequency[s].mean() / 1e3 for s in slots],
                [power[s].max() for s in slots],
                color=colour,
                label=label,
                lw=1,
            )
        axes.set(xlabel="frequency (kHz)", ylabel="power / noise, largest bin", yscale="log")
        axes.legend(frameon=False)

    return _figure(draw, f"{name}: spectrum of the residual")


def _nominal(diagnosis: Diagnosis) -> Section:
    rows = [[name, f"{value['pull']:+.2f}"] for name, value in diagnosis.nominal.items()]
    text = "How far every nominal value had to move, in units of its tolerance."
    return Section("Nominal values", text, Table(["value", "pull"], rows))


def plan_report(plan: Mapping[str, Any], told: Sequence[Visible]) -> str:
    """What planned excitations could tell, as a page; ``plan`` is the content of plan.json."""
    names = ", ".join(each["name"] for each in plan["excitations"])
    alone = sum(each.distance >= APART for each in told)
    lead = f"{plan['device']} under {names}: {alone} of {len(told)} effects of their natural size could be named alone."
    runs = [
        [each["name"], f"{1e3 * each['duration']:.4g}", ", ".join(each["channels"])] for each in plan["excitations"]
    ]
    ties = [
        [each["effect"], f"{each['axis']} {each['stage']}", f"{each['sigma']:.3g}", f"{each['distance']:.3g}",
         each["nearest"], each["advice"] or "another excitation, or a further channel"]
        for each in plan["effects"] if each["distance"] < APART
    ]  # fmt: skip
    sections = [Section("Planned", "", Table(["excitation", "ms", "channels"], runs)), _visible(told)]
    if ties:
        head = ["effect", "where", "σ", "distance σ", "look-alike", "what would tell them apart"]
        sections.append(Section("What would stay open", "", Table(head, ties)))
    return render("What a measurement can tell", lead, sections)


def _visible(told: Sequence[Visible]) -> Section:
    """The map of what recordings can tell, as a picture."""

    def draw(axes: Axes) -> None:
        place = np.arange(len(told))
        axes.barh(place, [max(each.sigma, 0.1) for each in told], color=AFTER, alpha=0.35, label="size")
        axes.barh(place, [max(each.distance, 0.1) for each in told], color=AFTER, height=0.4, label="distance")
        axes.axvline(APART, color=BEFORE, lw=1)
        axes.set_yticks(place, [f"{each.candidate.key} | {each.nearest.key}" for each in told], fontsize=7)
        axes.set_ylim(len(told) - 0.4, -0.6)
        axes.set(xscale="log", xlabel="σ, for an effect of its natural size")
        axes.legend(frameon=False, loc="lower right")

    text = (
        "Every effect of its natural size, and what is left of it when its nearest look-alike (named behind it) "
        f"imitates it as well as it can. Beyond {APART} σ it is named alone; below, it needs a further measurement."
    )
    figure = _figure(
        draw, "size of every effect, and distance to its nearest look-alike", height=1.0 + 0.18 * len(told)
    )
    return Section("What these recordings can tell", text, figures=[figure], least="34rem")


def evidence_table(rounds: Sequence[Round]) -> list[list[str]]:
    """Every effect found and its rivals: how far each lies behind in -2 log evidence."""
    rows = []
    for each in rounds:
        rows.append([each.candidate.key, "0", f"{each.before.evidence - each.after.evidence:.1f}"])
        rows += [[lead.candidate.key, f"{lead.behind:.1f}", ""] for lead in each.leads]
    return rows


def _figure(draw: Callable[[Axes], None], caption: str, height: float = 3.2) -> Figure:
    drawing, axes = views.figure(size=(6.0, height))
    draw(axes[0, 0])
    return Figure(views.figure_uri(drawing), caption)
