"""The steps of ``examples/missing_physics.py`` without its search: a term in the device sharpens the picture."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import linregress

from estimation.candidate_terms.screening import all_candidates
from estimation.device_fit.data import prepare_run
from estimation.device_fit.model import Model
from phantoms.experiment import Experiment, simulate_experiment
from recon.evaluation import truth_from_simulation
from recon.pipeline import reconstruct
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from scanner import devices
from scanner.terms import catalogue

EXAMPLE = runpy.run_path(str(Path(__file__).parent.parent.parent / "examples" / "missing_physics.py"))


@pytest.fixture(scope="module")
def calibration():  # type: ignore[no-untyped-def]
    nominal = devices.load("imaging")
    return EXAMPLE["calibration"](EXAMPLE["with_terms"](nominal, EXAMPLE["UNMODELLED"]), nominal, 0.002)


@pytest.mark.slow
def test_the_term_in_the_device_file_sharpens_the_same_scan() -> None:
    nominal = devices.load("imaging")
    true = EXAMPLE["with_terms"](nominal, EXAMPLE["UNMODELLED"])
    scan, truth = simulate_experiment(Experiment(true, duration=0.012), 4, nominal=nominal)
    results = [
        reconstruct(
            replace(scan, device_toml=device.to_toml()),
            Options(pixels=(200, 200), sense_only=True),
            truth_from_simulation(truth),
            quiet=True,
        )
        for device in (nominal, true)
    ]
    before, after = ({a: np.degrees(e.phase_rmse) for a, e in each.evaluation.items()} for each in results)
    assert before["x"] > 3.0
    assert max(after.values()) < 0.03
    picture = [summarise(each)["picture"]["rms"] for each in results]
    assert picture[1] < 0.3 * picture[0]


def test_terms_of_a_shared_readout_are_candidates_once(calibration) -> None:  # type: ignore[no-untyped-def]
    nominal = devices.load("imaging")
    model = Model([prepare_run(calibration, nominal)], nominal)
    keys = [each.key for each in all_candidates(model, catalogue().values())]
    assert "x.readout-lag" in keys
    assert "y.readout-lag" not in keys
    assert {"y.cubic-stiffness", "y.feedthrough", "y.channel-delay:angle", "y.comb-offset"} <= set(keys)


@pytest.mark.slow
def test_the_demodulator_lag_changes_over_a_sweep() -> None:
    example = runpy.run_path(str(Path(__file__).parent.parent.parent / "examples" / "sweep_lag.py"))
    true = devices.load("chen2020-driven")
    nominal = example["without_filters"](true)
    axis = nominal.axis("x")
    improved = replace(nominal, axes={"x": replace(axis, terms={"demodulator-lag": {"f_c": 40950.0}})})
    sweep = np.arange(31400.0, 31541.0, 8.0)
    lag = example["lag_of_filters"](true, nominal, sweep)
    assert np.ptp(lag) == pytest.approx(0.12, abs=0.01)
    without, sd = example["phase_over_sweep"](true, nominal, sweep)
    assert np.all(np.abs(without - lag) < 1.96 * sd)
    fit = linregress(lag, without)  # the standard error is that of the scatter over independent recordings
    assert fit.slope > 3.0 * fit.stderr
    assert abs(fit.slope - 1.0) < 3.0 * fit.stderr
    with_term, _ = example["phase_over_sweep"](true, improved, (31440.0, 31540.0))
    assert np.max(np.abs(with_term)) < 0.03
