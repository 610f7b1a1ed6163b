"""The public function that simulates a scan, and its result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import isfinite
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lissajous.functions import DeviceSource, load_device
from scanner.arguments import check_flags, check_numbers
from scanner.errors import BadInput
from scanner.recording import Recording

if TYPE_CHECKING:
    from phantoms.waveforms import Sine


class Simulation(NamedTuple):
    """A simulated recording with its known answer.

    Attributes:
        recording: what an instrument would have recorded.
        truth: the quantities that no recording contains: the true angles (``angle_x``, ``angle_y``), the scene, the
            drift.
    """

    recording: Recording
    truth: Mapping[str, Any]

    def write(self, path: str | Path) -> None:
        """Write recording and truth into one file, as ``lissajous simulate`` does."""
        self.recording.write(path, self.truth)

    def __repr__(self) -> str:
        return f"Simulation(truth: {', '.join(self.truth)}) of\n{self.recording!r}"


def simulate(
    device: DeviceSource = "imaging",
    *,
    target: str = "immunohistochemistry",
    drive_x: tuple[float, float, float] = (27680.0, 30.0, 30.0),
    drive_y: tuple[float, float, float] = (6540.0, 30.0, 30.0),
    duration: float = 0.06,
    sample_rate: float = 5e6,
    drift: float | Mapping[str, float] = -0.002,
    drift_tau: float = 0.025,
    field_um: float = 250.0,
    spot_um: float = 0.4,
    photons: float = 1000.0,
    angles: bool = False,
    seed: int = 0,
    nominal: DeviceSource | None = None,
) -> Simulation:
    """Simulate the scan of a target while both resonances drift.

    Args:
        device: the true device. It needs both axes and a field of view, ``[scan]``.
        target: name of a target, or an image file.
        drive_x, drive_y: frequency [Hz], amplitude [V] and offset [V] of the sinusoidal drive of each axis.
        duration: of the recording [s].
        sample_rate: of all channels [Hz].
        drift: relative change of the stiffness in the end, of both axes or by axis name.
        drift_tau: time constant of the drift [s].
        field_um: width of the field of view on the sample [um].
        spot_um: standard deviation of the beam's spot [um].
        photons: photons a sample at full brightness, which gives 1 mV a photon, above 1000 photons 1 V.
        angles: record the true angles as the reference channels ``angle_x`` and ``angle_y`` too.
        seed: of all noise, a whole number, 0 or greater.
        nominal: the device that the recording states, where the calibration differs from the true device.

    Raises:
        BadInput: an argument has no meaning, the device cannot be simulated, or there is no such target.
    """
    from phantoms.experiment import Experiment, simulate_experiment
    from phantoms.optics import imaging_detector

    if not isinstance(seed, Integral) or seed < 0:
        raise BadInput(f"is {seed!r}", channel="seed", hint="give a whole number, 0 or greater")
    check_flags(angles=angles)
    check_numbers(photons=photons)
    experiment = Experiment(
        device=load_device(device),
        target=target,
        drives={"x": _sine(drive_x, "drive_x"), "y": _sine(drive_y, "drive_y")},
        duration=duration,
        sample_rate=sample_rate,
        drift=dict(drift) if isinstance(drift, Mapping) else {"x": drift, "y": drift},
        drift_tau=drift_tau,
        field_um=field_um,
        spot_um=spot_um,
        detector=imaging_detector(photons),
        angles=angles,
    )
    return Simulation(*simulate_experiment(experiment, seed, None if nominal is None else load_device(nominal)))


def _sine(drive: object, name: str) -> Sine:
    """The waveform of frequency [Hz], amplitude [V] and offset [V]; ``name`` is that of the argument.

    Raises:
        BadInput: the drive is not three finite numbers.
    """
    from phantoms.waveforms import Sine

    numbers = list(drive) if isinstance(drive, Iterable) else []
    if len(numbers) != 3 or not all(isinstance(number, Real) and isfinite(number) for number in numbers):
        hint = "give frequency [Hz], amplitude [V] and offset [V], as (27680.0, 30.0, 30.0)"
        raise BadInput(f"is {drive!r}", channel=name, hint=hint)
    return Sine(*(float(number) for number in numbers))
