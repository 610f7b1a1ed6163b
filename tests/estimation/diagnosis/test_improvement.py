"""The improved device: what a recording determines beside the findings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from estimation.diagnosis import improvement
from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.improvement import _with_fitted_offset, remaining_offset, without_contradicted
from estimation.diagnosis.selection import SelectionResult, SelectionStep
from scanner.active_terms import stated_terms
from scanner.device import Axis, Device
from scanner.forward_model import DriveInput, simulate_axis
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

SAMPLE_RATE_HZ = 4000.0
NOISE_SD = 2e-4  # [V]
RESONANCE = 2 * np.pi * 120.0
STAGE = Axis(
    Mechanics(1.0 / RESONANCE**2, 0.1 / RESONANCE, 1.0),
    drive=Drive("linear", 1.0),
    readout=Position(1.0, NOISE_SD),
    name="x",
)


def recording_with_offset(offset: float, seed: int) -> Recording:
    """A stage that is driven by tones, read by a position sensor whose output at rest is not the stated one."""
    rng = np.random.default_rng(seed)
    time = np.arange(2401) / (2.0 * SAMPLE_RATE_HZ)  # at the samples and between them
    phases = rng.uniform(0.0, 2 * np.pi, 12)
    fine = sum(3e-3 * np.cos(2 * np.pi * 15.0 * j * time + phase) for j, phase in enumerate(phases, 1))
    drive = fine[::2]
    inputs = DriveInput(np.stack([drive[:-1], fine[1::2], drive[1:]], axis=1), 1 / SAMPLE_RATE_HZ)
    angle = simulate_axis(STAGE, stated_terms(STAGE), inputs, (0.0, 0.0)).angle
    sensed = angle + offset + NOISE_SD * rng.standard_normal(angle.size)
    channels = {"drive_x": (drive, "V", SAMPLE_RATE_HZ, 0.0), "sense_x": (sensed, "V", SAMPLE_RATE_HZ, 0.0)}
    return Recording.from_arrays(channels, Device("stage", {"x": STAGE}))


@pytest.mark.slow
def test_the_offset_of_a_position_sensor_is_part_of_the_improved_device() -> None:
    offsets = (1.0e-3, 1.2e-3)
    diagnosis = diagnose([recording_with_offset(offset, seed) for seed, offset in enumerate(offsets)])
    assert diagnosis.findings == ()
    readout = diagnosis.device.axis("x").readout
    assert isinstance(readout, Position)
    assert readout.offset == pytest.approx(np.mean(offsets), abs=4 * NOISE_SD / np.sqrt(2400))
    loop = diagnosis.open_loop["sense_x"]
    assert loop["improved"]["rmse"] < 1.2 * NOISE_SD < 4 * NOISE_SD < loop["nominal"]["rmse"]


@pytest.mark.parametrize(("signal", "offset"), [(0.0, 0.02), (np.nan, 0.0), (1e200, 0.0)])
def test_a_constant_that_slow_noise_hides_from_the_fit_is_part_of_the_offset(signal: float, offset: float) -> None:
    """Of a trajectory that has diverged, no offset follows."""
    residual = 0.02 + 3e-3 * np.random.default_rng(4).standard_normal(4000)
    output = SimpleNamespace(name="sense_x", kind="sense", axes=("x",), data=residual, guard=(10, 10))
    model = SimpleNamespace(
        runs=[SimpleNamespace(outputs=(output,))],
        outputs=lambda x: [[np.full(4000, signal)]],
        index=lambda *key: 0,
        additive_terms=lambda output: {"offset": np.full(4000, 1.0)},
    )
    fit = SimpleNamespace(model=model, x=np.zeros(1))  # the fit has left the constant in the residual
    readout = _with_fitted_offset(fit, "x", STAGE).readout  # type: ignore[arg-type]
    assert isinstance(readout, Position)
    assert readout.offset == pytest.approx(offset, rel=0.02)


def test_the_mean_of_a_random_walk_is_no_offset() -> None:
    rng = np.random.default_rng(5)
    walks = np.cumsum(rng.standard_normal((40, 2000)), axis=1) / 2000**0.5
    walks -= walks.mean(axis=1, keepdims=True) - rng.normal(0.0, 0.1, (40, 1))
    assert all(abs(remaining_offset(walk)) < 0.5 * abs(walk.mean()) + 0.01 for walk in walks)


def fit_with_residual(size: float) -> Any:
    """A fit with 100 held-out samples that it misses by ``size`` [sigma]."""
    return SimpleNamespace(residual=np.full(100, size), validation_rows=np.ones(100, bool))


@pytest.mark.parametrize(("without_imitation", "kept"), [(1.0, 2), (1.05, 2), (0.8, 1)])
def test_a_finding_that_held_out_samples_contradict_is_rejected(
    without_imitation: float, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    final, reduced = fit_with_residual(1.0), fit_with_residual(without_imitation)
    monkeypatch.setattr(improvement, "refit_without", lambda likelihood, fit, candidate: reduced)
    before = {"true": fit_with_residual(5.0), "imitation": reduced}
    candidates = {name: SimpleNamespace(term=SimpleNamespace(free_parameters=("size",)), name=name) for name in before}
    steps = tuple(SelectionStep(cast(Any, candidates[name]), fit, final, ()) for name, fit in before.items())
    result = without_contradicted(SelectionResult(cast(Any, None), fit_with_residual(9.0), final, steps))
    assert [step.candidate.name for step in result.steps] == ["true", "imitation"][:kept]  # type: ignore[attr-defined]
    assert result.final is (final if kept == 2 else reduced)


@pytest.mark.parametrize(
    ("explained", "absorbed", "expected"),
    [(130.0, False, True), (70.0, False, False), (70.0, True, True)],
)
def test_findings_have_to_explain_more_than_they_leave(
    explained: float, absorbed: bool, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They leave 100 above the noise. Nothing follows where nominal values have absorbed a part of the misfit."""
    monkeypatch.setattr(improvement, "nominal_values_are_improbable", lambda fit: absorbed)
    final = SimpleNamespace(chi2=600.0, penalty=2.0, rows=np.ones(500, bool))
    nominal = SimpleNamespace(chi2=602.0 + explained, penalty=0.0)
    result = SelectionResult(cast(Any, None), cast(Any, nominal), cast(Any, final))
    assert improvement._explain_most(result) == expected
