"""Optical angles: the same picture, with every reported angle twice the mechanical one and named as optical."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from recon.cli import main
from recon.imaging.picture import grid_of_scan
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.stages import Scan
from tests.support.simulated import imaging


def test_an_optical_field_covers_half_the_mechanical_angle() -> None:
    grid = grid_of_scan(40, 30, Scan(0.36, 0.3, 1e-3, "optical"))
    assert grid == replace(grid_of_scan(40, 30, Scan(0.18, 0.15, 2e-3)), angle="optical")
    assert grid.reported_half_angles == (0.36, 0.3)


def test_the_kind_of_angle_is_kept_in_the_device_file_and_checked() -> None:
    text = '[x.mechanics]\nJ = 1\nb = 1\nk = 1\n[scan]\nhalf_angle_x = 0.3\nhalf_angle_y = 0.3\nangle = "optical"\n'
    device = Device.from_toml(text)
    assert Device.from_toml(device.to_toml()) == device
    assert device.require_scan().mechanical_half_angles == (0.15, 0.15)
    with pytest.raises(DeviceInvalid, match=r"scan\.angle: 'beam' is unknown; write one of mechanical, optical"):
        Device.from_toml(text.replace("optical", "beam"))


def test_files_and_reports_state_optical_angles(tmp_path: Path) -> None:
    recording, _ = imaging()
    device = recording.device
    assert device is not None
    optical = replace(device, scan=Scan(0.36, 0.36, angle="optical"))
    replace(recording, device_toml=optical.to_toml()).write(tmp_path / "optical.h5")
    recording.write(tmp_path / "mechanical.h5")
    summaries, images = {}, {}
    for kind in ("mechanical", "optical"):
        out = tmp_path / kind
        arguments = [str(tmp_path / f"{kind}.h5"), "-o", str(out), "--pixels", "60x60", "--estimator", "constant"]
        assert main(["reconstruct", *arguments]) == 0
        summaries[kind] = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        images[kind] = tifffile.imread(out / "image.tif")
        assert summaries[kind]["angle"] == kind
        page = (out / "report.html").read_text(encoding="utf-8")
        assert f"mrad {kind}" in page
    assert np.array_equal(images["mechanical"], images["optical"], equal_nan=True)
    optical_amplitude, amplitude = (summaries[kind]["x"]["amplitude_rad"] for kind in ("optical", "mechanical"))
    assert optical_amplitude == pytest.approx(2 * amplitude)
    motions = (tmp_path / kind / "motion.h5" for kind in ("optical", "mechanical"))
    with h5py.File(next(motions)) as own, h5py.File(next(motions)) as other:
        assert own.attrs["angle"] == "optical"
        assert own["x/angle"][:100] == pytest.approx(2 * other["x/angle"][:100], rel=1e-6)
        assert own["y/amplitude"][:] == pytest.approx(2 * other["y/amplitude"][:])
        assert own["x/phase"][:] == pytest.approx(other["x/phase"][:])


def test_amplitudes_are_lengths_where_the_device_states_the_scale_of_the_sample(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    recording, _ = imaging()
    device = recording.device
    assert device is not None
    scaled = replace(device, scan=Scan(0.18, 0.18, 1e-3))
    replace(recording, device_toml=scaled.to_toml()).write(tmp_path / "scan.h5")
    arguments = [str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--pixels", "60x60", "--estimator", "constant"]
    assert main(["reconstruct", *arguments]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    length = summary["x"]["amplitude_um"]
    assert length == pytest.approx(1e3 * summary["x"]["amplitude_rad"])
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "amplitude on the sample [µm]" in page
    assert f"{length:.4g} µm on the sample; sign" in capsys.readouterr().out
