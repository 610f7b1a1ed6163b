"""``lissajous bidirectional``: phase of every frame, corrected film with its counts, bad films in one line."""

import csv
import json
import re
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from phantoms.raster_film import count_photons, scan_raster_frame
from recon.cli import main
from recon.film_correction import correct_film
from recon.imaging.raster.film_phase import fit_film, frame_phase, own_phase, with_reference
from recon.imaging.raster.line_shift import correct_frame, to_dtype
from recon.imaging.raster.phase_smoothing import smooth_phases
from recon.io.film import open_film
from scanner.errors import BadInput

FILL = 0.85
SHIFTS = 2.0 + 0.05 * np.arange(12)


def spots(seed: int, side: int = 300) -> np.ndarray:
    """Soft bright discs on a dark ground, shape (side, side)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:side, :side]
    picture = np.full((side, side), 0.05)
    for _ in range(side // 4):
        row, column, radius = *rng.uniform(0, side, 2), rng.uniform(3.0, 7.0)
        picture += rng.uniform(0.2, 1.0) * np.exp(-((np.hypot(y - row, x - column) / radius) ** 4))
    return picture


def film(shifts: np.ndarray, lines: int = 128, photons: float = 20.0, fill: float = FILL) -> np.ndarray:
    picture = spots(1)
    frames = [scan_raster_frame(picture, (lines, 128), shift, fill, 1.0) for shift in shifts]
    return np.array([count_photons(frame, photons, seed) for seed, frame in enumerate(frames)])


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return film(SHIFTS)


@pytest.mark.parametrize("dtype", ["<u2", ">u2", ">f4"])
def test_the_byte_order_of_a_film_does_not_change_its_pixels(dtype: str, tmp_path: Path) -> None:
    pixels = np.random.default_rng(772042).integers(0, 4000, (3, 16, 24)).astype(dtype)
    tifffile.imwrite(tmp_path / "film.tif", pixels, photometric="minisblack", byteorder=dtype[0])
    stored = open_film(tmp_path / "film.tif")
    assert stored.offset is not None
    np.testing.assert_array_equal(np.concatenate(list(stored.read(range(3)))), pixels)


@pytest.mark.slow
def test_phase_of_every_frame_and_the_lag_are_found(frames: np.ndarray, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "film.tif", frames, imagej=True, metadata={"axes": "TYX", "finterval": 0.03})
    assert main(["bidirectional", str(tmp_path / "film.tif"), "-o", str(tmp_path / "out")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "corrected.tif",
        "phase.csv",
        "summary.json",
        "report.html",
    }
    with (tmp_path / "out" / "phase.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    shift, sd = (np.array([float(row[key]) for row in rows]) for key in ("shift_px", "sd_px"))
    assert (np.abs(shift - SHIFTS) < 5 * sd).all()
    assert sd.max() < 0.05
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    fill = summary["fill_fraction"]
    assert abs(fill["value"] - FILL) < 5 * fill["sd"]
    counts, written = summary["counts"], tifffile.imread(tmp_path / "out" / "corrected.tif")
    assert written.dtype == np.uint16
    assert counts["recorded"] == frames.sum()
    assert counts["corrected"] == written.sum()
    # a line is rounded to half a count
    assert abs(counts["recorded"] - counts["corrected"] - counts["beyond_border"]) < 0.5 * frames.shape[0] * 128
    assert summary["rows_rms"]["corrected"] < 0.7 * summary["rows_rms"]["recorded"]
    with tifffile.TiffFile(tmp_path / "out" / "corrected.tif") as corrected:
        assert corrected.imagej_metadata is not None
        assert corrected.imagej_metadata["finterval"] == 0.03


@pytest.mark.slow
def test_frames_are_found_to_their_standard_errors() -> None:
    shifts = np.random.default_rng(2).uniform(-5.0, 5.0, 40)
    recorded = [[frame.astype(np.float32)] for frame in film(shifts)]
    model = fit_film(recorded[:8])
    found = [own_phase(frame, model, model.typical) for frame in recorded]
    z = np.array([(phase.shift - s) / phase.sd for phase, s in zip(found, shifts, strict=True)])
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.5


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_a_reference_makes_the_phase_of_a_noisy_frame_more_precise() -> None:
    shifts = np.random.default_rng(3).uniform(2.0, 4.0, 24)
    texture = 1.0 + 2.0 * cv2.GaussianBlur(np.random.default_rng(3).normal(size=(300, 300)), (0, 0), 3.0)
    scans = [scan_raster_frame(np.maximum(texture, 0.1), (128, 128), shift, FILL) for shift in shifts]
    recorded = [[count_photons(scan, 20.0, seed).astype(np.float32)] for seed, scan in enumerate(scans)]
    model = fit_film(recorded[:8])
    referred = with_reference(model, enumerate(recorded), dict(enumerate(recorded[:8])))
    own = [own_phase(frame, model, 3.0).shift - s for frame, s in zip(recorded, shifts, strict=True)]
    found = [frame_phase(frame, k, referred, 3.0)[0] for k, frame in enumerate(recorded)]
    error = [phase.shift - s for phase, s in zip(found, shifts, strict=True)]
    assert rms(error) < 0.8 * rms(own)
    assert 0.7 < rms([e / phase.sd for e, phase in zip(error, found, strict=True)]) < 1.4


@pytest.mark.slow
def test_a_reference_of_a_moving_or_another_specimen_does_not_bias_the_phase() -> None:
    """Half of the frames show a specimen that moves by up to 6 pixels, the other half another one."""
    rng = np.random.default_rng(5)
    shifts, here, other = rng.uniform(2.0, 4.0, 32), spots(1), spots(2)
    recorded = []
    for k, shift in enumerate(shifts):
        picture = np.roll(here, rng.integers(-12, 13, 2), (0, 1)) if k < 16 else other
        frame = scan_raster_frame(picture, (128, 128), shift, FILL, 1.0)
        recorded.append([count_photons(frame, 10.0, k).astype(np.float32)])
    sampled = recorded[::4]
    model = with_reference(
        fit_film(sampled), enumerate(recorded[:16]), dict(zip(range(0, 32, 4), sampled, strict=True))
    )
    found = [frame_phase(frame, k, model, 3.0)[0] for k, frame in enumerate(recorded)]
    z = [(phase.shift - s) / phase.sd for phase, s in zip(found, shifts, strict=True)]
    assert rms(z[:16]) < 1.5
    assert rms(z[16:]) < 1.5
    own = [own_phase(frame, model, 3.0) for frame in recorded]
    assert np.median([a.sd / b.sd for a, b in zip(found[:16], own, strict=False)]) < 1.0
    assert np.median([a.sd / b.sd for a, b in zip(found[16:], own[16:], strict=True)]) < 1.05
    offsets = [member.offset for member in model.reference.members.values()]
    assert np.ptp(offsets, axis=0).min() > 4


def test_a_constant_shift_has_the_same_lag_in_all_columns() -> None:
    recorded = [[frame.astype(np.float32)] for frame in film(np.full(4, 3.0), fill=0.0)]
    model = fit_film(recorded)
    assert model.fill < 0.3
    assert abs(own_phase(recorded[0], model, 3.0).shift - 3.0) < 0.15


@pytest.mark.parametrize("good", [1, 2])
def test_blank_frames_leave_the_phase_of_the_others(good: int) -> None:
    recorded = [[frame.astype(np.float32)] for frame in film(np.full(good, 3.0))]
    alone, blank = fit_film(recorded), [np.full((128, 128), 7.0, np.float32)]
    model = fit_film([*recorded, *[blank] * 3])
    assert (model.typical, model.own_sd, model.smoothing) == (alone.typical, alone.own_sd, alone.smoothing)
    with pytest.raises(BadInput, match="too little structure"):
        fit_film([blank])


def test_the_frame_that_the_report_shows_is_not_blank(tmp_path: Path) -> None:
    frames = film(np.full(3, 2.0))
    frames[1] = 7
    tifffile.imwrite(tmp_path / "film.tif", frames, photometric="minisblack")
    result = correct_film(open_film(tmp_path / "film.tif"), tmp_path / "corrected.tif", quiet=True)
    assert any(np.array_equal(result.before, frame) for frame in frames[[0, 2]])
    assert np.ptp(result.after) > 0.0


def test_no_count_is_lost_between_the_borders() -> None:
    frame = np.zeros((20, 64))
    frame[:, 20:44] = np.random.default_rng(0).poisson(3.0, (20, 24))
    corrected, beyond = correct_frame(frame, 4.3, 0.7)
    assert corrected.min() >= 0.0
    assert abs(beyond) < 1e-9
    assert np.allclose(corrected.sum(axis=1), frame.sum(axis=1))
    whole, clipped = to_dtype(corrected, np.dtype(np.uint8))
    assert clipped == 0
    assert np.array_equal(whole.sum(axis=1), frame.sum(axis=1))


def test_a_shift_of_whole_pixels_moves_values_unchanged() -> None:
    frame = np.random.default_rng(0).uniform(1.0, 2.0, (20, 64))
    for means in (False, True):
        corrected, _ = correct_frame(frame, 4.0, 0.0, means)
        assert np.allclose(corrected[0::2, 2:], frame[0::2, :-2])
        assert np.allclose(corrected[1::2, :-2], frame[1::2, 2:])
        assert (np.isnan(corrected[0, :2]) if means else corrected[0, :2] == 0).all()


def test_smoothing_bridges_frames_without_a_phase_and_follows_the_rest() -> None:
    rng = np.random.default_rng(4)
    truth = np.cumsum(rng.normal(0.0, 0.01, 400))
    sd = np.full(400, 0.05)
    value = truth + rng.normal(0.0, sd)
    value[100:110], sd[100:110] = np.nan, np.inf
    smooth, smooth_sd = smooth_phases(value, sd)
    error = smooth - truth
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert smooth_sd[105] > smooth_sd[50]
    assert 0.85 < np.mean(np.abs(error) < 1.96 * smooth_sd) <= 1.0


def test_an_error_that_all_frames_share_is_not_averaged_away() -> None:
    value = 1.0 + np.random.default_rng(4).normal(0.0, 0.01, 200)
    _, sd = smooth_phases(value, np.full(200, 0.05), shared_sd=0.04)
    assert sd.min() > 0.04
    assert sd.max() < 0.06


def test_channels_of_a_frame_share_one_phase(frames: np.ndarray, tmp_path: Path) -> None:
    both = np.stack([frames, frames // 2], axis=1)
    tifffile.imwrite(tmp_path / "film.tif", both, imagej=True, metadata={"axes": "TCYX"})
    recorded = open_film(tmp_path / "film.tif")
    assert (recorded.frames, recorded.channels) == (12, 2)
    result = correct_film(recorded, tmp_path / "corrected.tif", quiet=True)
    assert np.abs(result.shift - SHIFTS).max() < 0.15
    assert tifffile.imread(tmp_path / "corrected.tif").shape == both.shape


@pytest.mark.parametrize(("unit", "length"), [({"unit": "um"}, "5 um"), ({}, "10 px")])
def test_pictures_of_the_report_have_a_length_and_a_grey_scale(unit: dict, length: str, tmp_path: Path) -> None:
    path = tmp_path / "film.tif"
    tifffile.imwrite(path, film(SHIFTS[:3]), imagej=True, metadata={"axes": "TYX", **unit}, resolution=(2.0, 2.0))
    assert main(["bidirectional", str(path), "-o", str(tmp_path / "out")]) == 0
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count(f"{length}</span>") == 2
    assert page.count('class="grey"') == 2


def test_black_and_white_of_a_film_on_a_large_offset_have_different_labels(tmp_path: Path) -> None:
    path = tmp_path / "film.tif"
    tifffile.imwrite(path, film(SHIFTS[:3]).astype(np.uint16) + 30_000, photometric="minisblack")
    assert main(["bidirectional", str(path), "-o", str(tmp_path / "out"), "--values", "means"]) == 0
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    black, white = re.search(r'<span class="grey">(\d+)<i></i>(\d+)</span>', page).groups()
    assert 30_000 <= int(black) < int(white) < 31_000


def test_compressed_films_and_odd_lines_are_read(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "film.tif", film(SHIFTS[:3], 129), photometric="minisblack", compression="zlib")
    result = correct_film(open_film(tmp_path / "film.tif"), tmp_path / "corrected.tif", quiet=True)
    assert np.abs(result.shift - SHIFTS[:3]).max() < 0.15
    assert any("odd" in note for note in result.summary()["notes"])


@pytest.mark.slow
def test_memory_does_not_grow_with_the_film(tmp_path: Path) -> None:
    one = film(SHIFTS[:1], 128)[0].astype(np.float32)
    tifffile.imwrite(tmp_path / "film.tif", (one for _ in range(200)), shape=(200, 128, 128), dtype=np.float32)
    recorded = open_film(tmp_path / "film.tif")
    correct_film(recorded, tmp_path / "first.tif", quiet=True)
    tracemalloc.start()
    correct_film(recorded, tmp_path / "corrected.tif", quiet=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.5 * 200 * one.nbytes


def test_measured_two_photon_frame(measured_data: Path, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "film.tif", np.load(measured_data / "two_photon_bidirectional" / "raw.npy"))
    result = correct_film(open_film(tmp_path / "film.tif"), tmp_path / "corrected.tif", quiet=True)
    recorded, corrected, constant = result.rows_rms
    assert recorded > 100.0
    assert corrected < 10.5
    assert constant > 15.0
    assert np.degrees(abs(result.shift[0]) * result.model.fill / 512) == pytest.approx(0.98, abs=0.03)


def test_bad_films_end_in_one_line(frames: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    mirrored = frames.copy()
    mirrored[:, 1::2] = mirrored[:, 1::2, ::-1]
    bad = {
        "colour": (np.zeros((64, 64, 3), np.uint8), {"photometric": "rgb"}, "colour"),
        "line": (np.zeros((3, 1, 64), np.uint8), {"photometric": "minisblack"}, "1 lines"),
        "constant": (np.full((3, 64, 64), 7, np.uint8), {"photometric": "minisblack"}, "too little structure"),
        "noise": (
            np.random.default_rng(0).poisson(5.0, (3, 64, 64)).astype(np.uint8),
            {"photometric": "minisblack"},
            "too little structure",
        ),
        "nan": (np.full((3, 64, 64), np.nan, np.float32), {"photometric": "minisblack"}, "finite"),
        "mirrored": (mirrored, {"photometric": "minisblack"}, "not reversed"),
        "complex": (np.zeros((3, 64, 64), np.complex64), {"photometric": "minisblack"}, "complex64"),
    }
    for name, (pixels, form, message) in bad.items():
        path = tmp_path / f"{name}.tif"
        tifffile.imwrite(path, pixels, **form)
        assert main(["bidirectional", str(path), "-o", str(tmp_path / "out")]) == 2, name
        error = capsys.readouterr().err.strip()
        assert message in error, (name, error)
        assert len(error.splitlines()) == 1
    (tmp_path / "text.tif").write_text("no film", encoding="utf-8")
    tifffile.imwrite(tmp_path / "cut.tif", frames)
    (tmp_path / "cut.tif").write_bytes((tmp_path / "cut.tif").read_bytes()[:-40000])
    for name in ("text", "cut", "missing"):
        assert main(["bidirectional", str(tmp_path / f"{name}.tif"), "-o", str(tmp_path / "out")]) == 2, name
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
