"""The examples of the page on extending work: two effects, a reader and an estimator, one file each."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import estimation.estimators
import lissajous
import recon.io.readers
import scanner.terms

PAGE = Path(__file__).parent.parent.parent / "docs" / "extending.md"


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """The programs of the page as files. Their registrations are removed after the test."""
    for package in (scanner.terms, recon.io.readers, estimation.estimators):
        monkeypatch.setattr(package, "_REGISTERED", {})
    written = {}
    for text in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        name = text.splitlines()[0].removeprefix("# ")
        (tmp_path / name).write_text(text, encoding="utf-8")
        written[name] = tmp_path / name
    return written


@pytest.mark.slow
def test_an_effect_of_the_mechanics_is_simulated_and_reconstructed(files: dict[str, Path]) -> None:
    lissajous.register_effects(files["septic_stiffness.py"])
    assert lissajous.catalogue()["septic-stiffness"].stage == "mechanics"
    nominal = lissajous.load_device("imaging")
    k7 = 0.003 * nominal.axes["x"].mechanics.k / 0.18**6
    axis = replace(nominal.axes["x"], terms={"septic-stiffness": {"k7": k7}})
    device = replace(nominal, axes={**nominal.axes, "x": axis})
    simulation = lissajous.simulate(device, duration=0.006, drift=0.0, nominal=nominal)
    without, with_effect = (
        lissajous.reconstruct(simulation.recording, given, pixels=(60, 60), truth=simulation.truth)
        for given in (nominal, device)
    )
    assert with_effect.evaluation["x"].phase_rmse < np.radians(0.1)
    assert with_effect.evaluation["x"].angle_rmse < 0.8 * without.evaluation["x"].angle_rmse


def test_an_effect_of_the_optics_is_simulated(files: dict[str, Path]) -> None:
    lissajous.register_effects(files["brightening.py"])
    nominal = lissajous.load_device("imaging")
    axis = replace(nominal.axes["x"], terms={"brightening": {"tau": 0.04}})
    device = replace(nominal, axes={**nominal.axes, "x": axis})
    without, brightened = (
        lissajous.simulate(given, duration=0.004, seed=1).recording["intensity"].read() for given in (nominal, device)
    )
    late = slice(-2000, None)
    assert brightened[late].mean() / without[late].mean() == pytest.approx(np.exp(0.1), rel=0.02)


def test_a_reader_reads_a_file_of_a_new_format(files: dict[str, Path], tmp_path: Path) -> None:
    lissajous.register_readers(files["beam_recorder.py"])
    samples = np.linspace(-1.0, 1.0, 50, dtype="<f4")
    head = b"BEAM" + np.float64(2e6).tobytes() + bytes(4)
    (tmp_path / "scan.beam").write_bytes(head + samples.tobytes())
    recording = lissajous.convert(tmp_path / "scan.beam", {"channels": {"sense_x": {"variable": "CH1"}}})
    assert recording["sense_x"].sample_rate == 2e6
    np.testing.assert_array_equal(recording["sense_x"].read(), samples)


def test_an_estimator_is_chosen_by_its_name(files: dict[str, Path]) -> None:
    lissajous.register_estimators(files["smoothed_sensor.py"])
    recording, truth = lissajous.simulate(duration=0.006, angles=True)
    result = lissajous.reconstruct(recording, estimator="smoothed-sensor", pixels=(60, 60), truth=truth)
    assert all(result.evaluation[axis].phase_rmse < np.radians(0.05) for axis in "xy")
