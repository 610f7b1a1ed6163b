"""The table of a measured law holds in the range of the motion to which it was fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.candidate_terms.curves import CURVE_TERMS
from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS
from estimation.device_fit.data import Run, prepare_run
from estimation.device_fit.fit import Fit, Likelihood, fit_model, linearise_at
from estimation.device_fit.initial import flat_whiteners
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.discrepancy_law import correction_curve, measured_law_table
from estimation.diagnosis.pruning import with_free_parameters
from scanner.device import Axis, Device
from scanner.forward_model import DriveInput, simulate_axis
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position
from scanner.terms.measured_law import added, beyond, measured_law


def test_the_range_of_a_measured_law_contains_the_whole_motion() -> None:
    """A decay is larger than its 99 % quantile during the first periods."""
    rate, resonance = 2e4, 2 * np.pi * 1e3
    axis = Axis(Mechanics(1.0, 100.0, resonance**2), readout=Position(1.0, 1e-3), name="x")
    time = np.arange(4000) / rate
    decay = 0.1 * np.exp(-50.0 * time) * np.cos(resonance * time)
    device = Device("beam", {"x": axis})
    measured = decay + 1e-3 * np.random.default_rng(1).normal(size=time.size)
    run = prepare_run(Recording.from_arrays({"sense_x": (measured, "V", rate, 0.0)}, device), device)
    model = Model([run], device, [Candidate(DISCREPANCY_TERMS["free-mechanics"], "x", "sense")])
    x = np.zeros(len(model.parameters))
    x[model.indices("start")] = 0.1 / run.scales["x"].amplitude, 0.0
    table = measured_law_table(fit_model(Likelihood([run], flat_whiteners(model)), model, x))
    assert table is not None
    assert run.scales["x"].amplitude < 0.098
    assert table["upper"] == pytest.approx([0.1, 0.1 * resonance], rel=0.02)
    quadrature = 0.1 * np.exp(-50.0 * time) * np.sin(resonance * time)
    assert beyond(table, [decay, -resonance * quadrature]) < 0.01


def test_the_table_of_a_readout_follows_a_fold_over_signals_that_the_recording_does_not_show() -> None:
    """Above 1.05 V the recorded signal falls; the law is one of the signal before it, which reaches 1.4 V.

    The error of a straight piece of length h is at most h² max |y''| / 8.
    """
    rate, resonance = 1e5, 2 * np.pi * 1e3
    mechanics, driven = Mechanics(1.0, 60.0, resonance**2), Drive("linear", 90.0 * resonance)
    axis = Axis(mechanics, drive=driven, readout=Position(1.0, 1e-3), name="x")
    device = Device("mirror", {"x": axis})
    time = np.arange(8000) / rate
    drive = (0.2 + 1.2 * time / time[-1]) * np.sin(resonance * time)
    between = (drive + np.append(drive[1:], drive[-1])) / 2.0
    steps = np.stack([drive[:-1], between[:-1], drive[1:]], axis=1)
    angle = simulate_axis(axis, (), DriveInput(steps, 1.0 / rate), (0.0, 0.0)).angle
    folded = np.sin(1.5 * angle) / 1.5
    measured = folded + 1e-3 * np.random.default_rng(2).normal(size=time.size)
    channels = {"drive_x": (drive, "V", rate, 0.0), "sense_x": (measured, "V", rate, 0.0)}
    run = prepare_run(Recording.from_arrays(channels, device), device)
    model = Model([run], device, [Candidate(CURVE_TERMS["free-readout-curve"], "x", "sense")])
    fit = fit_model(Likelihood([run], flat_whiteners(model)), model, np.zeros(len(model.parameters)))
    table = measured_law_table(fit)
    assert table is not None
    improved = Device("mirror", {"x": replace(model.nominal("x", fit.x), terms={"measured-law": table})})
    stated = Model([run], improved, [])
    start = [spec.kind == "start" for spec in model.parameters]
    x = np.zeros(len(stated.parameters))
    x[stated.indices("start")] = fit.x[start]
    (predicted,) = stated.full_signals(x)
    assert np.std(predicted - folded) < np.diff(table["knots"]).max() ** 2 * 1.5 / 8.0
    assert table["upper"][0] > 1.8 * folded.max()
    curve = correction_curve(fit)
    signal, error, _ = np.array(curve["points"]).T * run.scales["x"].sense_rms
    assert np.allclose(signal[[0, -1]], np.array([table["lower"][0], table["upper"][0]]) - table["centre"][0])
    assert np.allclose(error, added(signal + table["centre"][0], measured_law(table)[1]), atol=1e-9)


def driven_run(size: float = 1.0, seed: int = 4) -> Run:
    """A tone at half the resonance and its response."""
    rate, resonance = 5e4, 2 * np.pi * 1e3
    time = np.arange(5000) / rate
    drive = size * np.sin(0.5 * resonance * time)
    sensed = 1.333 * drive + 1e-3 * np.random.default_rng(seed).standard_normal(time.size)
    channels = {"drive_x": (drive, "V", rate, 0.0), "sense_x": (sensed, "V", rate, 0.0)}
    return prepare_run(Recording.from_arrays(channels, STAGE), STAGE)


RESONANCE = 2 * np.pi * 1e3
STAGE = Device(
    "stage",
    {
        "x": Axis(
            Mechanics(1.0, RESONANCE, RESONANCE**2),
            drive=Drive("linear", RESONANCE**2),
            readout=Position(1.0, 1e-3),
            name="x",
        )
    },
)


def fit_of(effect: str, names: list[str], *runs: Run) -> Fit:
    """A fit of some parameters of a discrepancy term, each at its natural size."""
    model = Model(runs, STAGE, [with_free_parameters(Candidate(DISCREPANCY_TERMS[effect], "x", "sense"), names)])
    x = np.zeros(len(model.parameters))
    x[model.indices("term")] = 1.0
    return linearise_at(Likelihood(runs, flat_whiteners(model)), model, x)


@pytest.mark.parametrize(
    ("effect", "name"), [("free-mechanics", "f21"), ("free-stiffness", "b3"), ("free-drive", "v4")]
)
def test_the_curve_of_a_correction_shows_what_was_fitted(effect: str, name: str) -> None:
    curve = correction_curve(fit_of(effect, [name], driven_run()))
    assert curve is not None
    assert max(abs(value) for _, value, _ in curve["points"]) > 0.0


def test_a_correction_with_memory_alone_has_no_curve_and_no_table() -> None:
    fit = fit_of("free-timing", ["m0", "m1"], driven_run())
    assert correction_curve(fit) is None
    assert measured_law_table(fit) is None
    assert measured_law_table(fit_of("free-drive", ["g1"], driven_run())) is None


def test_a_table_covers_all_recordings_in_any_order() -> None:
    weak, strong = driven_run(0.3), driven_run(1.0)
    tables = [measured_law_table(fit_of("free-drive", ["v3"], *runs)) for runs in ((weak, strong), (strong, weak))]
    for table in tables:
        assert table is not None
        assert table["upper"][0] - table["centre"][0] == pytest.approx(1.0, rel=1e-2)
    assert tables[0]["coefficients"] == pytest.approx(tables[1]["coefficients"])  # type: ignore[index]
