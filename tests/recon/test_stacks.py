"""Stacks: where z rests, slices by z, and their files."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import tifffile

import lissajous
from recon.cli import main
from recon.imaging.frame_axis import format_positions, position_axis
from recon.imaging.intensity_gridding import grid_intensity
from recon.pipeline import reconstruct
from recon.sequences.frames import write_scan_frames
from recon.steps.reconstruction import Options, Reconstruction
from recon.steps.z_rests import rest_ranges
from recon.steps.z_slices import ZSlices, find_z_slices
from scanner.channel import Channel, make_channel
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.simulated import imaging
from tests.support.stacks import DURATION_S, MOVE_S, POSITIONS, lights, recording_of, stack, staircase

OME = "{http://www.openmicroscopy.org/Schemas/OME/2016-06}"
LIGHT = make_channel("intensity", np.zeros(300_000, np.float32), unit="V", sample_rate=5e6)


def z_channel(values: np.ndarray, rate: float = 100e3, **stated: float) -> Channel:
    return make_channel("position_z", values, unit="m", sample_rate=rate, **stated)


def times(rate: float = 100e3) -> np.ndarray:
    return np.arange(round(rate * DURATION_S)) / rate


def noise(sd: float, size: int) -> np.ndarray:
    return np.random.default_rng(3).normal(0.0, sd, size)


@pytest.mark.parametrize("sd", [0.0, 10e-9, 25e-9])
@pytest.mark.parametrize("rate", [2e3, 100e3, 5e6])
@pytest.mark.parametrize("positions", [
    tuple(1e-6 * np.arange(10.0)), tuple(-1e-6 * np.arange(5.0)), (0.0, 1e-6, 4e-6, 20e-6), (3e-6, 8e-6),
])  # fmt: skip
def test_each_rest_is_a_slice(positions: tuple[float, ...], rate: float, sd: float) -> None:
    move = 0.1 * DURATION_S / len(positions)
    z = staircase(times(rate), positions, move)
    slices = find_z_slices(z_channel(z + noise(sd, z.size), rate), LIGHT)
    assert slices.positions == pytest.approx(sorted(positions), abs=max(sd, 1e-12))
    labels = slices.labels(0, LIGHT.size)
    steady = np.abs(np.subtract.outer(staircase(LIGHT.time(), positions, move), sorted(positions)))
    assert (steady[labels >= 0, labels[labels >= 0]] < 0.25e-6 + 1.2 * sd).all()  # z is the slice's own
    assert np.bincount(labels[labels >= 0]).min() > 0.5 * LIGHT.size / len(positions)
    for (first, stop), number in zip(slices.spans, range(len(positions)), strict=True):
        assert labels[first] == labels[stop - 1] == number
    assert list(slices.samples) == np.bincount(labels[labels >= 0]).tolist()


@pytest.mark.parametrize("sd", [0.0, 30e-9])
@pytest.mark.parametrize("shape", ["ramp", "triangle", "one period", "resonant"])
def test_a_moving_z_needs_a_step(shape: str, sd: float) -> None:
    t = times()
    z = 10e-6 * {
        "ramp": t / DURATION_S,
        "triangle": np.abs(t / DURATION_S * 6 % 2 - 1),
        "one period": np.sin(2 * np.pi * t / DURATION_S),
        "resonant": np.sin(2 * np.pi * 3210.0 * t),
    }[shape]  # fmt: skip
    channel = z_channel(z + noise(sd, z.size))
    with pytest.raises(BadInput, match=r"does not rest: it moves between .* m for most .*; give --z-step M") as error:
        find_z_slices(channel, LIGHT)
    assert "\n" not in str(error.value)
    assert rest_ranges(channel, LIGHT) == [(0, LIGHT.size)]
    slices = find_z_slices(channel, LIGHT, 1e-6)
    assert np.diff(slices.positions) == pytest.approx(1e-6)
    assert sum(slices.samples) == LIGHT.size
    labels = slices.labels(0, LIGHT.size)
    error_of_z = np.interp(LIGHT.time(), t, z) - np.array(slices.positions)[labels]
    assert np.sqrt(np.mean(error_of_z**2)) < 0.36e-6  # 1 um / sqrt(12), and the noise


def test_steps_are_the_centres_of_the_slices_that_are_sorted_by_z() -> None:
    z = staircase(times(), POSITIONS, MOVE_S)
    slices = find_z_slices(z_channel(z + noise(80e-9, z.size)), LIGHT, 2e-6)
    assert slices.positions == pytest.approx(POSITIONS, abs=50e-9)
    assert sum(slices.samples) == LIGHT.size


def test_a_step_larger_than_the_travel_makes_one_slice_with_a_note() -> None:
    slices = find_z_slices(z_channel(10e-6 * times() / times()[-1]), LIGHT, 1.0)
    note = "position_z: a step of 1 m does not divide the travel of 1e-05 m: the stack has a single slice"
    assert slices.notes == (note,)


@pytest.mark.parametrize("rate", [2e3, 20e3, 100e3])
@pytest.mark.parametrize("gap", [1.5, 2.0])
def test_positions_closer_than_the_noise_that_become_one_slice_are_noted(gap: float, rate: float) -> None:
    sd = 50e-9
    near = gap * sd * np.array([0.0, 1.0])
    z = staircase(times(rate), (*near, *(2e-6 + near), *(4e-6 + near)), MOVE_S)
    slices = find_z_slices(z_channel(z + noise(sd, z.size), rate), LIGHT)
    assert len(slices.positions) <= 3
    (note,) = (each for each in slices.notes if "varies" in each)
    assert "positions closer than 0.2" in note
    assert "give --z-step, their spacing in metres" in note


def test_noise_alone_is_no_variation_within_a_slice() -> None:
    z = staircase(times(), POSITIONS, MOVE_S)
    for seed in range(50):
        noisy = z + np.random.default_rng(seed).normal(0.0, 50e-9, z.size)
        assert not any("varies" in note for note in find_z_slices(z_channel(noisy), LIGHT).notes)


def test_rests_at_one_position_are_one_slice() -> None:
    slices = find_z_slices(z_channel(staircase(times(), (0.0, 1e-6, 2e-6, 0.0, 1e-6, 2e-6), 1e-3)), LIGHT)
    assert slices.positions == pytest.approx((0.0, 1e-6, 2e-6), abs=1e-12)
    assert (np.diff(slices.spans) > LIGHT.size / 2).all()


@pytest.mark.parametrize("sd", [0.0, 20e-9])
def test_a_constant_z_is_one_slice_with_a_note(sd: float) -> None:
    slices = find_z_slices(z_channel(5e-6 + noise(sd, times().size)), LIGHT)
    assert slices.positions == pytest.approx([5e-6], abs=5e-9)
    assert slices.spans == [(0, LIGHT.size)]
    assert slices.notes == ("position_z: does not change beyond its noise: the stack has a single slice",)


def test_a_ramp_in_steps_of_a_converter_is_no_stack() -> None:
    raw = np.arange(times().size) // 24  # 250 steps
    with pytest.raises(BadInput, match="does not rest"):
        find_z_slices(z_channel(raw, gain=40e-9), LIGHT)


def test_missing_samples_belong_to_no_slice() -> None:
    z = staircase(times(), POSITIONS, MOVE_S)
    z[100:400] = np.nan
    z[4000] = np.inf
    slices = find_z_slices(z_channel(z), LIGHT)
    assert slices.positions == pytest.approx(POSITIONS)
    assert (slices.labels(5000, 20_000) == -1).all()  # 1 ms to 4 ms
    assert slices.notes[0] == "position_z: 301 samples without a finite value; the intensity there belongs to no slice"
    assert "belongs to no slice" in slices.notes[1]
    binned = find_z_slices(z_channel(z), LIGHT, 2e-6)
    assert (binned.labels(5000, 20_000) == -1).all()
    with pytest.raises(BadInput, match="position_z: has samples that are not finite throughout"):
        find_z_slices(z_channel(np.full(100, np.nan)), LIGHT)


def test_z_on_another_clock() -> None:
    z = staircase(times(), POSITIONS, MOVE_S)
    half = find_z_slices(z_channel(z[: z.size // 2]), LIGHT)  # ends early
    assert half.spans[-1][1] == LIGHT.size // 2
    longer = np.concatenate([np.full(9000, 1e-3), z, np.full(9000, 1e-3)])  # the stage is far away before and after
    whole = find_z_slices(z_channel(longer, start=-0.09), LIGHT)
    assert whole.positions == pytest.approx(POSITIONS)
    with pytest.raises(BadInput, match="position_z: has no sample during the intensity; check the start"):
        find_z_slices(z_channel(z, start=1.0), LIGHT)
    assert rest_ranges(z_channel(z, start=1.0), LIGHT) == [(0, LIGHT.size)]


@pytest.mark.parametrize("step", [0.0, -1e-6, np.nan, 1e-15])
def test_impossible_steps_are_refused(step: float) -> None:
    with pytest.raises(BadInput, match=r"positive thickness|more than there are samples; give a larger step"):
        find_z_slices(z_channel(staircase(times(), POSITIONS, MOVE_S)), LIGHT, step)


def test_uneven_positions_and_their_texts() -> None:
    assert position_axis([0.0, 1.02e-6, 2e-6]).even
    assert not position_axis([0.0, 1e-6, 4e-6]).even
    assert not position_axis([1e-6]).even
    assert format_positions([-1e-6, 0.0, 1.5e-6]) == ["-1.0", "0.0", "1.5"]
    assert format_positions([1e-6, 1.05e-6]) == ["1.000", "1.050"]
    assert format_positions([2e-3]) == ["2000.00"]


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    return reconstruct(stack(), Options(pixels=(80, 60)), quiet=True)


def test_a_slice_shows_its_own_scene(result: Reconstruction) -> None:
    own = lissajous.frames(result)
    assert own.z == pytest.approx(POSITIONS, abs=5e-9)
    assert own.frame_time is None
    assert own.times == pytest.approx([0.0, 0.02, 0.04], abs=3e-4)
    for frame, light, span in zip(own.estimates(), lights(), own.spans, strict=True):
        alone = recording_of(light)["intensity"]
        expected = grid_intensity(result.beam, alone, result.picture.grid, [], *span)
        assert np.array_equal(frame.picture.coverage, expected.coverage)
        assert np.allclose(frame.picture.image, expected.image, equal_nan=True, rtol=1e-6)
        whole = grid_intensity(result.beam, alone, result.picture.grid, [])
        pull = (frame.picture.image - whole.image) / frame.sd
        assert 0.5 < np.nanstd(pull) < 1.2  # whole holds the samples of the slice too


def test_the_readout_phase_is_measured_at_one_z(result: Reconstruction) -> None:
    """Half-periods at different z show different scenes, which has to remain no error of the phase."""
    assert set(result.readout_phase) == {"x", "y"}
    assert all(np.degrees(phase.sd) < 0.02 for phase in result.readout_phase.values())


def test_posterior_slices_use_no_other_slice(result: Reconstruction) -> None:
    posterior = reconstruct(stack(), Options(pixels=(40, 30), estimator="constant", picture="posterior"), quiet=True)
    own = list(lissajous.frames(posterior).estimates())
    last = find_z_slices(posterior.position_z, posterior.intensity)
    alone = ZSlices(last.positions[2:], last.spans[2:], last.samples[2:], lambda a, b: last.labels(a, b) - 2)
    from recon.sequences.frames import ScanFrames

    frames = ScanFrames(posterior, position_axis(alone.positions), alone.spans, [], True, alone)
    (single,) = frames.estimates()
    assert np.array_equal(single.picture.image, own[2].picture.image, equal_nan=True)


def test_files_state_z(result: Reconstruction, tmp_path: Path) -> None:
    import imageio.v3 as iio
    import zarr
    from ome_zarr_models import v05 as models

    write_scan_frames(tmp_path, result, Options(z_stack=True, zarr=True, movie="gif"))
    for name in ("frames.ome.tif", "frames_sd.ome.tif"):
        with tifffile.TiffFile(tmp_path / name) as file:
            assert (file.series[0].axes, file.series[0].shape) == ("ZYX", (3, 60, 80))
            (pixels,) = ElementTree.fromstring(file.ome_metadata).iter(f"{OME}Pixels")
        assert (pixels.attrib["SizeZ"], pixels.attrib["SizeT"]) == ("3", "1")
        assert float(pixels.attrib["PhysicalSizeZ"]) == pytest.approx(2.0, abs=0.01)
        assert pixels.attrib["PhysicalSizeZUnit"] == "µm"
        planes = list(pixels.iter(f"{OME}Plane"))
        assert [float(plane.attrib["PositionZ"]) for plane in planes] == pytest.approx([10.0, 12.0, 14.0], abs=0.01)
        assert {plane.attrib["PositionZUnit"] for plane in planes} == {"µm"}
    image = models.Image.from_zarr(zarr.open_group(tmp_path / "frames.ome.zarr", mode="r"))
    (multiscale,) = image.attributes.ome.multiscales
    assert [axis.name for axis in multiscale.axes] == ["c", "z", "y", "x"]
    assert multiscale.axes[1].unit == "micrometer"
    scale, translation = multiscale.datasets[0].coordinateTransformations
    assert scale.scale[:2] == pytest.approx([1.0, 2.0], abs=0.01)
    assert translation.translation == pytest.approx([0.0, 10.0, 0.0, 0.0], abs=0.01)
    stored = np.asarray(zarr.open_group(tmp_path / "frames.ome.zarr", mode="r")["0"])
    for part, name in enumerate(("frames.ome.tif", "frames_sd.ome.tif")):
        assert np.array_equal(stored[part], tifffile.imread(tmp_path / name), equal_nan=True)
    assert iio.imread(tmp_path / "frames.gif").shape[0] == 3


def test_uneven_slices_of_several_detectors_have_positions_only(tmp_path: Path) -> None:
    recording = stack(positions=(0.0, 1e-6, 5e-6))
    light = recording["intensity"].read()
    both = make_channel("intensity", np.stack([light, 2 * light], axis=1), unit="V", sample_rate=5e6)
    recording = recording_of(both.read(), staircase(times(20e3), (0.0, 1e-6, 5e-6), MOVE_S), 20e3)
    result = reconstruct(recording, Options(pixels=(40, 30), estimator="constant"), quiet=True)
    write_scan_frames(tmp_path, result, Options(z_stack=True))
    with tifffile.TiffFile(tmp_path / "frames.ome.tif") as file:
        assert (file.series[0].axes, file.series[0].shape) == ("ZCYX", (3, 2, 30, 40))
        (pixels,) = ElementTree.fromstring(file.ome_metadata).iter(f"{OME}Pixels")
    assert "PhysicalSizeZ" not in pixels.attrib
    planes = [(plane.attrib["TheZ"], float(plane.attrib["PositionZ"])) for plane in pixels.iter(f"{OME}Plane")]
    assert dict(planes) == pytest.approx({"0": 0.0, "1": 1.0, "2": 5.0})
    assert len(planes) == 6


def test_xarray_has_z_in_metres(result: Reconstruction) -> None:
    data = lissajous.frames(result).to_xarray()
    assert dict(data.sizes) == {"z": 3, "y": 60, "x": 80}
    assert data["z"].values == pytest.approx(POSITIONS, abs=5e-9)
    assert data["z"].attrs["units"] == "m"
    by_z = lissajous.frames(result, z_step=1e-6)
    assert np.diff(by_z.z) == pytest.approx([1e-6] * 4)
    assert len(lissajous.frames(result, 2)) == 2
    assert lissajous.frames(result, 2).z is None


def test_the_command_writes_a_stack(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    stack().write(tmp_path / "scan.h5")
    command = ["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--estimator", "constant"]
    assert main([*command, "--pixels", "40x40", "--frames"]) == 0
    text = "tack of 3 slices 2.001 µm apart, from z = 10.0 µm to 14.0 µm"
    assert text in capsys.readouterr().out
    assert text in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["stack"]["z_m"] == pytest.approx(POSITIONS, abs=5e-9)
    assert summary["stack"]["even"] is True
    assert any("recorded while z moved" in note for note in summary["notes"])
    assert not any("position_z" in note and "not used" in note for note in summary["notes"])


def test_bad_stacks_end_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    imaging(DURATION_S)[0].write(tmp_path / "without.h5")
    ramp = np.linspace(0.0, 1e-5, 1000)
    recording_of(lights()[0], ramp, 1000 / DURATION_S).write(tmp_path / "ramp.h5")
    out = ["-o", str(tmp_path / "out")]
    for arguments, line in (
        (["without.h5", "--frames"], "position_z: is not in the recording and --frames without a number"),
        (["without.h5", "--z-step", "1e-6"], "position_z: is not in the recording"),
        (["ramp.h5", "--frames"], "ramp.h5: position_z: does not rest: it moves between "),
        (["ramp.h5", "--frames", "3", "--z-step", "1e-6"], "--z-step: sorts the samples by z, not by time"),
        (["ramp.h5", "--z-step", "0"], "--z-step: '0' is not above 0"),
    ):
        try:
            code = main(["reconstruct", str(tmp_path / arguments[0]), *out, *arguments[1:]])
        except SystemExit as ended:
            code = ended.code
        error = capsys.readouterr().err
        assert code == 2
        assert line in error
        assert "Traceback" not in error
        assert not (tmp_path / "out").exists()


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_slice_without_a_value_is_shown_empty_and_without_a_warning(tmp_path: Path) -> None:
    recording = recording_of(lights()[0], staircase(times(20e3), POSITIONS, MOVE_S))
    light = recording["intensity"].read().astype(float)
    light[light.size // 2 :] = np.nan  # from the middle of the second slice on
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    dark = Recording.from_arrays(channels | {"intensity": (light, *channels["intensity"][1:])}, recording.device)
    options = Options(pixels=(40, 40), z_stack=True, movie="gif", sense_only=True)
    write_scan_frames(tmp_path, reconstruct(dark, options, quiet=True), options)
    shares = [np.isfinite(image).mean() for image in tifffile.imread(tmp_path / "frames.ome.tif")]
    assert shares == pytest.approx([1.0, 1.0, 0.0], abs=0.1)
    assert (tmp_path / "frames.gif").stat().st_size > 0
