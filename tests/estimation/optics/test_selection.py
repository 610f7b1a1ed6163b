"""The diagnosis of the optics from the picture; the effects are simulated here, not by the terms."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import scanner.terms
from estimation.complete_diagnosis import diagnose_with_optics
from estimation.estimate import estimate
from estimation.optics.candidates import candidate_effects
from estimation.optics.correction import beam_motion, correct_intensity
from estimation.optics.samples import read_scan
from estimation.optics.selection import diagnose_optics
from phantoms.optics import Detector, detect, sample_scene
from phantoms.targets import make_target
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid
from recon.report.diagnosis import diagnosis_report
from scanner.angle_tracks import SampledAngle
from scanner.channel import make_channel
from scanner.device import Device
from scanner.errors import BadInput
from scanner.optics import beam_position, intensity_delay, intensity_gain
from scanner.recording import Recording
from scanner.terms.term import Parameter, Term

SAMPLE_RATE_HZ, DURATION_S = 2e6, 0.012
DRIVE_RATE_RAD_S = {"x": 2 * np.pi * 9000.0, "y": 2 * np.pi * 2130.0}
HALF_ANGLE_RAD = 0.1
DEVICE = Device.from_toml("[x]\n[y]\n[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n")


@cache
def scene(name: str) -> np.ndarray:
    return make_target(name)


def scan(
    name: str = "immunohistochemistry",
    late: float = 0.0,
    fade: float = 0.0,
    creep: float = 0.0,
    phase_x: float = 0.0,
    bandwidth: float | None = None,
    seed: int = 0,
) -> Recording:
    """A scan whose angle sensors have phase errors of 0.01 degrees, with the stated effects of the optics.

    Args:
        name: the target.
        late: delay of the angles relative to the beam [s].
        fade: exponent of the loss of intensity over the scan.
        creep: motion of the sample along x over the scan, relative to the half field.
        phase_x: error of the phase of x [rad].
        bandwidth: of the detector [Hz].
        seed: of noise and start phases.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(round(SAMPLE_RATE_HZ * DURATION_S)) / SAMPLE_RATE_HZ
    start = rng.uniform(0, 2 * np.pi, 2)

    def angle(axis: str, t: np.ndarray, phase_error: float = 0.0) -> np.ndarray:
        return HALF_ANGLE_RAD * np.sin(DRIVE_RATE_RAD_S[axis] * t + start["xy".index(axis)] + phase_error)

    x = angle("x", time - late) - creep * HALF_ANGLE_RAD * time / DURATION_S
    light = sample_scene(scene(name), x, angle("y", time - late), HALF_ANGLE_RAD, HALF_ANGLE_RAD) * np.exp(
        -fade * time / DURATION_S
    )
    voltage = detect(light, SAMPLE_RATE_HZ, Detector(photons_per_sample=1000.0, bandwidth_hz=bandwidth), rng)
    phase_errors = np.radians(0.01) * rng.normal(size=2)
    channels = {
        "angle_x": (angle("x", time, phase_errors[0] - phase_x), "rad", SAMPLE_RATE_HZ, 0.0),
        "angle_y": (angle("y", time, phase_errors[1]), "rad", SAMPLE_RATE_HZ, 0.0),
        "intensity": (voltage, "V", SAMPLE_RATE_HZ, 0.0),
    }
    return Recording.from_arrays(channels, DEVICE, "scan")


@pytest.mark.slow
def test_a_scan_without_effects_is_consistent() -> None:
    diagnosis = diagnose_with_optics([scan()])
    assert diagnosis.verdict == "consistent"
    detectable = {(effect["effect"], effect["axis"]): effect["detectable"] for effect in diagnosis.optics[0]["effects"]}
    assert detectable["intensity-delay", "x"]
    assert not detectable["field-distortion", "x"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "effect", "value"),
    [
        ({"late": 2e-6}, "intensity-delay", 2e-6),
        ({"late": -1e-6}, "channel-delay", 1e-6),
        ({"bandwidth": 1e5}, "detector-lag", 1e5),
        ({"fade": 0.3, "name": "retina"}, "bleaching", DURATION_S / 0.3),
        ({"creep": 0.06}, "sample-motion", 0.06 * HALF_ANGLE_RAD / DURATION_S),
    ],
)
def test_an_effect_is_found_and_its_interval_contains_the_true_value(
    hidden: dict[str, float], effect: str, value: float
) -> None:
    (finding,) = diagnose_with_optics([scan(**hidden)]).findings  # type: ignore[arg-type]
    low, high = finding.parameters[0].ci95
    assert (finding.effect, finding.axis) == (effect, "x")
    assert low < value < high
    assert high - low < 0.4 * value
    assert finding.heldout["after"] < 0.8 * finding.heldout["before"]


@pytest.mark.parametrize(("phase_x", "effect"), [(0.05, "channel-delay"), (-0.05, "unknown")])
def test_a_phase_error_of_one_axis_is_a_late_detector_or_unknown_not_an_intensity_delay(
    phase_x: float, effect: str
) -> None:
    """No detector is early."""
    (finding,) = diagnose_with_optics([scan(phase_x=phase_x)]).findings
    assert (finding.effect, finding.axis, finding.stage) == (effect, "x", "timing")
    assert "deg" in finding.where


BRIGHTENING = """
import numpy as np
from scanner.terms.term import Parameter, Term

TERM = Term(
    "brightening", "optics", "I(t) = L e^(t/tau)",
    (Parameter("tau", "s", lambda s: 2.0 * s.duration, kind="inverse", sign=1),), "this test",
    channels=("intensity",), output=lambda signal, p, context: signal * np.exp(context.time / p[0]),
)
"""


def test_an_optics_effect_of_a_users_file_is_a_candidate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two effects of opposite sign in the same direction, the one whose term permits the sign is named."""
    monkeypatch.setattr(scanner.terms, "_REGISTERED", {})
    (tmp_path / "brightening.py").write_text(BRIGHTENING, encoding="utf-8")
    scanner.terms.register(tmp_path / "brightening.py")
    diagnosis = diagnose_with_optics([scan("retina", fade=-0.3)])
    (finding,) = diagnosis.findings
    low, high = finding.parameters[0].ci95
    assert (finding.effect, finding.axis) == ("brightening", "x")
    assert low < DURATION_S / 0.3 < high
    assert diagnosis.device.axis("x").terms["brightening"]["tau"] == pytest.approx(DURATION_S / 0.3, rel=0.2)
    assert {effect["effect"] for effect in diagnosis.optics[0]["effects"]} >= {"brightening", "bleaching"}


@pytest.mark.parametrize(
    ("channel", "law", "direction"),
    [
        ("intensity", lambda y, p, c: np.interp(c.time - p[0], c.time, y), {"delay_x": 1.0, "delay_y": 1.0}),
        ("place", lambda y, p, c: y * (1.0 + 1e4 * p[0] * c.time), {"amplitude_growth_y": 1.0}),
        ("place", lambda y, p, c: y + p[0] * y**3, {}),
    ],
)
def test_a_term_is_linearised_in_the_measured_parameters(
    channel: str, law: object, direction: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    term = Term("law", "optics", "", (Parameter("p", "", lambda s: 1e-5),), "", channels=(channel,), output=law)  # type: ignore[arg-type]
    monkeypatch.setattr("estimation.optics.candidates.catalogue", lambda: {"law": term})
    samples = read_scan({axis: SampledAngle(np.sin(np.arange(5000.0)), 1e6) for axis in "xy"}, scan()["intensity"])
    effects = candidate_effects(samples, DRIVE_RATE_RAD_S)
    effect = next(e for e in effects if e.name == "law" and e.axis == ("x" if channel == "intensity" else "y"))
    assert effect.direction == pytest.approx(direction, rel=1e-3)


def test_an_intensity_without_known_angles_is_refused() -> None:
    tracks = {axis: SampledAngle(np.full(5000, np.nan), 1e6) for axis in "xy"}
    with pytest.raises(BadInput, match="intensity: has no sample at which both angles are known; check the channels'"):
        read_scan(tracks, scan()["intensity"])


def test_a_constant_intensity_is_refused() -> None:
    intensity = scan()["intensity"]
    dark = make_channel("intensity", np.full(intensity.size, 7.0), unit="V", sample_rate=intensity.sample_rate)
    with pytest.raises(BadInput, match=r"^intensity: is constant, 7 V; check that it was connected$"):
        diagnose_optics(estimate(scan()), dark, DEVICE)


def test_effects_on_a_sample_without_features_are_reported_as_not_detectable() -> None:
    recording = scan(late=2e-6)
    rng = np.random.default_rng(1)
    blank = rng.normal(0.5, 0.02, recording["intensity"].size)
    channels = {name: (recording[name].read(), "rad", SAMPLE_RATE_HZ, 0.0) for name in ("angle_x", "angle_y")}
    diagnosis = diagnose_with_optics(
        [Recording.from_arrays({**channels, "intensity": (blank, "V", SAMPLE_RATE_HZ, 0.0)}, DEVICE)]
    )
    assert diagnosis.verdict == "consistent"
    assert not any(effect["detectable"] for effect in diagnosis.optics[0]["effects"] if effect["effect"] != "bleaching")


def test_the_improved_device_restores_the_picture() -> None:
    """Two effects are found together, written to a device file, read back and corrected."""
    hidden, clean = scan(late=2e-6, fade=0.3), scan()
    diagnosis = diagnose_with_optics([hidden])
    device = Device.from_toml(diagnosis.device.to_toml())
    assert (
        {finding.effect for finding in diagnosis.findings}
        == {"intensity-delay", "bleaching"}
        == set(device.axis("x").terms)
    )
    assert "not detectable" in diagnosis_report(diagnosis, ["scan"])[1]
    assert intensity_delay(device, 1 / SAMPLE_RATE_HZ) == pytest.approx(2e-6, rel=0.1)

    grid = Grid(80, 80, HALF_ANGLE_RAD, HALF_ANGLE_RAD)
    x, y = clean["angle_x"].read(), clean["angle_y"].read()
    truth = map_samples(x, y, clean["intensity"].read(), grid).image
    light = correct_intensity(hidden, device)["intensity"]
    early = np.interp(light.time(), clean["angle_x"].time(), x), np.interp(light.time(), clean["angle_y"].time(), y)
    corrected = map_samples(*early, light.read(), grid).image
    uncorrected = map_samples(x, y, hidden["intensity"].read(), grid).image
    assert np.nanstd(corrected - truth) < 0.35 * np.nanstd(uncorrected - truth)


@pytest.mark.parametrize(
    ("hidden", "effect", "stated", "true"),
    [
        ({"late": 8e-6}, "intensity-delay", {"tau": 3e-6}, 8e-6),
        ({"fade": 0.4}, "bleaching", {"tau": DURATION_S / 0.2}, DURATION_S / 0.4),
        ({"creep": 0.1}, "sample-motion", {"v": 0.05 * HALF_ANGLE_RAD / DURATION_S}, 0.1 * HALF_ANGLE_RAD / DURATION_S),
    ],
)
def test_an_effect_beside_a_stated_one_is_added_to_it(
    hidden: dict[str, float], effect: str, stated: dict[str, float], true: float
) -> None:
    """The remainder replaced the stated value: of a delay of 8 us, 3 us of them stated, the device had 5 us."""
    diagnosis = diagnose_with_optics([scan(**hidden)], DEVICE.with_terms({"x": {effect: stated}}))  # type: ignore[arg-type]
    (finding,) = diagnosis.findings
    (value,) = diagnosis.device.axis("x").terms[effect].values()
    assert finding.effect == effect
    assert value == pytest.approx(true, rel=0.12)
    assert "beside the stated" in finding.where


def test_optics_terms_change_beam_position_and_intensity() -> None:
    terms = "[x.terms.sample-motion]\nv = 0.5\n[x.terms.bleaching]\ntau = 0.1\n[x.terms.detector-lag]\nf_c = 1e5\n"
    device = Device.from_toml(f"[x]\n[y]\n[y.terms.field-distortion]\nc3 = 2.0\n{terms}")
    time = np.arange(1000) / SAMPLE_RATE_HZ
    angle = np.linspace(-0.1, 0.1, 1000)
    np.testing.assert_allclose(beam_position(device, "x", angle, time), angle - 0.5 * time)
    np.testing.assert_allclose(beam_position(device, "y", angle, time), angle + 2.0 * angle**3)
    np.testing.assert_allclose(intensity_gain(device, time), np.exp(-time / 0.1), rtol=1e-3)
    assert intensity_delay(device, 1 / SAMPLE_RATE_HZ) == pytest.approx(1 / (2 * np.pi * 1e5), rel=0.02)


def test_beam_positions_are_computed_lazily() -> None:
    from estimation.estimate import estimate

    device = Device.from_toml("[x]\n[x.terms.sample-motion]\nv = 0.5\n[y]\n")
    recording = scan()
    motion = estimate(recording, device)
    track, mirror = beam_motion(motion, device, 0.0).axes["x"].angle, motion.axes["x"].angle
    np.testing.assert_allclose(track.read(100, 200), mirror.read(100, 200) - 0.5 * np.arange(100, 200) / SAMPLE_RATE_HZ)
    assert track.read().size == mirror.size
    np.testing.assert_allclose(track.negated().read(0, 9), -mirror.read(0, 9) - 0.5 * np.arange(9) / SAMPLE_RATE_HZ)
    assert beam_motion(motion, device, 0.0).axes["y"] is motion.axes["y"]


@pytest.mark.parametrize("tau", [1e-4, 6e-4, 5e-3])
def test_a_delay_of_any_length_is_corrected(tau: float) -> None:
    device = Device.from_toml(f"[x]\n[y]\n[x.terms.intensity-delay]\ntau = {tau}\n")
    assert intensity_delay(device, 2e-7) == pytest.approx(tau, rel=1e-6)


def test_light_that_decays_at_once_is_refused() -> None:
    device = Device.from_toml("[x]\n[y]\n[x.terms.bleaching]\ntau = 1e-12\n")
    with pytest.raises(BadInput, match=r"intensity: holds no light .* check tau"):
        intensity_delay(device, 2e-7)


def test_a_delay_of_seconds_is_refused() -> None:
    device = Device.from_toml("[x]\n[y]\n[x.terms.intensity-delay]\ntau = 1.0\n")
    with pytest.raises(BadInput, match=r"intensity: comes 0.\d+ s or more after the light .* check tau"):
        intensity_delay(device, 2e-7)
