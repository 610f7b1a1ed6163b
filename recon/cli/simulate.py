"""``lissajous simulate``: simulate a scan of a target and write the recording together with its known truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.cli.argument_types import parse_drive, parse_not_negative, parse_number, parse_positive, parse_whole

if TYPE_CHECKING:
    from phantoms.waveforms import Sine
    from scanner.device import Device

DEFAULT_DEVICE = "imaging"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="REC", help="the recording to write (.h5)")
    parser.add_argument(
        "--device", default=DEFAULT_DEVICE, metavar="NAME|FILE", help="a named device or a TOML file (imaging)"
    )
    parser.add_argument(
        "--target", default="immunohistochemistry", metavar="NAME|FILE", help="what lies under the beam"
    )
    parser.add_argument(
        "--drive-x",
        type=parse_drive,
        metavar="HZ,V,V",
        help="frequency, amplitude, offset; by default those at which x fills the field of the device (imaging: "
        "27680,30,30)",
    )
    parser.add_argument("--drive-y", type=parse_drive, metavar="HZ,V,V", help="likewise (imaging: 6540,30,30)")
    parser.add_argument("--duration", type=parse_positive, default=0.06, help="s (0.06)")
    parser.add_argument("--rate", type=parse_positive, default=5e6, help="samples a second (5e6)")
    parser.add_argument(
        "--drift", type=parse_number, default=-0.002, help="relative change of both stiffnesses in the end (-0.002)"
    )
    parser.add_argument("--drift-tau", type=parse_positive, default=0.025, help="its time constant, s (0.025)")
    parser.add_argument(
        "--field-um", type=parse_positive, default=250.0, help="width of the field on the sample, um (250)"
    )
    parser.add_argument("--spot-um", type=parse_not_negative, default=0.4, help="sd of the beam spot, um (0.4)")
    parser.add_argument(
        "--photons",
        type=parse_positive,
        default=1000.0,
        help="photons a sample at full brightness (1000), 1 mV each; above 1000, full brightness is 1 V",
    )
    parser.add_argument("--angles", action="store_true", help="record the true angles as reference channels too")
    parser.add_argument("--seed", type=parse_whole, default=0, help="of all noise (0)")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from phantoms.experiment import Experiment, simulate_experiment
    from phantoms.optics import imaging_detector
    from scanner import devices
    from scanner.files import check_no_input, check_place

    check_place(args.output)
    check_no_input(args.output, Path(args.device), Path(args.target))

    device = devices.find(args.device)
    drives = _drives(args, device)
    experiment = Experiment(
        device=device,
        target=args.target,
        drives=drives,
        duration=args.duration,
        sample_rate=args.rate,
        drift={"x": args.drift, "y": args.drift},
        drift_tau=args.drift_tau,
        field_um=args.field_um,
        spot_um=args.spot_um,
        detector=imaging_detector(args.photons),
        angles=args.angles,
    )
    recording, truth = simulate_experiment(experiment, args.seed)
    recording.write(args.output, truth)
    channels = {name: channel.size for name, channel in recording.channels.items()}
    return {
        "recording": str(args.output),
        "duration": recording.duration,
        "seed": args.seed,
        "channels": channels,
        "drives": {axis: {"frequency": d.frequency, "amplitude": d.amplitude, "offset": d.offset}
                   for axis, d in drives.items()},
    }  # fmt: skip


def _drives(args: argparse.Namespace, device: Device) -> dict[str, Sine]:
    """The drive of each axis: as given, or for the default device that of the papers, or one that fills the field."""
    from phantoms.experiment import IMAGING_DRIVES
    from phantoms.waveforms import Sine
    from scanner.device import AXES
    from scanner.steady_drive import steady_drive

    given = {axis: Sine(*drive) for axis, drive in (("x", args.drive_x), ("y", args.drive_y)) if drive is not None}
    if args.device == DEFAULT_DEVICE:
        return IMAGING_DRIVES | given
    half_angles = dict(zip(AXES, device.require_scan().mechanical_half_angles, strict=True))
    others = {name: axis for name, axis in device.axes.items() if name not in given}
    return {name: Sine(*steady_drive(axis, half_angles[name])) for name, axis in others.items()} | given


def format_summary(summary: dict[str, Any]) -> str:
    drives = ", ".join(
        f"{axis} {drive['frequency']:.6g} Hz, {drive['amplitude']:.3g} V, offset {drive['offset']:.3g} V"
        for axis, drive in summary["drives"].items()
    )
    return (
        f"{summary['recording']}: {summary['duration']:.6g} s of {', '.join(summary['channels'])}, with its truth\n"
        f"  driven at {drives}"
    )
