"""``predict`` on files: recording and device in, predicted recording and summary out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from recon.convert import open_any
from recon.output import check_folder, replacing_folder
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording


def predict_file(
    path: Path,
    output: Path,
    device: Path | None = None,
    mapping: Path | None = None,
) -> dict[str, Any]:
    """Predict one recording and write predicted.h5 and summary.json into ``output``.

    Args:
        mapping: what makes an instrument's file a recording, see :func:`recon.convert.open_any`.

    Raises:
        BadInput: the recording or the device cannot be used.
    """
    from estimation.mismatch.prediction import predict

    check_folder(output)
    with open_any(path, mapping) as recording:
        used = Device.load(device) if device is not None else recording.device
        if used is None:
            hint = "give one with --device, or record it under /device"
            raise BadInput("states no device", file=path, channel="/device", hint=hint)
        found = predict(recording, used)
        channels = {name: (each.values, each.unit, each.sample_rate, each.start) for name, each in found.items()}
        predicted = Recording.from_arrays(channels, device=used, name=f"{recording.name}, predicted")
        summary: dict[str, Any] = {
            "recording": str(path),
            "device": used.name,
            "terms": {name: sorted(axis.terms) for name, axis in used.axes.items() if axis.terms},
            "channels": {
                name: {
                    "rmse": each.rmse,
                    "nrmse": each.rmse / max(float(np.std(each.measured)), 1e-300),
                    "noise_sd": each.noise_sd,
                    "unit": each.unit,
                }
                for name, each in found.items()
            },
        }
        with replacing_folder(output) as folder:
            predicted.write(folder / "predicted.h5")
            (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    return summary | {"output": str(output)}
