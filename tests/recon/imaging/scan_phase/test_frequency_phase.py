"""Phases of a scan of which only the frequencies and the field are known."""

from functools import cache

import numpy as np
import pytest

from estimation.curve_smoother import smooth_curve
from estimation.frequency_motion import SlowCurve, interpolate_curve
from recon.evaluation import truth_from_simulation
from recon.imaging.picture import Grid
from recon.imaging.scan_phase.amplitude_change import measure_amplitude_changes
from recon.imaging.scan_phase.phase_search import search_phases
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options, Reconstruction
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.simulated import imaging

RATE = 2e6
X, Y = 13840.0, 3270.0


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth scene without a symmetry, over [-1, 1]."""
    return np.sin(5 * x + 2 * y) + 0.7 * np.cos(7 * y - 3 * x + 1) + x


def phases(n: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(n) / RATE
    return 2 * np.pi * X * t, 2 * np.pi * Y * t


@pytest.mark.parametrize(("true_x", "true_y"), [(0.3, -1.1), (-1.5, 0.0), (1.2, 1.4)])
def test_the_search_finds_phases_up_to_half_a_turn(true_x: float, true_y: float) -> None:
    a, b = phases(12000)
    noise = np.random.default_rng(5).normal(0.0, 0.5, a.size)
    found = search_phases(a, b, scene(np.sin(a + true_x), np.sin(b + true_y)) + noise)
    for each, true in zip(found, (true_x, true_y), strict=True):
        assert each.is_clear
        assert abs(np.sin(each.value - true)) < 0.03


def test_the_search_finds_nothing_in_noise_or_at_a_wrong_frequency() -> None:
    a, b = phases(12000)
    noise = np.random.default_rng(6).normal(0.0, 1.0, a.size)
    assert not any(each.is_clear for each in search_phases(a, b, noise))
    wrong = 1.02 * a
    assert not search_phases(wrong, b, scene(np.sin(a), np.sin(b)))[0].is_clear


def test_amplitude_changes_are_measured_without_their_mean() -> None:
    a, b = phases(60000)
    part = np.arange(a.size) * 4 // a.size
    true = np.array([0.02, 0.005, -0.01, -0.015])
    x, y = np.sin(a), np.sin(b)
    values = scene((1 + true[part]) * x, (1 - true[part]) * y)
    value = np.zeros((4, 2))
    for _ in range(8):  # as the reconstruction does: again about the corrected amplitudes
        mapped = ((1 + value[part, k]) * each for k, each in enumerate((x, y)))
        value += measure_amplitude_changes(*mapped, values, part, 4, Grid(100, 100, 1.03, 1.03)).value
    assert value[:, 0] == pytest.approx(true, abs=3e-3)
    assert value[:, 1] == pytest.approx(-true, abs=3e-3)


def test_the_smoother_follows_a_drift_with_an_honest_standard_deviation() -> None:
    rng = np.random.default_rng(8)
    time = np.sort(rng.uniform(0.0, 0.05, 120))
    true = 0.1 * np.exp(-time / 0.02) + 3.0 * time
    sd = np.full(time.size, 2e-3)
    smoothed = smooth_curve(time, true + sd * rng.normal(size=time.size), sd)
    error = (smoothed.value - true) / smoothed.sd
    assert np.sqrt(np.mean(error**2)) < 1.5
    assert smoothed.sd.max() < 2e-3
    assert smoothed.rate == pytest.approx(3.0 - 5.0 * np.exp(-time / 0.02), abs=1.0)


def test_a_curve_is_continued_linearly() -> None:
    curve = SlowCurve(np.array([0.0, 1.0]), np.array([1.0, 2.0]), np.array([1.0, 1.0]), np.zeros(2))
    value, rate = interpolate_curve(curve, np.array([-1.0, 0.5, 3.0]))
    assert value == pytest.approx([0.0, 1.5, 4.0])
    assert rate == pytest.approx([1.0, 1.0, 1.0])


def frequencies_only(scale: float = 1.0) -> Device:
    known = {axis: KnownAxis(amplitude=0.18, drive_frequency=2 * f * scale) for axis, f in (("x", X), ("y", Y))}
    return Device.from_toml(new_device("parametric", known, frequencies_only=True))


def scan(*channels: str) -> Recording:
    """Intensity and the named channels of a simulated scan, with a device that states frequencies and field only."""
    kept = {name: imaging(seed=31)[0][name] for name in ("intensity", *channels)}
    stored = {name: (each.read(), each.unit, each.sample_rate, each.start) for name, each in kept.items()}
    return Recording.from_arrays(stored, frequencies_only())


@cache
def reconstructed(*channels: str) -> Reconstruction:
    options = Options(pixels=(120, 120))
    return reconstruct(scan(*channels), options, truth_from_simulation(imaging(seed=31)[1]), quiet=True)


@pytest.mark.slow
@pytest.mark.parametrize("channels", [(), ("drive_x", "drive_y")])
def test_intensity_and_frequencies_make_a_picture(channels: tuple[str, ...]) -> None:
    result = reconstructed(*channels)
    assert result.motion.estimator == "picture"
    for name in "xy":
        axis = result.motion.axes[name]
        assert np.degrees(result.evaluation[name].phase_rmse) < 0.1
        assert np.ptp(result.evaluation[name].amplitude) < 0.02
        assert np.degrees(np.sqrt(np.mean(axis.phase_sd**2))) < 0.1
        assert axis.sign == "ambiguous"
        assert axis.amplitude.max() == pytest.approx(0.18, rel=1e-6)
        assert axis.reference == ("half-drive" if channels else "absolute")
    assert any("does not determine the scale" in note for note in result.notes)
    assert result.picture.outside < 1e-3 * result.intensity.size


@pytest.mark.slow
def test_a_flip_mirrors_the_picture() -> None:
    flipped = reconstruct(scan(), Options(pixels=(120, 120), flips={"x": True}), quiet=True)
    image, plain = flipped.picture.image[:, ::-1], reconstructed().picture.image
    both = np.isfinite(image) & np.isfinite(plain)
    assert np.corrcoef(image[both], plain[both])[0, 1] > 0.99


@pytest.mark.parametrize("scale", [1.02, 2.0])
def test_wrong_frequencies_are_refused(scale: float) -> None:
    with pytest.raises(BadInput, match="forward and backward half-periods agree for no phase") as error:
        reconstruct(scan(), Options(device=frequencies_only(scale), pixels=(60, 60)), quiet=True)
    assert f"{X * scale:.8g} Hz in x" in str(error.value)


@pytest.mark.parametrize("channels", [("drive_x", "drive_y"), ()])
@pytest.mark.parametrize("periods", [1.0, 1.5, 5.0])
def test_a_recording_of_few_periods_is_refused_with_what_is_missing(periods: float, channels: tuple[str, ...]) -> None:
    short = scan(*channels).slice(0.0, periods / Y + 1e-6)
    with pytest.raises(BadInput) as error:
        reconstruct(short, Options(pixels=(60, 60)), quiet=True)
    line = str(error.value)
    assert f"holds {periods:g} periods of y at 32" in line
    assert "Hz, and nothing else shows the motion" in line
    assert "needs about 12; record for longer, or record a sense or angle channel of both axes" in line
    assert "J, b and k" in line
    assert "nearly 4 : 1" not in line


def test_a_device_without_frequency_or_field_is_refused() -> None:
    text = frequencies_only().to_toml()
    lines = [line for line in text.splitlines() if not line.startswith("frequency")]
    without_frequency = Options(device=Device.from_toml("\n".join(lines)), estimator="picture")
    without_field = Options(device=Device.from_toml(text.partition("[scan]")[0]))
    with pytest.raises(BadInput, match="state its frequency"):
        reconstruct(scan(), without_frequency, quiet=True)
    with pytest.raises(BadInput, match="half_angle_x"):
        reconstruct(scan(), without_field, quiet=True)
