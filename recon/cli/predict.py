"""``lissajous predict REC``: simulate the recording's drive through a device, open loop, and compare."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from recon.cli.shared_arguments import add_source_arguments
from scanner.wording import counted


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, help="the recording (.h5), or an instrument's file with --mapping")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the prediction")
    add_source_arguments(parser)


def run(args: argparse.Namespace) -> dict[str, Any]:
    return predict_file(args.recording, args.output, device=args.device, mapping=args.mapping)


def predict_file(
    path: Path,
    output: Path,
    device: str | Path | None = None,
    mapping: Path | None = None,
) -> dict[str, Any]:
    """Predict one recording and write predicted.h5 and summary.json into ``output``; return the summary.

    Args:
        path: the recording.
        output: folder.
        device: device file in place of the recording's own device.
        mapping: makes a recording of an instrument's file, see :func:`recon.io.convert.open_any`.

    Raises:
        BadInput: the recording or the device cannot be used.
    """
    import numpy as np

    from estimation.device_fit.predict import beyond_measured_laws, drifts, predict
    from estimation.device_fit.undriven import axes_without_drive
    from estimation.signals import require_device
    from recon.io.convert import open_any
    from recon.io.output import check_folder, replacing_folder, write_json
    from recon.report.conclusions import conclude_prediction
    from scanner import devices
    from scanner.recording import Recording

    check_folder(output)
    with open_any(path, mapping) as recording:
        used = require_device(recording, devices.find(device) if device is not None else None)
        predictions = predict(recording, used)
        channels = {name: (p.values, p.unit, p.sample_rate, p.start) for name, p in predictions.items()}
        predicted = Recording.from_arrays(channels, device=used, name=f"{recording.name}, predicted")
        summary: dict[str, Any] = {
            "recording": str(path),
            "device": used.name,
            "terms": {name: sorted(axis.terms) for name, axis in used.axes.items() if axis.terms},
            "drifts": drifts(used),
            "undriven": axes_without_drive(recording, used),
            "beyond_measured_law": beyond_measured_laws(recording, used),
            "channels": {
                name: {
                    "rmse": prediction.rmse,
                    "nrmse": prediction.rmse / max(float(np.nanstd(prediction.measured)), 1e-300),
                    "noise_sd": prediction.noise_sd,
                    "unit": prediction.unit,
                    "left_out": prediction.left_out,
                }
                for name, prediction in predictions.items()
            },
            "output": str(output),
        }
        summary["conclusion"] = conclude_prediction(summary)
        with replacing_folder(output, device, path) as folder:
            predicted.write(folder / "predicted.h5")
            write_json(folder / "summary.json", summary)
    return summary


def format_summary(summary: dict[str, Any]) -> str:
    lines = [summary["conclusion"]]
    lines.append(
        f"{summary['output']}: {counted(len(summary['channels']), 'channel')} predicted from the first samples on"
    )
    for name, effects in summary["drifts"].items():
        from_start = "from the first sample on, as in the recording to which the device was fitted"
        lines.append(f"  axis {name} drifts {from_start}: {', '.join(effects)}")
    for name in summary["undriven"]:
        lines.append(f"  axis {name}: drive_{name} is not in the recording; a free decay is predicted")
    for name, fraction in summary["beyond_measured_law"].items():
        if fraction > 0.0:
            lines.append(f"  axis {name}: {fraction:.1%} of the samples lie beyond the range of its measured law")
    for name, channel in summary["channels"].items():
        line = f"  {name}: rmse {channel['rmse']:.4g} {channel['unit']}, {channel['nrmse']:.3%} of the signal's sd"
        if channel["noise_sd"] is not None:
            line += f"; noise sd {channel['noise_sd']:.4g} {channel['unit']}"
        if channel["left_out"]:
            line += (
                f"; {counted(channel['left_out'], 'sample')} left out, which stand at one value as of a sensor or a "
                "converter that was stopped"
            )
        lines.append(line)
    return "\n".join(lines)
