"""A mode that the swing pumps grows from next to nothing: until late in a sweep no candidate has an edge on another."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.concealed.generator import Order, seal, write
from estimation.mismatch.experiment import experiment
from estimation.mismatch.search import search
from scanner.recording import Recording
from scanner.terms import catalogue

LOOKALIKES = ("damping-drift", "gain-drift", "channel-delay", "clock-skew", "quadratic-drag", "cubic-damping",
              "coulomb-friction", "overtone-coupling")  # fmt: skip


def test_a_mode_that_grows_late_is_found_among_what_explains_nothing_yet(tmp_path: Path) -> None:
    sealed = seal(Order("sealed-001", "one", "tf", ("mode-coupling",), True, 1469536719))
    write(sealed, tmp_path / "sealed-001.h5")
    with Recording.open(tmp_path / "sealed-001.h5") as recording:
        run = experiment(recording, recording.device)
    terms = {effect: catalogue()[effect] for effect in (*LOOKALIKES, "mode-coupling")}
    found = search([run], recording.device, terms)
    assert [each.candidate.term.effect for each in found.rounds] == ["mode-coupling"]
    assert found.nominal.held_chi2 > 10.0
    assert found.final.held_chi2 == pytest.approx(1.0, abs=0.03)
    _, frequency, quality, push = found.final.model.values(found.rounds[0].candidate, found.final.x)
    true = sealed.truth
    assert frequency == pytest.approx(true.mode_frequency / (2 * np.pi), rel=1e-4)
    assert quality == pytest.approx(true.mode_frequency / true.mode_damping, rel=0.01)
    # in the units of the law: q² of a mode that gives back k q²/2
    pushed = true.mode_coupling / true.mode_frequency**2 * np.sqrt(true.mode_exchange * true.J / true.k)
    assert push == pytest.approx(pushed, rel=0.1)
