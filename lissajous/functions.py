"""The public functions: each takes a recording or a file's path, and a device or its name or path.

A recording that is given by its path is opened here, and its file is closed when no result needs it any more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from scanner.arguments import check_flags
from scanner.device import Device
from scanner.errors import BadInput, DeviceInvalid
from scanner.recording import Recording

if TYPE_CHECKING:
    from estimation.device_fit.predict import Predicted
    from estimation.diagnosis.diagnose import Diagnosis
    from estimation.identification.calibrate import Identification
    from recon.imaging.intensity_drift_equations import DriftKind
    from recon.imaging.picture_kinds.picture_estimate import PictureKind
    from recon.steps.reconstruction import Reconstruction
    from scanner.motion import Motion

RecordingSource = Recording | str | Path
"""A recording, or the path of a recording or of an instrument's file."""

Arrays = Mapping[str, Any]
"""Channel -> values in SI units, or (values, unit, sample rate [Hz][, start [s]]) as in ``Recording.from_arrays``."""

DeviceSource = Device | str | Path
"""A device, the name of a device that comes with the program, or the path of a device file."""

MappingSource = str | Path | Mapping[str, Any]
"""Which variable of an instrument's file is which channel: a TOML file, or its content as a dictionary."""


def load_device(device: DeviceSource) -> Device:
    """Return the device of that name, or the device in the TOML file at that path.

    Raises:
        BadInput: no device has that name and no file that path, or the file is not a valid device.
    """
    from scanner.devices import find

    return find(device)


def convert(file: str | Path, mapping: MappingSource, output: str | Path | None = None) -> Recording:
    """Return the recording that a mapping makes of an instrument's file; its samples are read when they are needed.

    Args:
        file: MATLAB, HDF5, TDMS, LabVIEW, CSV, oscilloscope, NumPy or WAV file.
        mapping: which variable is which channel: a TOML file or the same as a dictionary.
        output: write the recording to this path and return it from there.

    Raises:
        BadInput: the file cannot be read, or the mapping does not fit it.
    """
    from recon.io.convert import convert_file, open_any

    plan = _as_mapping(mapping)
    if output is None:
        return open_any(Path(file), plan)
    convert_file(Path(file), plan, Path(output))
    return Recording.open(output)


def estimate(
    recording: RecordingSource,
    device: DeviceSource | None = None,
    estimator: str | None = None,
    *,
    mapping: MappingSource | None = None,
    flip_x: bool = False,
    flip_y: bool = False,
) -> Motion:
    """Estimate the motion of every axis.

    Args:
        recording: a recording or a file.
        device: in place of the recording's own.
        estimator: ``"tracker"``, ``"ukf"``, ...; chosen by what was recorded where None.
        mapping: needed where ``recording`` is an instrument's file.
        flip_x, flip_y: turn the sign of an axis, which an even capacitance cannot determine.

    Raises:
        BadInput: no such estimator, a flip is neither True nor False, or the recording or the device lacks what is
            needed.
    """
    from estimation.estimate import estimate as estimate_motion

    check_flags(flip_x=flip_x, flip_y=flip_y)
    opened = _opened(recording, mapping)
    return estimate_motion(opened, _nominal_device(opened, device), estimator, {"x": flip_x, "y": flip_y})


def reconstruct(
    recording: RecordingSource | Arrays,
    device: DeviceSource | None = None,
    estimator: str | None = None,
    *,
    pixels: tuple[int, int] = (400, 400),
    picture: PictureKind = "mean",
    p: float = 1.0,
    flip_x: bool = False,
    flip_y: bool = False,
    spot: float | None = None,
    sense_only: bool = False,
    allow_outside: bool = False,
    sample_rate: float | None = None,
    intensity_drift: DriftKind | None = None,
    sample_motion: bool = False,
    mapping: MappingSource | None = None,
    truth: Mapping[str, Any] | None = None,
) -> Reconstruction:
    """Estimate the motion, map the intensity to pixels and assess the result.

    Example::

        arrays = {"sense_x": volts_x, "sense_y": volts_y, "intensity": light}
        picture = lissajous.reconstruct(arrays, "device.toml", sample_rate=1e6).picture

    Args:
        recording: a recording, a file, or arrays by the name of their channel: values in SI units (V, rad), or
            (values, unit, sample rate[, start]).
        device: in place of the recording's own.
        estimator: ``"tracker"``, ``"ukf"``, ...; chosen by what was recorded where None.
        pixels: width and height of the picture.
        picture: value of a pixel: ``"mean"`` of its samples, ``"kernel"``-weighted mean with the samples around, or
            ``"posterior"`` mean under a smoothness prior.
        p: pixels of displacement that are tolerated; the phase bound is p/m with m half the pixels across.
        flip_x, flip_y: turn the sign of an axis, which an even capacitance cannot determine.
        spot: standard deviation of the beam's spot [px], for the account of the blur.
        sense_only: do not correct the phase by the error that the picture shows.
        allow_outside: make the picture although most samples lie outside the field of view.
        sample_rate: of arrays that are given without one [Hz].
        intensity_drift: drift of the detector to remove, ``"offset"`` or ``"gain"``; None removes none.
        mapping: needed where ``recording`` is an instrument's file.
        truth: of a simulation, for ``evaluation``; a simulated file's own truth is read from the file.

    Raises:
        BadInput: an option has no meaning, or the recording or the device lacks what is needed.
    """
    from recon.evaluation import load_truth, truth_from_simulation
    from recon.imaging.intensity_drift_equations import DriftKind
    from recon.pipeline import reconstruct as reconstruct_recording
    from recon.steps.reconstruction import Options

    if not (
        isinstance(pixels, Sequence) and len(pixels) == 2 and all(isinstance(n, Integral) and n > 0 for n in pixels)
    ):
        raise BadInput(f"is {pixels!r}", channel="pixels", hint="give width and height, as (400, 400)")
    for name, value in (("p", p), ("spot", spot)):
        if value is not None and not (isinstance(value, Real) and 0.0 < value < math.inf):
            raise BadInput(f"is {value!r}", channel=name, hint="give a positive number of pixels")
    if intensity_drift not in (None, *get_args(DriftKind)):
        raise BadInput(f"is {intensity_drift!r}", channel="intensity_drift", hint="give 'offset', 'gain' or None")
    check_flags(flip_x=flip_x, flip_y=flip_y, sense_only=sense_only)
    check_flags(allow_outside=allow_outside, sample_motion=sample_motion)
    if isinstance(recording, Mapping):
        recording = _recording_of_arrays(recording, sample_rate)
    elif sample_rate is not None and isinstance(recording, (Recording, str, Path)):
        raise BadInput("is for arrays; a recording has its own rates", channel="sample_rate", hint="leave it out")
    known = truth_from_simulation(truth) if truth is not None else None
    if known is None and isinstance(recording, (str, Path)) and mapping is None:
        known = load_truth(Path(recording))
    opened = _opened(recording, mapping)
    options = Options(
        device=_nominal_device(opened, device),
        estimator=estimator,
        pixels=pixels,
        picture=picture,
        p=p,
        flips={"x": flip_x, "y": flip_y},
        spot=spot,
        sense_only=sense_only,
        allow_outside=allow_outside,
        intensity_drift=intensity_drift,
        sample_motion=sample_motion,
    )
    return reconstruct_recording(opened, options, known, quiet=True)


def diagnose(
    recordings: RecordingSource | Sequence[RecordingSource],
    device: DeviceSource | None = None,
    *,
    mapping: MappingSource | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Diagnosis:
    """Locate, name and model the effects that the nominal device omits: motion, readout and, with an intensity, optics.

    Args:
        recordings: one or several of one device; several are fitted together.
        device: the nominal one, in place of that of the first recording.
        mapping: needed where the recordings are an instrument's files.
        progress: called with a line of text at every step.

    Raises:
        BadInput: no device, no recording, or one that cannot be compared with it.
    """
    from recon.diagnose_recordings import diagnose_recordings

    opened = [_opened(each, mapping) for each in _as_list(recordings)]
    return diagnose_recordings(opened, _nominal_device(opened[0], device), progress)


def identify(
    recordings: RecordingSource | Sequence[RecordingSource],
    device: DeviceSource | None = None,
    *,
    mapping: MappingSource | None = None,
) -> Identification:
    """Measure a device's constants from recordings at rest, in free decay and driven.

    Args:
        recordings: one or several; each is used for what it shows.
        device: the nominal one, in place of that of the first recording that states one.
        mapping: needed where the recordings are an instrument's files.

    Raises:
        BadInput: no device is stated, no recording is given, or none shows anything of it.
    """
    from estimation.identification.calibrate import identify as identify_device

    opened = [_opened(each, mapping) for each in _as_list(recordings)]
    stating = next((each for each in opened if each.device), opened[0])
    return identify_device(opened, _nominal_device(stating, device))


def predict(
    recording: RecordingSource,
    device: DeviceSource | None = None,
    *,
    mapping: MappingSource | None = None,
) -> dict[str, Predicted]:
    """Play the recording's drive through a device, open loop, and compare every sense and angle channel.

    Args:
        recording: a recording or a file.
        device: in place of the recording's own.
        mapping: needed where ``recording`` is an instrument's file.

    Returns:
        By channel name the predicted and the measured samples and their difference ``rmse``.

    Raises:
        BadInput: no device, or nothing to compare with.
    """
    from estimation.device_fit.predict import predict as predict_channels

    opened = _opened(recording, mapping)
    return predict_channels(opened, _nominal_device(opened, device))


def _opened(recording: RecordingSource, mapping: MappingSource | None) -> Recording:
    """The recording, opened if a path is given."""
    from recon.io.convert import open_any

    if not isinstance(recording, (Recording, str, Path)):
        hint = "give a Recording (Recording.from_arrays makes one of arrays) or the path of a file"
        if hasattr(recording, "columns"):
            hint = "give dict(table) and sample_rate= to lissajous.reconstruct, or make a Recording by from_arrays"
        raise BadInput(f"is a {type(recording).__name__}, no recording", channel="recording", hint=hint)
    if not isinstance(recording, Recording):
        recording = open_any(Path(recording), None if mapping is None else _as_mapping(mapping))
    return recording


def _nominal_device(recording: Recording, device: DeviceSource | None) -> Device:
    """The device that is given, whose errors then name its file; else that of the recording.

    Raises:
        BadInput: it is not valid, or none is given and the recording states none.
    """
    if device is not None:
        return load_device(device)
    if recording.device is None:
        raise DeviceInvalid("states no device", file=recording.path, channel="/device", hint="give one as device=")
    return recording.device


def _recording_of_arrays(arrays: Arrays, sample_rate: float | None) -> Recording:
    """A recording of arrays; bare ones are in the unit of their channel at ``sample_rate`` [Hz]."""
    from scanner.channel import CHANNEL_UNITS

    channels = {}
    for name, values in arrays.items():
        if isinstance(values, tuple):
            channels[name] = values
        elif sample_rate is None:
            hint = "give sample_rate=, or (values, unit, sample rate)"
            raise BadInput("is an array without a sample rate", channel=name, hint=hint)
        else:
            channels[name] = (values, CHANNEL_UNITS.get(name, ""), sample_rate)
    return Recording.from_arrays(channels)


def _as_mapping(mapping: MappingSource) -> Path | Mapping[str, Any]:
    return Path(mapping) if isinstance(mapping, str) else mapping


def _as_list(recordings: RecordingSource | Sequence[RecordingSource]) -> list[RecordingSource]:
    """The recordings as a list.

    Raises:
        BadInput: there are none.
    """
    if isinstance(recordings, (Recording, str, Path)) or not isinstance(recordings, Iterable):
        return [recordings]
    listed = list(recordings)
    if not listed:
        raise BadInput("holds none", channel="recordings", hint="give a recording, the path of one, or several of them")
    return listed
