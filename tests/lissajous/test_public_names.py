"""The public names: they exist, are imported at first use, take recordings and files, and print in a few lines."""

from __future__ import annotations

import ast
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import lissajous
from scanner import devices
from tests.support.simulated import imaging

ROOT = Path(__file__).parent.parent.parent
REQUIRED_NAMES = {
    "Recording", "Device", "Motion", "Picture", "simulate", "estimate", "reconstruct", "diagnose", "identify",
    "predict", "convert", "design", "blur_study", "BadInput", "__version__",
}  # fmt: skip


def test_every_public_name_exists_and_is_listed() -> None:
    assert set(lissajous.__all__) >= REQUIRED_NAMES
    assert dir(lissajous) == sorted(lissajous.__all__)
    for name in lissajous.__all__:
        assert getattr(lissajous, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'reconstrct'"):
        lissajous.reconstrct  # noqa: B018


def test_type_checkers_find_the_same_names() -> None:
    tree = ast.parse((ROOT / "lissajous" / "__init__.py").read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    names = {
        alias.asname or alias.name for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    names |= {
        node.target.id for node in block.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    assert names == set(lissajous.__all__)


def test_importing_the_package_imports_nothing_else() -> None:
    code = "import sys, lissajous; print({'numpy', 'scanner', 'recon'} & {m.split('.')[0] for m in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_no_package_imports_the_public_one() -> None:
    for package in ("scanner", "phantoms", "estimation", "recon"):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            assert "import lissajous" not in text, path
            assert "from lissajous" not in text, path


def test_a_simulation_is_written_and_reconstructed_from_its_file(tmp_path: Path) -> None:
    simulation = lissajous.simulate(duration=0.006, target="siemens_star", seed=3)
    simulation.write(tmp_path / "scan.h5")
    assert simulation.recording.duration == pytest.approx(0.006)
    from_file = lissajous.reconstruct(tmp_path / "scan.h5", pixels=(100, 100))
    from_memory = lissajous.reconstruct(simulation.recording, pixels=(100, 100), truth=simulation.truth)
    assert from_file.picture.image.shape == (100, 100)
    np.testing.assert_array_equal(from_file.picture.coverage, from_memory.picture.coverage)
    for axis in "xy":
        assert from_file.evaluation[axis].phase_rmse == from_memory.evaluation[axis].phase_rmse < np.radians(0.1)
    for result in (*simulation[:1], simulation, from_file, from_file.motion, from_file.picture):
        assert len(repr(result).splitlines()) < 16
        assert max(map(len, repr(result).splitlines())) < 200


def test_a_device_is_given_by_name_by_file_or_as_an_object(tmp_path: Path) -> None:
    named = lissajous.load_device("imaging")
    (tmp_path / "device.toml").write_text(named.to_toml(), encoding="utf-8")
    assert lissajous.load_device(tmp_path / "device.toml") == lissajous.load_device(named) == named
    assert "imaging" in repr(named)
    recording, _ = imaging()
    without = lissajous.Recording.from_arrays(
        {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    )
    phases = [lissajous.estimate(without, device).axes["x"].phase for device in (named, tmp_path / "device.toml")]
    np.testing.assert_array_equal(*phases)
    with pytest.raises(lissajous.BadInput, match="states no device"):
        lissajous.estimate(without)


def test_predict_and_diagnose_take_one_recording_or_several(tmp_path: Path) -> None:
    recording, _ = imaging()
    recording.write(tmp_path / "scan.h5")
    predicted = lissajous.predict(tmp_path / "scan.h5")
    assert set(predicted) == {"sense"}
    assert "rmse" in repr(predicted)
    with pytest.raises(lissajous.BadInput, match="states no device"):
        lissajous.identify(lissajous.Recording.from_arrays({"sense": (np.arange(9.0), "V", 1e6)}))


def test_convert_reads_and_writes_an_instruments_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "capture.npz", a=np.arange(100.0))
    mapping = {"channels": {"sense_x": {"variable": "a", "unit": "mV", "sample_rate": 1e3}}}
    lazy = lissajous.convert(tmp_path / "capture.npz", mapping)
    written = lissajous.convert(tmp_path / "capture.npz", mapping, tmp_path / "recording.h5")
    for recording in (lazy, written):
        np.testing.assert_allclose(recording["sense_x"].read(), 1e-3 * np.arange(100.0))


def test_design_lists_pairs_best_first() -> None:
    found = lissajous.design("imaging", pixels=(200, 200), frame_rate=60.0, fill=0.85)
    assert found.candidates[0].figure.frame_rate >= 60.0
    assert "pictures a second" in repr(found)


@pytest.mark.parametrize(
    ("channel", "message"),
    [
        (np.zeros(3), "is not a tuple of 3 or 4 items; give"),
        ((np.zeros((3, 2)), "V", 1e3), "has shape (3, 2); store it as (n,)"),
        (([[1.0], [2.0, 3.0]], "V", 1e3), "rows differ in length"),
        ((np.ones(3), "furlong", 1e3), "unit 'furlong' is unknown"),
        ((np.ones(3), "V", "fast"), "sample_rate is 'fast', not a finite number"),
    ],
)
def test_from_arrays_states_what_it_expects(channel: object, message: str) -> None:
    with pytest.raises(lissajous.BadInput) as raised:
        lissajous.Recording.from_arrays({"sense_x": channel})  # type: ignore[dict-item]
    assert "sense_x" in str(raised.value)
    assert message in str(raised.value)


def test_arrays_are_reconstructed_without_a_file() -> None:
    recording, _ = imaging()
    cut = recording.slice(0.0, 0.004)
    arrays = {name: channel.read() for name, channel in cut.channels.items()}
    given = {"estimator": "constant", "pixels": (60, 60)}
    result = lissajous.reconstruct(arrays, recording.device, sample_rate=5e6, **given)  # type: ignore[arg-type]
    same = lissajous.reconstruct(cut, **given)  # type: ignore[arg-type]
    assert np.array_equal(result.picture.image, same.picture.image, equal_nan=True)
    tuples = {name: (values, "" if name == "intensity" else "V", 5e6) for name, values in arrays.items()}
    again = lissajous.reconstruct(tuples, recording.device, **given)  # type: ignore[arg-type]
    assert np.array_equal(again.picture.image, same.picture.image, equal_nan=True)
    with pytest.raises(lissajous.BadInput, match="drive_x: is an array without a sample rate"):
        lissajous.reconstruct({"drive_x": arrays["drive_x"]}, recording.device)
    with pytest.raises(lissajous.BadInput, match="sample_rate: is for arrays"):
        lissajous.reconstruct(cut, sample_rate=5e6)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"p": 0}, "p: is 0; give a positive number of pixels"),
        ({"p": "1"}, "p: is '1'"),
        ({"spot": -1.0}, "spot: is -1.0"),
        ({"intensity_drift": "bleaching"}, "intensity_drift: is 'bleaching'; give 'offset', 'gain' or None"),
        ({"flip_x": "no"}, "flip_x: is 'no'; give True or False"),
        ({"sense_only": "no"}, "sense_only: is 'no'; give True or False"),
    ],
)
def test_reconstruct_refuses_a_value_without_a_meaning(option: dict, message: str) -> None:
    with pytest.raises(lissajous.BadInput, match=message):
        lissajous.reconstruct(imaging()[0], **option)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"seed": -1}, "seed: is -1; give a whole number, 0 or greater"),
        ({"seed": 1.5}, "seed: is 1.5"),
        ({"drive_x": "27680,30,30"}, "drive_x: is '27680,30,30'; give frequency"),
        ({"drive_x": 27680}, "drive_x: is 27680"),
        ({"drive_y": (6540.0, 30.0)}, "drive_y: is"),
        ({"drive_y": (6540.0, 30.0, np.nan)}, "drive_y: is"),
        ({"angles": "no"}, "angles: is 'no'; give True or False"),
    ],
)
def test_simulate_refuses_a_value_without_a_meaning(option: dict, message: str) -> None:
    with pytest.raises(lissajous.BadInput, match=message):
        lissajous.simulate(duration=0.001, **option)


@pytest.mark.parametrize("function", [lissajous.estimate, lissajous.reconstruct, lissajous.diagnose, lissajous.predict])
@pytest.mark.parametrize("source", [None, 3, np.zeros(5)])
def test_what_is_no_recording_is_named(function: Callable, source: object) -> None:
    with pytest.raises(lissajous.BadInput, match=r"recording: is a \w+, no recording; give a Recording"):
        function(source)


def small_recording() -> lissajous.Recording:
    channels = {"sense_x": (np.arange(5.0), "V", 1e3), "sync_y": ([0.1, 0.2], "s", {"event": "zero-crossing-up"})}
    return lissajous.Recording.from_arrays(channels, "imaging", name="small")


def test_recordings_in_memory_and_simulations_are_pickled(tmp_path: Path) -> None:
    recording = small_recording()
    copy = pickle.loads(pickle.dumps(recording))
    assert (repr(copy), copy.attrs, copy.device) == (repr(recording), recording.attrs, recording.device)
    np.testing.assert_array_equal(copy["sense_x"].read(), recording["sense_x"].read())
    np.testing.assert_array_equal(copy.edges["sync_y"].times, recording.edges["sync_y"].times)
    simulated = lissajous.simulate(duration=0.001)
    assert repr(pickle.loads(pickle.dumps(simulated))) == repr(simulated)
    recording.write(tmp_path / "small.h5")
    with (
        lissajous.Recording.open(tmp_path / "small.h5") as opened,
        pytest.raises(
            lissajous.BadInput, match=r"small\.h5: cannot be pickled: its channels are read from an open file"
        ),
    ):
        pickle.dumps(opened)


def test_from_arrays_takes_the_name_of_a_device() -> None:
    recording = lissajous.Recording.from_arrays({"sense": (np.zeros(3), "V", 1e3)}, "imaging")
    assert recording.device == lissajous.load_device("imaging")


def test_a_bound_needs_positive_numbers_of_pixels() -> None:
    assert lissajous.phase_bound(1, 200) == 0.005
    for p, m in ((0.0, 200), (1, 0), (-1, -3)):
        with pytest.raises(lissajous.BadInput, match="give positive numbers of pixels"):
            lissajous.phase_bound(p, m)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lissajous.simulate(photons="a"), "photons: is 'a'; give a number"),
        (lambda: lissajous.Grid("a", 10, 0.1, 0.1), "width: is 'a'; give a whole number"),
        (lambda: lissajous.Grid(10, 10.5, 0.1, 0.1), "height: is 10.5; give a whole number"),
        (lambda: lissajous.Grid(10, 10, 0.1, None), "half_angle_y: is None; give a number"),
        (lambda: lissajous.Grid(10, 10, 0.1, 0.1, angle="foo"), "angle: is 'foo'; give 'mechanical' or 'optical'"),
        (lambda: lissajous.Grid(10, 10, 0.1, 0.1, "x"), "metres_per_radian: is 'x'; give a number"),
        (lambda: lissajous.Grid(10, 10, 0.1, 0.1, -1.0), "metres_per_radian: is -1.0; give a positive"),
        (
            lambda: lissajous.map_samples(*np.zeros((3, 5)), (10, 10)),
            "grid: is a tuple, no Grid; give a lissajous.Grid",
        ),
        (lambda: lissajous.reconstruct(small_recording(), truth=3), "truth: is a int, no Mapping; give the truth"),
        (lambda: lissajous.frames(small_recording()), "result: is a Recording, no Reconstruction; give what"),
        (lambda: lissajous.Device.from_toml(3), "text: is a int, no str; give the text"),
        (lambda: lissajous.phase_bound("a", 100.0), "p: is 'a'; give a number"),
        (lambda: lissajous.design(frame_rate="a"), "frame_rate: is 'a'; give a number"),
        (lambda: lissajous.design(volts="ab"), "volts: is 'ab'; give amplitude and offset"),
        (lambda: lissajous.design(pixels=400), r"pixels: is 400; give width and height, as \(400, 400\)"),
        (lambda: lissajous.design(pixels=(400.0, 400)), r"pixels: is \(400.0, 400\); give width and height"),
        (lambda: lissajous.design(half_angles=0.1), "half_angles: is 0.1; give half the field in x and y"),
        (lambda: lissajous.simulate(target=["a"]), r"target: is \['a'\]; give the name of a target"),
        (lambda: lissajous.design(volts=(1.0,)), "volts: is .*; give amplitude and offset"),
    ],
)
def test_an_argument_of_another_type_is_named(call: Callable, message: str) -> None:
    with pytest.raises(lissajous.BadInput, match=f"^{message}"):
        call()


@pytest.mark.parametrize(
    "function",
    [lissajous.estimate, lissajous.reconstruct, lissajous.diagnose, lissajous.predict, lissajous.identify],
)
def test_a_missing_device_is_asked_for_as_an_argument(function: Callable) -> None:
    recording = lissajous.Recording.from_arrays({"sense_x": (np.sin(np.arange(100.0)), "V", 1e3)})
    with pytest.raises(lissajous.BadInput, match=r"states no device; give one as device=$"):
        function(recording)


def test_a_table_of_columns_is_no_recording_and_the_message_says_how_to_give_it() -> None:
    class Table(dict):  # as a DataFrame, which the tests do not need to install
        columns = ("sense_x",)

    with pytest.raises(lissajous.BadInput, match=r"is a Table, no recording; give dict\(table\) and sample_rate="):
        lissajous.estimate(Table())


def test_a_table_that_is_no_mapping_is_named_although_a_sample_rate_is_given() -> None:
    with pytest.raises(lissajous.BadInput, match=r"recording: is a SimpleNamespace, no recording; give dict\(table\)"):
        lissajous.reconstruct(SimpleNamespace(columns=("sense_x",)), sample_rate=1e6)
    with pytest.raises(lissajous.BadInput, match="sample_rate: is for arrays; a recording has its own rates"):
        lissajous.reconstruct(small_recording(), sample_rate=1e6)


@pytest.mark.parametrize("function", [lissajous.estimate, lissajous.predict, lissajous.reconstruct])
def test_an_error_in_the_device_names_the_file_of_the_device(tmp_path: Path, function: Callable[..., object]) -> None:
    text = devices.load("imaging").to_toml()
    begin = text.index("[y.capacitance]")
    (tmp_path / "device.toml").write_text(text[:begin] + text[text.index("[", begin + 1) :], encoding="utf-8")
    with pytest.raises(lissajous.BadInput, match="is missing and needed here") as error:
        function(imaging()[0], tmp_path / "device.toml")
    assert str(error.value).startswith(f"{tmp_path / 'device.toml'}: y.capacitance: ")
