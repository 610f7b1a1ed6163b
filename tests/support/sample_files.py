"""Small intact files of every readable format."""

from __future__ import annotations

import io
import wave
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from scipy.io import savemat, wavfile

from scanner.recording import Recording

RNG = np.random.default_rng(0)
V = RNG.standard_normal(1500)
TWO = (100 * RNG.standard_normal((300, 2))).astype("i2")
MEASURED = (
    "DS1054Z-A.csv", "DS2072A-1.csv", "rs_rtp_01.Wfm.csv", "Digital_Input.tdms", "big_endian.tdms", "raw1.tdms",
    "raw_timestamps.tdms", "DS1054Z-A.wfm", "agilent_1.bin", "lecroy_3.trc", "lecroy_4.trc",
)  # fmt: skip


def written(write: Callable[..., object], *args: object, **kwargs: object) -> bytes:
    """The bytes that ``write`` writes to a file."""
    file = io.BytesIO()
    write(file, *args, **kwargs)
    return file.getvalue()


def _wav_24(file: io.BytesIO) -> None:
    with wave.open(file, "wb") as out:
        out.setparams((1, 3, 8000, 0, "NONE", ""))
        out.writeframes(bytes(range(250)) * 12)


def _matlab_73(file: io.BytesIO) -> None:
    with h5py.File(file, "w") as out:
        for name, values in (("x", V[None]), ("z", TWO.T), ("s/a", V[None, :50])):
            dataset = out.create_dataset(name, data=values, chunks=(values.shape[0], 50), compression="gzip")
            dataset.attrs["MATLAB_class"] = np.bytes_("double")


def recording(path: Path) -> bytes:
    """A recording with positions, drive and intensity, some chunked, some packed, some as integers."""
    time = np.arange(20_000) / 1e6
    x, y = 0.1 * np.sin(2 * np.pi * 2000 * time), 0.1 * np.sin(2 * np.pi * 2300 * time)
    light = np.cos(30 * x) * np.cos(20 * y)
    device = "\n".join(f'[{a}.readout]\nkind = "position"\ngain = 1.0\nnoise_sd = 1e-4' for a in "xy")
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "lissajous-recording", "version": 1, "name": "whole"})
        group = file.create_group("channels")
        group.create_dataset("sense_x", data=x)
        group.create_dataset("sense_y", data=y, chunks=(1000,))
        group.create_dataset("intensity", data=light.astype("f4"), chunks=(1000,), compression="gzip")
        for dataset in group.values():
            dataset.attrs.update({"unit": "V", "sample_rate": 1e6, "start": 0.0})
        angle = group.create_dataset("angle_x", data=np.round(1e5 * x).astype("i2"))
        angle.attrs.update({"unit": "rad", "sample_rate": 1e6, "gain": 1e-5, "offset": 0.0})
        file.create_group("device").attrs["toml"] = f"{device}\n[scan]\nhalf_angle_x = 0.11\nhalf_angle_y = 0.11\n"
    with Recording.open(path) as whole:
        assert whole.device is not None
    return path.read_bytes()


def rows(*columns: np.ndarray) -> str:
    """Lines of a CSV."""
    return "".join(",".join(f"{v:.7e}" for v in row) + "\n" for row in zip(*columns, strict=False))


def _lvm() -> str:
    head = "LabVIEW Measurement\nSeparator\tTab\nX_Columns\tOne\nTime_Pref\tAbsolute\nDate\t2024/05/01\n"
    head += "Time\t10:00:00.5\n***End_of_Header***\nChannels\t2\nSamples\t10\t1\nDate\t2024/05/01\t2024/05/01\n"
    head += "Time\t10:00:00.5\t10:00:00.75\nY_Unit_Label\tVolts\tVolts\nX_Dimension\tTime\tTime\nX0\t0\t0\n"
    head += "Delta_X\t0.001\t0.01\n***End_of_Header***\nX_Value\ta\tb\tComment\n"
    return head + "".join(f"{at / 1000:.3f}\t{V[at]:.6f}\t{at if at % 10 == 0 else ''}\t\n" for at in range(200))


def make_sample_files(folder: Path, measured: Path) -> dict[str, bytes]:
    """Name -> content, including the instruments' files of the folder ``measured`` if it exists."""
    time = 1e-3 * np.arange(200)
    tektronix = "Model,MDO4014B-3\n\nHorizontal Units,s\nSample Interval,1e-3\nVertical Units,V\nLabel,\nTIME,CH2\n"
    files = {
        "recording.h5": recording(folder / "recording.h5"),
        "five.mat": written(savemat, {"x": V, "z": TWO, "s": {"a": V[:9]}, "label": "hi"}),
        "packed.mat": written(savemat, {"x": V, "z": TWO}, do_compression=True),
        "four.mat": written(savemat, {"x": V, "z": TWO}, format="4"),
        "new.mat": written(_matlab_73),
        "plain.npz": written(np.savez, v=V, i=TWO),
        "packed.npz": written(np.savez_compressed, v=V, f=np.asfortranarray(TWO)),
        "table.npy": written(np.save, TWO),
        "short.wav": written(wavfile.write, 48000, TWO),
        "float.wav": written(wavfile.write, 48000, V.astype("f4")),
        "three.wav": written(_wav_24),
        "tektronix.csv": (tektronix + rows(time, V)).encode(),
        "keysight.csv": ("x-axis,1,2\nsecond,Volt,Volt\n" + rows(time, V, V)).encode(),
        "rigol.csv": ("X,CH1,Start,Increment\nSequence,Volt,0,1e-3\n" + rows(np.arange(200), V)).encode(),
        "labview.lvm": _lvm().encode(),
    }
    instruments = measured / "instruments"
    return files | {name: (instruments / name).read_bytes() for name in MEASURED if (instruments / name).is_file()}
