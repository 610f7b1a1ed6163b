"""A mode that the swing pumps grows from next to nothing: until late in a recording no candidate has an edge."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.concealed.generator import Order, Sealed, seal, write
from estimation.mismatch.experiment import experiment
from estimation.mismatch.search import Search, search
from scanner.recording import Recording
from scanner.terms import catalogue

LOOKALIKES = ("damping-drift", "gain-drift", "channel-delay", "clock-skew", "quadratic-drag", "cubic-damping",
              "coulomb-friction", "overtone-coupling")  # fmt: skip


def searched(order: Order, folder: Path, effects: tuple[str, ...]) -> tuple[Sealed, Search]:
    """The sealed recording of an order, and what a search among ``effects`` finds in it."""
    sealed = seal(order)
    write(sealed, folder / f"{order.name}.h5")
    with Recording.open(folder / f"{order.name}.h5") as recording:
        run = experiment(recording, recording.device)
    return sealed, search([run], recording.device, {effect: catalogue()[effect] for effect in effects})


def mode_found(family: str, seed: int, folder: Path, before: float) -> tuple[Sealed, Search]:
    """A search that finds mode-coupling alone and leaves the noise; held-out chi-square was more than ``before``."""
    order = Order("sealed-001", "one", family, ("mode-coupling",), True, seed)
    sealed, found = searched(order, folder, (*LOOKALIKES, "mode-coupling"))
    assert [each.candidate.term.effect for each in found.rounds] == ["mode-coupling"]
    assert found.nominal.held_chi2 > before
    assert found.final.held_chi2 == pytest.approx(1.0, abs=0.03)
    return sealed, found


def test_a_mode_that_grows_late_is_found_among_what_explains_nothing_yet(tmp_path: Path) -> None:
    sealed, found = mode_found("tf", 1469536719, tmp_path, 10.0)
    _, frequency, quality, push = found.final.model.values(found.rounds[0].candidate, found.final.x)
    true = sealed.truth
    assert frequency == pytest.approx(true.mode_frequency / (2 * np.pi), rel=1e-4)
    assert quality == pytest.approx(true.mode_frequency / true.mode_damping, rel=0.01)
    # in the units of the law: q of a mode that gives back k q²/2
    pushed = true.mode_coupling / np.sqrt(true.mode_exchange * true.k / true.J)
    assert push == pytest.approx(pushed, rel=0.1)


def test_a_mode_hardly_above_its_threshold_is_found(tmp_path: Path) -> None:
    sealed, found = mode_found("drive", 2747196542, tmp_path, 1.2)
    _, frequency, _, _ = found.final.model.values(found.rounds[0].candidate, found.final.x)
    assert frequency == pytest.approx(sealed.truth.mode_frequency / (2 * np.pi), rel=1e-3)


def test_what_a_mode_gives_back_of_its_push_is_not_told_as_another_mode(tmp_path: Path) -> None:
    """Of 6e4 sigma the push's own reaction is a thousandth: without it, a second mode of 60 sigma was found beside."""
    order = Order("sealed-001", "one", "drive", ("mode-coupling",), True, 1736519047)
    sealed, found = searched(order, tmp_path, ("mode-coupling", "second-mode"))
    assert [each.candidate.term.effect for each in found.rounds] == ["mode-coupling"]
    true, fit = sealed.truth, found.final
    at = fit.model.index("term", found.rounds[0].candidate.key, "s")
    assert at is not None
    pushed = true.mode_coupling / np.sqrt(true.mode_exchange * true.k / true.J)
    size = abs(fit.model.values(found.rounds[0].candidate, fit.x)[3])
    assert size == pytest.approx(pushed, rel=4.0 * np.sqrt(fit.covariance[at, at]) / abs(fit.x[at]))


def test_what_fits_as_well_with_more_numbers_is_a_rival(tmp_path: Path) -> None:
    order = Order("sealed-001", "one", "drive", ("second-mode",), False, 1327034240)
    _, found = searched(order, tmp_path, ("drive-lag", "second-mode", "viscoelastic"))
    (only,) = found.rounds
    leads = {lead.candidate.term.effect: lead for lead in only.leads}
    assert only.candidate.term.effect == "drive-lag"
    assert leads["second-mode"].behind > 10.0  # too little to be believed
    assert leads["second-mode"].worse < 4.0
