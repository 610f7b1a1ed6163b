"""Estimates of the linear model become start values of a fit."""

from pathlib import Path

import numpy as np

from benchmarks.blind.generator import Case, generate_recording, write
from estimation.candidate_terms.screening import amplitude_indices, set_amplitudes
from estimation.device_fit.data import prepare_run
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from scanner.recording import Recording
from scanner.terms import catalogue


def test_hidden_states_without_an_estimate_keep_their_values(tmp_path: Path) -> None:
    blind = generate_recording(Case("blind-001", "none", "ring", (), "white", 1))
    write(blind, tmp_path / "blind-001.h5")
    with Recording.open(tmp_path / "blind-001.h5") as recording:
        run, device = prepare_run(recording, recording.device), recording.device
    candidate = Candidate(catalogue()["second-mode"], "x", "sense")
    model = Model([run], device, [candidate])
    amplitudes, states = amplitude_indices(model, candidate), model.indices("hidden", candidate.key)
    x = np.zeros(len(model.parameters))
    x[states] = [0.3, -0.2]
    set_amplitudes(x, model, candidate, np.array([0.5]))
    assert x[amplitudes] == [0.5]
    assert list(x[states]) == [0.3, -0.2]
    set_amplitudes(x, model, candidate, np.array([0.5, 0.1, 0.2]))
    np.testing.assert_allclose(x[states], [0.2, 0.4])
