"""The report: its sliders map the scan as the program does, in a browser too, and it reads on a phone."""

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import imaging

import recon.sweeps
from recon.mapping import Grid, accumulate
from recon.pipeline import Options, Reconstruction, reconstruct
from recon.report import Section, by_hand, reconstruction_report, render
from recon.summary import summarise
from recon.sweeps import NONE, sweeps
from recon.trouble import Trouble, samples, unknown
from recon.views import SHOWN, marked, thinned

SCRIPT = Path(recon.sweeps.__file__).parent / "templates" / "sweeps.js"
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "chrome")
QUIET = ("gpu", "quic", "background-networking", "component-update", "sync")
FLAGS = ["--headless", "--no-sandbox", "--no-first-run", "--hide-scrollbars", "--enable-logging=stderr", "--v=0"]
FLAGS += [f"--disable-{what}" for what in QUIET]


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    recording, _ = imaging()
    return reconstruct(recording, Options(pixels=(200, 160)), quiet=True)


@pytest.fixture(scope="module")
def data(result: Reconstruction) -> dict:
    return sweeps(result)


@pytest.fixture(scope="module")
def page(result: Reconstruction) -> str:
    return reconstruction_report(result, summarise(result))


def program(*names: str) -> str:
    """A program by one of its names; a test that asks for it is skipped, and says so, where there is none."""
    for name in names:
        if found := shutil.which(name):
            return found
    pytest.skip(f"no {names[0]}")


def unpacked(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def kept(data: dict, size: int) -> np.ndarray:
    """Which samples of the stretch the page holds."""
    first = np.arange(0, size - data["run"] + 1, data["stride"])
    return (first[:, None] + np.arange(data["run"])).ravel()


def angle_again(axis: dict, time: np.ndarray, quarter: bool = False) -> np.ndarray:
    """Angle in half fields, or its quarter turn, from what the page holds of an axis."""
    knots = axis["start"] + axis["step"] * np.arange(unpacked(axis["phase"], "<f4").size)
    amplitude, phase = (np.interp(time, knots, unpacked(axis[key], "<f4")) for key in ("amplitude", "phase"))
    return amplitude * np.sin(2 * np.pi * axis["frequency"] * time + phase + 0.5 * np.pi * quarter)


def own_maps(data: dict, size: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Sums and counts of x forward, x backward, y forward, y backward, by the program's own mapping."""
    time = kept(data, size) / data["rate"]
    codes = unpacked(data["intensity"], np.uint8).astype(float)
    x, y = (angle_again(axis, time) for axis in data["axes"])
    grid = Grid(data["width"], data["height"], 1.0, 1.0)
    maps = []
    for axis in data["axes"]:
        forward = angle_again(axis, time, quarter=True) >= 0
        maps += [accumulate(x[own], y[own], codes[own], grid) for own in (forward, ~forward)]
    return maps


def test_the_page_holds_the_scan_in_small(page: str, data: dict) -> None:
    intensity = imaging()[0]["intensity"].read()
    assert (data["width"], data["height"]) == (200, 160)
    assert data["seconds"] == pytest.approx([0.0, 0.02])
    codes = unpacked(data["intensity"], np.uint8)
    assert codes.size == kept(data, intensity.size).size == intensity.size
    assert NONE not in codes
    assert np.corrcoef(codes, intensity)[0, 1] > 0.999
    black, white = data["limits"]
    assert 1 <= black < white <= 255
    assert len(page) < 3e6
    assert "http" not in page.replace("http://www.w3.org", "")
    for axis in "xy":
        assert f'<label for="dphi-{axis}">' in page
        assert re.search(rf'<input id="dphi-{axis}" type="range" [^>]*step="0.01" value="0"', page)


def test_slow_phase_and_amplitude_make_the_angles_again(result: Reconstruction, data: dict) -> None:
    grid = result.picture.grid
    for axis, half in zip(data["axes"], (grid.half_angle_x, grid.half_angle_y), strict=True):
        angle = result.motion.axes[axis["name"]].angle.read() / half
        pixels = 0.5 * axis["pixels"] * (angle_again(axis, np.arange(angle.size) / data["rate"]) - angle)
        assert np.sqrt(np.mean(pixels**2)) < 0.1  # the third harmonic is left out


def test_a_long_scan_shows_its_middle_in_runs(
    result: Reconstruction, data: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recon.sweeps, "READ", 60_000)
    monkeypatch.setattr(recon.sweeps, "SHOWN", 20_000)
    intensity = imaging()[0]["intensity"]
    less = sweeps(result)
    assert less["seconds"] == pytest.approx([0.004, 0.016])
    codes = unpacked(less["intensity"], np.uint8)
    assert 19_000 < codes.size <= 20_000
    middle = intensity.read(20_000, 80_000)[kept(less, 60_000)]
    assert np.corrcoef(codes, middle)[0, 1] > 0.999


def test_a_scan_too_short_for_a_slow_phase_has_no_sliders(
    result: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recon.sweeps, "READ", 5_000)
    assert sweeps(result) is None
    section = by_hand(result)
    assert section.sweeps is None
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
    done = subprocess.run(
        [node, tmp_path / "run.js", tmp_path / "data.json"], capture_output=True, text=True, check=True
    )
    expected = own_maps(data, imaging()[0]["intensity"].size)
    for (sums, counts), (own_sums, own_counts) in zip(json.loads(done.stdout), expected, strict=True):
        # The script interpolates straight on beyond the first and last knots, and holds its arrays as float32.
        assert np.mean(np.array(counts) == own_counts.ravel()) > 0.98
        assert np.corrcoef(sums, own_sums.ravel())[0, 1] > 0.98
        assert abs(sum(counts) - int(own_counts.sum())) <= 1e-3 * own_counts.sum()  # at the edge


LOOK = """<pre id="seen"></pre><script>
const seen = { wide: document.documentElement.scrollWidth, inner: innerWidth, told: {}, split: {} };
const split = () => ["x", "y"].map((axis) => {
  const canvas = document.querySelector(`#sweeps-${axis} canvas`);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let apart = 0, shown = 0;
  for (let i = 0; i < data.length; i += 4) if (data[i + 3]) { apart += Math.abs(data[i] - data[i + 1]); shown++; }
  return [apart / shown, shown / (data.length / 4)];
});
const sliders = ["x", "y"].map((axis) => document.getElementById(`dphi-${axis}`));
const move = (slider, degrees) => { slider.value = degrees; slider.dispatchEvent(new Event("input")); };
seen.split.estimate = split();
seen.first = sliders.map((slider) => slider.value);
for (const degrees of [-3, -1, 1, 3]) {
  sliders.forEach((slider) => move(slider, degrees));
  seen.split[degrees] = split();
  seen.told[degrees] = document.querySelector("#sweeps-x output").textContent;
}
document.querySelectorAll(".sweeps button").forEach((button) => button.click());
seen.split.reset = split();
move(sliders[0], 3);
seen.split.x_only = split();
sliders[1].focus();
seen.focus = document.activeElement.id;
document.getElementById("seen").textContent = JSON.stringify(seen);
</script></body>"""


def test_in_a_browser_the_colours_meet_at_the_estimate(result: Reconstruction, page: str, tmp_path: Path) -> None:
    chromium = program(*CHROMIUM)
    (tmp_path / "report.html").write_text(page.replace("</body>", LOOK), encoding="utf-8")
    done = subprocess.run(
        [chromium, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "--window-size=360,800", "--dump-dom",
         (tmp_path / "report.html").as_uri()],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not [line for line in console if "willReadFrequently" not in line]  # which is about LOOK
    seen = json.loads(re.search(r'<pre id="seen">(.*?)</pre>', done.stdout)[1])
    assert seen["wide"] <= seen["inner"]
    assert seen["first"] == ["0", "0"]
    assert seen["focus"] == "dphi-y"
    assert seen["split"]["reset"] == seen["split"]["estimate"]
    for axis in (0, 1):
        met, shown = seen["split"]["estimate"][axis]
        assert shown > 0.6
        assert met < seen["split"]["1"][axis][0] < seen["split"]["3"][axis][0]
        assert met < seen["split"]["-1"][axis][0] < seen["split"]["-3"][axis][0]
    assert seen["split"]["x_only"][0][0] > 1.3 * seen["split"]["estimate"][0][0]
    apart = 200 * np.radians(3) * np.mean(result.motion.axes["x"].amplitude) / result.picture.grid.half_angle_x
    told = re.fullmatch(r"\+3\.00°, sweeps ([\d.]+) px apart", seen["told"]["3"])
    assert float(told[1]) == pytest.approx(apart, abs=0.1)


def test_text_from_a_recording_stays_text() -> None:
    page = render("<script>alert(1)</script>", "</p><b>", [Section("<i>", "&amp;")], ["<img src=x>"])
    assert "<script>" not in page
    assert "<b>" not in page
    assert "<i>" not in page
    assert "<img" not in page


def test_trouble_is_marked_and_its_samples_have_no_place(result: Reconstruction) -> None:
    intensity = imaging()[0]["intensity"]
    affected = np.zeros((160, 200), bool)
    affected[:80] = True
    gap = [Trouble("sense", "gap", 0.005, 0.010)]
    x = result.motion.axes["x"]
    lost_x = replace(x, phase_sd=np.where((x.time > 0.006) & (x.time < 0.009), 10.0, x.phase_sd))
    motion = replace(result.motion, axes={**result.motion.axes, "x": lost_x})
    troubled = replace(result, motion=motion, trouble=gap, affected=affected)
    codes = unpacked(sweeps(troubled)["intensity"], np.uint8)
    lost = samples(unknown(troubled.motion, gap), intensity)
    assert lost
    expected = np.concatenate([np.arange(*each) for each in lost])
    assert np.array_equal(np.flatnonzero(codes == NONE), expected)
    assert "the trouble noted above" in reconstruction_report(troubled, summarise(troubled))
    grey = np.full((160, 200, 3), 100, np.uint8)
    shown = marked(grey, affected)
    assert np.array_equal(shown[80:], grey[80:])
    assert np.all(shown[:80] == (np.array([0xE0, 0x8A, 0x1E]) + 100) // 2)


def test_several_detectors_are_averaged(result: Reconstruction, data: dict) -> None:
    intensity = imaging()[0]["intensity"]
    values = intensity.read()
    raw = np.stack([values + 0.3, values - 0.3], 1)
    pair = replace(intensity, raw=raw, first=0, stop=values.size, gain=1.0, offset=0.0)
    image = result.picture.image[..., None] + np.array([0.3, -0.3], np.float32)
    several = sweeps(replace(result, picture=replace(result.picture, image=image), intensity=pair))
    codes, own = (unpacked(each["intensity"], np.uint8).astype(int) for each in (several, data))
    assert np.abs(codes - own).max() <= 1
    assert several["limits"] == pytest.approx(data["limits"], abs=0.1)


def test_a_long_curve_keeps_its_outliers_and_few_points() -> None:
    time, values = np.arange(1_000_003.0), np.sin(np.arange(1_000_003) / 1e4)
    values[123_456] = 7.0
    at, shown = thinned(time, values)
    assert at.size == shown.size == 2 * SHOWN
    assert (shown.max(), shown.min()) == (7.0, values.min())
    assert at[np.argmax(shown)] == pytest.approx(123_456, abs=1_000_003 / SHOWN)
    assert (np.diff(at) >= 0.0).all()
    assert np.array_equal(thinned(time[:SHOWN], values[:SHOWN])[1], values[:SHOWN])
