"""Laws that are fitted in the place of selected ones, or beside them where the first choice is impossible."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lsim

from estimation.candidate_terms.linear_model import LinearModel, LinearTerm
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.law_selection import _addition_failed
from estimation.diagnosis.rival_laws import stated_confounders
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position
from scanner.terms import NaturalScales, catalogue
from scanner.terms.term import NATURAL_PHASE_LAG

DELAYS = ("channel-delay", "readout-lag", "drive-lag", "demodulator-lag")
LAWS = ("damping-drift", "coulomb-friction", "quadratic-drag", "cubic-stiffness")


def effects(*names: str) -> frozenset[tuple[str, str]]:
    return frozenset(("x", name) for name in names)


def test_the_confounder_that_a_term_states_is_fitted_in_its_place() -> None:
    rng = np.random.default_rng(2)
    factor = np.linalg.qr(rng.normal(size=(50, len(LAWS) + 1)), mode="r")
    terms = [LinearTerm(Candidate(catalogue()[name], "x", "sense"), np.array([i]), None) for i, name in enumerate(LAWS)]
    linear = LinearModel(factor, np.zeros((0, factor.shape[1])), tuple(terms), ())
    sets = stated_confounders(linear, (0, 1), fitted=())
    assert effects("coulomb-friction", "quadratic-drag") in sets
    assert not any(("x", "cubic-stiffness") in each for each in sets)
    assert sets[effects("coulomb-friction", "quadratic-drag")] == (1, 2)
    assert effects("coulomb-friction", "quadratic-drag") not in stated_confounders(linear, (0, 1), fitted=sets)


@pytest.mark.parametrize(
    ("evidence", "takes_bulk", "failed"),
    [(None, True, True), (None, False, True), (90.0, False, False), (110.0, False, True), (110.0, True, False)],
)
def test_other_laws_are_added_where_the_first_has_an_impossible_sign(
    evidence: float | None, takes_bulk: bool, failed: bool
) -> None:
    centre: Any = SimpleNamespace(
        effects=effects("gravity-stiffness"),
        fit=SimpleNamespace(neg2_log_evidence=100.0),
        takes_bulk=lambda nominal: takes_bulk,
    )
    both = effects("gravity-stiffness", "second-mode")
    fits: Any = {} if evidence is None else {both: SimpleNamespace(neg2_log_evidence=evidence)}
    assert _addition_failed(centre, [both], fits, nominal=None) is failed  # type: ignore[arg-type]
    assert not _addition_failed(centre, [effects("cubic-stiffness")], fits, nominal=None)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def late_recording() -> Recording:
    """A linear axis of 70 kHz under an amplitude-modulated drive, whose sense signal is 1 µs late."""
    rate, count, fine, resonance = 1e6, 5000, 16, 2 * np.pi * 70e3
    time = np.arange(count * fine) / (rate * fine)
    envelope = 1.0 + 0.7 * np.sin(2 * np.pi * 35.0 * time) + 0.4 * np.sin(2 * np.pi * 90.0 * time)
    drive = envelope * np.sin(resonance * time)
    damping, torque = resonance / 100.0, 0.004 * resonance**2
    _, angle, _ = lsim(([torque], [1.0, damping, resonance**2]), drive, time)
    sensed = np.interp(np.arange(count) / rate - 1e-6, time, angle)
    sensed += 0.008 * np.random.default_rng(21).standard_normal(count)
    axis = Axis(
        Mechanics(1.0, 1.2 * damping, 0.995 * resonance**2), drive=Drive("linear", 0.9 * torque),
        readout=Position(1.0, 0.008), name="x",
        tolerance={"J": 1e-9, "gain": 1e-9, "k": 0.01, "b": 0.5, "torque_per_volt": 0.3},
    )  # fmt: skip
    channels = {"drive_x": (drive[::fine], "V", rate, 0.0), "sense_x": (sensed, "V", rate, 0.0)}
    return Recording.from_arrays(channels, Device("late", {"x": axis}), "late")


def test_a_delay_that_a_low_pass_explains_as_well_is_not_named_with_certainty(late_recording: Recording) -> None:
    finding, *others = diagnose([late_recording]).findings
    names = {finding.effect: finding.probability, **{rival.effect: rival.probability for rival in finding.rivals}}
    assert not others
    for effect in ("channel-delay", "readout-lag", "drive-lag"):
        assert 0.2 < names[effect] < 0.5


def test_delays_and_low_passes_have_the_same_natural_size() -> None:
    rate = 2 * np.pi * 5450.0
    scales = NaturalScales(amplitude=0.1, rate=rate, J=1e-12, b=1e-9, k=1e-3, duration=1.0, drive_rate=rate)
    size = {name: catalogue()[name].parameters[0].value(1.0, scales) for name in DELAYS}
    lag = {name: float(np.arctan(5450.0 / size[name])) for name in DELAYS[1:]}
    lag["channel-delay"] = rate * size["channel-delay"]
    lag["demodulator-lag"] *= 2.0  # two sections
    assert lag == pytest.approx(dict.fromkeys(DELAYS, NATURAL_PHASE_LAG), rel=0.01)
