"""Planning of a scan, and studies of its blur."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lissajous.functions import DeviceSource, load_device
from scanner.arguments import check_pairs
from scanner.wording import counted

if TYPE_CHECKING:
    from recon.scan_design import ScanCandidate, SustainedBand


@dataclass(frozen=True)
class ScanDesign:
    """Drive frequencies for a required scan.

    Attributes:
        bands: by axis name the motion that the drive sustains against its frequency.
        candidates: pairs of drive frequencies, best first.
    """

    bands: Mapping[str, SustainedBand]
    candidates: Sequence[ScanCandidate]

    def __repr__(self) -> str:
        lines = [f"ScanDesign: {counted(len(self.candidates), 'pair')} of drive frequencies, best first"]
        lines += [
            f"  {pair.drive[0]:.2f} Hz x {pair.drive[1]:.2f} Hz: {pair.figure.frame_rate:.3f} pictures a second, "
            f"fill {pair.fill['worst']:.1%} to {pair.fill['best']:.1%}"
            for pair in self.candidates[:5]
        ]
        return "\n".join(lines)


def design(
    device: DeviceSource = "imaging",
    *,
    pixels: tuple[int, int] = (400, 400),
    frame_rate: float = 15.0,
    fill: float = 0.95,
    half_angles: tuple[float, float] | None = None,
    volts: tuple[float, float] = (30.0, 30.0),
    sample_rate: float | None = 5e6,
    margin: float = 0.0005,
) -> ScanDesign:
    """Find drive frequencies whose Lissajous figure fills the picture at the required frame rate.

    Args:
        device: whose drives have to sustain the field.
        pixels: width and height of the picture.
        frame_rate: pictures a second, at least [Hz].
        fill: fraction of the pixels that one picture has to visit.
        half_angles: half the field in x and y [rad], optical if the device's ``[scan]`` says so; that of the device
            where None.
        volts: amplitude and offset of both drives [V].
        sample_rate: samples a second, which fill pixels [Hz]; the beam's whole path counts where None.
        margin: relative change of either stiffness that field and motion have to survive.

    Raises:
        BadInput: an argument is no number or no pair of numbers, the drives do not sustain the field, or no pair of
            frequencies repeats at the frame rate.
    """
    from recon.imaging.picture import grid_of_scan
    from recon.scan_design import ScanRequirements, wanted_field
    from recon.scan_design import design as design_scan

    check_pairs(Integral, "give width and height, as (400, 400)", pixels=pixels)
    check_pairs(Real, "give amplitude and offset [V], as (30.0, 30.0)", volts=volts)
    if half_angles is not None:
        check_pairs(Real, "give half the field in x and y [rad], as (0.1, 0.1)", half_angles=half_angles)
    loaded = load_device(device)
    grid = grid_of_scan(*pixels, wanted_field(loaded, half_angles))
    requirements = ScanRequirements(grid, frame_rate, fill, sample_rate, margin)
    return ScanDesign(*design_scan(loaded, requirements, volts))


def blur_study(
    study: str | Path, output: str | Path, *, workers: int | None = None, scheduler: str | None = None
) -> dict[str, Any]:
    """Run a study of many simulated scans and write its table and report; finished cells are not computed again.

    Args:
        study: what to vary (TOML).
        output: folder of table, report and journal.
        workers: processes on this machine; one a core where None.
        scheduler: address of a Dask scheduler in place of this machine.

    Returns:
        The content of ``summary.json``.

    Raises:
        BadInput: the study, the folder or the scheduler cannot be used.
    """
    from recon.study.run import run_study

    return run_study(Path(study), Path(output), scheduler=scheduler, workers=workers)
