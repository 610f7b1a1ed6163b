"""The report page: its phase sliders map the scan as the program does, also in a browser, and it fits a phone."""

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import recon.report.phase_slider
from estimation.device_fit.posterior import Waveform
from recon.imaging.gridding import accumulate_samples
from recon.imaging.picture import Grid
from recon.pipeline import reconstruct
from recon.quality.defects import Defect, unrecoverable_intervals
from recon.report.diagnosis_figures import waveform_figure
from recon.report.figures import MAX_CURVE_SEGMENTS, highlight_pixels, min_max_envelope
from recon.report.page import Figure, Section, render
from recon.report.phase_slider import MISSING_CODE, phase_slider_data
from recon.report.reconstruction import phase_slider_section, reconstruction_report, round_scale_bar
from recon.report.summary import summarise
from recon.steps.reconstruction import Options, Reconstruction
from scanner.sample_ranges import to_sample_ranges
from tests.support.simulated import imaging

SCRIPT = Path(recon.report.phase_slider.__file__).parent / "templates" / "sweeps.js"
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
DISABLED_FEATURES = ("gpu", "quic", "background-networking", "component-update", "sync")
CHROMIUM_FLAGS = ["--headless", "--no-sandbox", "--no-first-run", "--hide-scrollbars", "--enable-logging=stderr"]
CHROMIUM_FLAGS += ["--v=0"]
CHROMIUM_FLAGS += [f"--disable-{feature}" for feature in DISABLED_FEATURES]


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    recording, _ = imaging()
    return reconstruct(recording, Options(pixels=(200, 160)), quiet=True)


@pytest.fixture(scope="module")
def data(result: Reconstruction) -> dict:
    return phase_slider_data(result)


@pytest.fixture(scope="module")
def page(result: Reconstruction) -> str:
    return reconstruction_report(result, summarise(result))


def program(*names: str) -> str:
    """The path of a program, found by one of its names. The test is skipped if there is none."""
    for name in names:
        if path := shutil.which(name):
            return path
    pytest.skip(f"no {names[0]}")


def decode(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def embedded_samples(data: dict, size: int) -> np.ndarray:
    """Indices of the samples of the segment that the page contains."""
    first = np.arange(0, size - data["run"] + 1, data["stride"])
    return (first[:, None] + np.arange(data["run"])).ravel()


def angle_from_page(axis: dict, time: np.ndarray, quarter: bool = False) -> np.ndarray:
    """Angle in half fields, or its quadrature, computed from the page's data of an axis."""
    knots = axis["start"] + axis["step"] * np.arange(decode(axis["phase"], "<f4").size)
    amplitude, phase = (np.interp(time, knots, decode(axis[key], "<f4")) for key in ("amplitude", "phase"))
    return amplitude * np.sin(2 * np.pi * axis["frequency"] * time + phase + 0.5 * np.pi * quarter)


def reference_maps(data: dict, size: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Sums and counts of x forward, x backward, y forward, y backward, by the program's gridding."""
    time = embedded_samples(data, size) / data["rate"]
    codes = decode(data["intensity"], np.uint8).astype(float)
    x, y = (angle_from_page(axis, time) for axis in data["axes"])
    grid = Grid(data["width"], data["height"], 1.0, 1.0)
    maps = []
    for axis in data["axes"]:
        forward = angle_from_page(axis, time, quarter=True) >= 0
        maps += [accumulate_samples(x[half], y[half], codes[half], grid) for half in (forward, ~forward)]
    return maps


def test_the_page_contains_a_coarse_copy_of_the_scan(page: str, data: dict) -> None:
    intensity = imaging()[0]["intensity"].read()
    assert (data["width"], data["height"]) == (200, 160)
    assert data["seconds"] == pytest.approx([0.0, 0.02])
    codes = decode(data["intensity"], np.uint8)
    assert codes.size == embedded_samples(data, intensity.size).size == intensity.size
    assert MISSING_CODE not in codes
    assert np.corrcoef(codes, intensity)[0, 1] > 0.999
    black, white = data["limits"]
    assert 1 <= black < white <= 255
    assert len(page) < 3e6
    assert "://" not in page.replace("http://www.w3.org", "")  # base64 may contain "http", but no colon
    for axis in "xy":
        assert f'<label for="dphi-{axis}">' in page
        assert re.search(rf'<input id="dphi-{axis}" type="range" [^>]*step="0.01" value="0"', page)


def test_slow_phase_and_amplitude_reproduce_the_angles(result: Reconstruction, data: dict) -> None:
    grid = result.picture.grid
    for axis, half in zip(data["axes"], (grid.half_angle_x, grid.half_angle_y), strict=True):
        angle = result.motion.axes[axis["name"]].angle.read() / half
        pixels = 0.5 * axis["pixels"] * (angle_from_page(axis, np.arange(angle.size) / data["rate"]) - angle)
        assert np.sqrt(np.mean(pixels**2)) < 0.1  # the page omits the third harmonic


def test_of_a_long_scan_the_page_contains_runs_of_the_middle(
    result: Reconstruction, data: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recon.report.phase_slider, "MAX_SEGMENT_SAMPLES", 60_000)
    monkeypatch.setattr(recon.report.phase_slider, "MAX_SAMPLES", 20_000)
    intensity = imaging()[0]["intensity"]
    reduced = phase_slider_data(result)
    assert reduced["seconds"] == pytest.approx([0.004, 0.016])
    codes = decode(reduced["intensity"], np.uint8)
    assert 19_000 < codes.size <= 20_000
    middle = intensity.read(20_000, 80_000)[embedded_samples(reduced, 60_000)]
    assert np.corrcoef(codes, middle)[0, 1] > 0.999


def test_a_scan_too_short_for_a_slow_phase_has_no_sliders(
    result: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recon.report.phase_slider, "MAX_SEGMENT_SAMPLES", 5_000)
    assert phase_slider_data(result) is None
    section = phase_slider_section(result)
    assert section.phase_slider is None
    assert "too short" in section.text


def test_the_script_maps_as_the_program_does(data: dict, tmp_path: Path) -> None:
    node = program("node")
    (tmp_path / "data.json").write_text(json.dumps(data))
    (tmp_path / "run.js").write_text(
        SCRIPT.read_text(encoding="utf-8")
        + """
        const data = JSON.parse(require("fs").readFileSync(process.argv[2]));
        const maps = remap(unpack(data), 0, 0);
        console.log(JSON.stringify(maps.map(({ sum, count }) => [Array.from(sum), Array.from(count)])));
        """
    )
    process = subprocess.run(
        [node, tmp_path / "run.js", tmp_path / "data.json"], capture_output=True, text=True, check=True
    )
    expected = reference_maps(data, imaging()[0]["intensity"].size)
    for (sums, counts), (expected_sums, expected_counts) in zip(json.loads(process.stdout), expected, strict=True):
        # The script extrapolates linearly beyond the first and last knots and has float32 arrays.
        assert np.mean(np.array(counts) == expected_counts.ravel()) > 0.98
        assert np.corrcoef(sums, expected_sums.ravel())[0, 1] > 0.98
        assert abs(sum(counts) - int(expected_counts.sum())) <= 1e-3 * expected_counts.sum()  # at the edge


BROWSER_SCRIPT = """<pre id="observed"></pre><script>
const observed = { wide: document.documentElement.scrollWidth, inner: innerWidth, labels: {}, split: {} };
const split = () => ["x", "y"].map((axis) => {
  const canvas = document.querySelector(`#sweeps-${axis} canvas`);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let difference = 0, visible = 0;
  for (let i = 0; i < data.length; i += 4)
    if (data[i + 3]) { difference += Math.abs(data[i] - data[i + 1]); visible++; }
  return [difference / visible, visible / (data.length / 4)];
});
const sliders = ["x", "y"].map((axis) => document.getElementById(`dphi-${axis}`));
const move = (slider, degrees) => { slider.value = degrees; slider.dispatchEvent(new Event("input")); };
observed.split.estimate = split();
observed.first = sliders.map((slider) => slider.value);
for (const degrees of [-3, -1, 1, 3]) {
  sliders.forEach((slider) => move(slider, degrees));
  observed.split[degrees] = split();
  observed.labels[degrees] = document.querySelector("#sweeps-x output").textContent;
}
document.querySelectorAll(".sweeps button").forEach((button) => button.click());
observed.split.reset = split();
move(sliders[0], 3);
observed.split.x_only = split();
sliders[1].focus();
observed.focus = document.activeElement.id;
document.getElementById("observed").textContent = JSON.stringify(observed);
</script></body>"""


@pytest.mark.slow
def test_in_a_browser_the_colours_coincide_at_the_estimate(result: Reconstruction, page: str, tmp_path: Path) -> None:
    chromium = program(*CHROMIUM_NAMES)
    (tmp_path / "report.html").write_text(page.replace("</body>", BROWSER_SCRIPT), encoding="utf-8")
    process = subprocess.run(
        [chromium, *CHROMIUM_FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "--window-size=360,800", "--dump-dom",
         (tmp_path / "report.html").as_uri()],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    console = [line for line in process.stderr.splitlines() if "CONSOLE" in line]
    assert not [line for line in console if "willReadFrequently" not in line]  # that warning is about BROWSER_SCRIPT
    observed = json.loads(re.search(r'<pre id="observed">(.*?)</pre>', process.stdout)[1])
    assert observed["wide"] <= observed["inner"]
    assert observed["first"] == ["0", "0"]
    assert observed["focus"] == "dphi-y"
    assert observed["split"]["reset"] == observed["split"]["estimate"]
    for axis in (0, 1):
        difference, visible = observed["split"]["estimate"][axis]
        assert visible > 0.6
        assert difference < observed["split"]["1"][axis][0] < observed["split"]["3"][axis][0]
        assert difference < observed["split"]["-1"][axis][0] < observed["split"]["-3"][axis][0]
    assert observed["split"]["x_only"][0][0] > 1.3 * observed["split"]["estimate"][0][0]
    distance_px = 200 * np.radians(3) * np.mean(result.motion.axes["x"].amplitude) / result.picture.grid.half_angle_x
    label = re.fullmatch(r"\+3\.00°, sweeps ([\d.]+) px apart", observed["labels"]["3"])
    assert float(label[1]) == pytest.approx(distance_px, abs=0.1)


def test_text_from_a_recording_is_escaped() -> None:
    page = render("<script>alert(1)</script>", "</p><b>", [Section("<i>", "&amp;")], ["<img src=x>"])
    assert "<script>" not in page
    assert "<b>" not in page
    assert "<i>" not in page
    assert "<img" not in page


def test_a_dollar_sign_in_the_name_of_a_recording_begins_no_formula() -> None:
    values = np.zeros(3)
    figure = waveform_figure(Waveform(values, values, values, values), "a$_$b, sense_x", "V")
    assert "<!-- a$_$b, sense_x (V) -->" in base64.b64decode(figure.uri.partition(",")[2]).decode()


def test_defects_are_marked_and_their_samples_are_omitted(result: Reconstruction) -> None:
    intensity = imaging()[0]["intensity"]
    affected = np.zeros((160, 200), bool)
    affected[:80] = True
    gap = [Defect("sense", "gap", 0.005, 0.010)]
    x = result.motion.axes["x"]
    unlocated_x = replace(x, phase_sd=np.where((x.time > 0.006) & (x.time < 0.009), 10.0, x.phase_sd))
    motion = replace(result.motion, axes={**result.motion.axes, "x": unlocated_x})
    defective = replace(result, motion=motion, defects=gap, affected=affected)
    codes = decode(phase_slider_data(defective)["intensity"], np.uint8)
    omitted = to_sample_ranges(unrecoverable_intervals(defective.motion, gap), intensity)
    assert omitted
    expected = np.concatenate([np.arange(*first_and_stop) for first_and_stop in omitted])
    assert np.array_equal(np.flatnonzero(codes == MISSING_CODE), expected)
    assert "the defects listed above" in reconstruction_report(defective, summarise(defective))
    grey = np.full((160, 200, 3), 100, np.uint8)
    shown = highlight_pixels(grey, affected)
    assert np.array_equal(shown[80:], grey[80:])
    assert np.all(shown[:80] == (np.array([0xE0, 0x8A, 0x1E]) + 100) // 2)


def test_several_detectors_are_averaged(result: Reconstruction, data: dict) -> None:
    intensity = imaging()[0]["intensity"]
    values = intensity.read()
    raw = np.stack([values + 0.3, values - 0.3], 1)
    pair = replace(intensity, raw=raw, first=0, stop=values.size, gain=1.0, offset=0.0)
    image = result.picture.image[..., None] + np.array([0.3, -0.3], np.float32)
    several = phase_slider_data(replace(result, picture=replace(result.picture, image=image), intensity=pair))
    codes, single_codes = (decode(page_data["intensity"], np.uint8).astype(int) for page_data in (several, data))
    assert np.abs(codes - single_codes).max() <= 1
    assert several["limits"] == pytest.approx(data["limits"], abs=0.1)


def test_a_long_curve_is_reduced_to_few_points_and_keeps_its_outliers() -> None:
    time, values = np.arange(1_000_003.0), np.sin(np.arange(1_000_003) / 1e4)
    values[123_456] = 7.0
    x, y = min_max_envelope(time, values)
    assert x.size == y.size == 2 * MAX_CURVE_SEGMENTS
    assert (y.max(), y.min()) == (7.0, values.min())
    assert x[np.argmax(y)] == pytest.approx(123_456, abs=1_000_003 / MAX_CURVE_SEGMENTS)
    assert (np.diff(x) >= 0.0).all()
    assert np.array_equal(
        min_max_envelope(time[:MAX_CURVE_SEGMENTS], values[:MAX_CURVE_SEGMENTS])[1], values[:MAX_CURVE_SEGMENTS]
    )


def test_unknown_values_of_a_long_curve_hide_no_others() -> None:
    time, values = np.arange(6000.0), np.arange(6000.0)
    values[::3] = np.nan
    values[3000:3300] = np.nan
    x, y = min_max_envelope(time, values)
    assert np.array_equal(np.isnan(y), (x >= 3000) & (x < 3300))


@pytest.mark.parametrize("power", [0.01, 0.1, 1.0, 10.0, 1000.0])
@pytest.mark.parametrize("roundings", [-2, -1, 0, 1])
def test_a_quarter_of_the_picture_may_be_a_rounding_beside_a_round_length(power: float, roundings: int) -> None:
    width = 4.0 * power
    for _ in range(abs(roundings)):
        width = np.nextafter(width, np.sign(roundings) * np.inf)
    label, part = round_scale_bar(float(width), "mm")
    assert label == f"{power:g} mm"
    assert part == pytest.approx(0.25)


def test_black_and_white_of_a_picture_on_a_large_offset_have_different_labels(result: Reconstruction) -> None:
    bright = replace(result, picture=replace(result.picture, image=30_000.0 + 0.1 * result.picture.image))
    page = reconstruction_report(bright, summarise(result))
    black, white = re.search(r'<span class="grey">([\d.]+) V<i></i>([\d.]+) V</span>', page).groups()
    assert 30_000.0 <= float(black) < float(white) < 30_001.0


def test_the_length_of_a_scale_bar_is_a_fraction_of_the_picture() -> None:
    """A width in percent is that of the box around it, which has to be as wide as the picture beside a legend too."""
    figure = Figure("data:,", "picture", scale_bar=("5 µm", 0.2), grey_scale=("0", "1"))
    page = render("title", "", [Section("Picture", figures=[figure], pixelated=True)])
    assert '<span class="length"><i style="width: 20.0%"></i>5 µm</span>' in page
    widths = dict(re.findall(r"^(\.scale|\.row\.pictures img, canvas) {[^}]*max-width: (\w+);", page, re.MULTILINE))
    assert len(widths) == 2
    assert len(set(widths.values())) == 1
    assert "flex: 0 0 100%;" in re.search(r"^\.scale \.length {(.*?)}", page, re.MULTILINE)[1]
