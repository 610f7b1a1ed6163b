"""Optics: the beam's spot, the scene at the mirror's angles, and the detector.

The scene covers the field with W x H pixels by the law of the picture (chen2020 eq 2): column j holds
s = theta_x / half_angle_x in (2j/W - 1, 2(j+1)/W - 1], so its centre lies at s = 2(j + 1/2)/W - 1. Rows likewise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.arguments import check_numbers, check_whole_numbers
from scanner.arrays import Array
from scanner.errors import BadInput
from scanner.lowpass import run_section, section_coefficients

MIN_SPOT_PX = 0.5
"""Least standard deviation of a spot [scene pixels]: a sampled Gaussian is 7 % too narrow there, 0.1 % at 0.7."""

MAX_PHOTONS = 1e18
"""Most photons in a sample: numpy draws numbers of a Poisson distribution up to a mean of 9e18."""

PHOTONS_AT_ONE_VOLT = 1000.0
"""Photons in a sample up to which the gain of an imaging detector is 1 mV a photon."""

MAX_BITS = 24
"""Most bits of a converter: float32 represents their codes exactly."""


def blur_by_spot(scene: Array, sd_um: float, field_x_um: float, field_y_um: float) -> Array:
    """The scene convolved with a Gaussian spot.

    Args:
        scene: shape (H, W), covering the whole field.
        sd_um: standard deviation of the spot's intensity [um]; 0 for no spot.
        field_x_um, field_y_um: the whole field's width and height [um].

    Returns:
        Shape (H, W). Beyond its edge the scene continues with its edge values, as in ``sample_scene``.

    Raises:
        BadInput: the spot is narrower than ``MIN_SPOT_PX``.
    """
    import cv2

    if sd_um == 0:
        return scene.copy()
    height, width = scene.shape
    sd_x, sd_y = sd_um * width / field_x_um, sd_um * height / field_y_um
    if min(sd_x, sd_y) < MIN_SPOT_PX:
        raise BadInput(
            f"the beam's spot has a standard deviation of {min(sd_x, sd_y):.2g} scene pixels",
            hint="give the target more pixels, or a wider spot, or one of width 0",
        )
    return np.asarray(cv2.GaussianBlur(scene, (0, 0), sd_x, sigmaY=sd_y, borderType=cv2.BORDER_REPLICATE), np.float64)


def sample_scene(scene: Array, theta_x: Array, theta_y: Array, half_angle_x: float, half_angle_y: float) -> Array:
    """The scene at mirror angles, by bilinear interpolation.

    Args:
        scene: shape (H, W); row 0 at theta_y = -half_angle_y, column 0 at theta_x = -half_angle_x.
        theta_x, theta_y: mechanical angles, one shape [rad].
        half_angle_x, half_angle_y: half the field [rad].

    Returns:
        The light, of the angles' shape. Outside the field the scene continues with its edge values. It is NaN where an
        angle is NaN.
    """
    # map_coordinates is exact; cv2.remap would round positions to 1/32 pixel and accept at most 32767 of them.
    from scipy.ndimage import map_coordinates

    rows, columns = (
        (n / 2) * (theta / half_angle + 1) - 0.5
        for n, theta, half_angle in zip(scene.shape, (theta_y, theta_x), (half_angle_y, half_angle_x), strict=True)
    )
    return map_coordinates(scene, np.stack([rows, columns]), order=1, mode="nearest")


@dataclass(frozen=True)
class Detector:
    """Conversion of photons to volts.

    Attributes:
        gain: [V per photon in a sample].
        photons_per_sample: mean count in one sampling interval for light 1.
        read_noise_sd: of the electronics, after the gain [V].
        bandwidth_hz: of a first-order low-pass between the photons and the electronics [Hz]; None for no low-pass.
        bits: of the converter; None for no converter.
        full_scale: of the converter, which spans [0, full_scale) [V].
    """

    gain: float = 1e-3
    photons_per_sample: float = 1000.0
    read_noise_sd: float = 0.0
    bandwidth_hz: float | None = None
    bits: int | None = None
    full_scale: float = 1.25

    def __post_init__(self) -> None:
        positive = {"photons_per_sample": self.photons_per_sample, "gain": self.gain, "full_scale": self.full_scale}
        if self.bandwidth_hz is not None:
            positive["bandwidth_hz"] = self.bandwidth_hz
        check_numbers(**positive, read_noise_sd=self.read_noise_sd)
        if self.bits is not None:
            check_whole_numbers(bits=self.bits)
        for name, value in positive.items():
            if not (math.isfinite(value) and value > 0):
                raise BadInput(f"the detector's {name} is {value}", hint="give a finite value above zero")
        if self.photons_per_sample > MAX_PHOTONS:
            what = f"the detector's photons_per_sample is {self.photons_per_sample:g}"
            raise BadInput(what, hint=f"give at most {MAX_PHOTONS:g}")
        if not (math.isfinite(self.read_noise_sd) and self.read_noise_sd >= 0):
            raise BadInput(f"the detector's read_noise_sd is {self.read_noise_sd}", hint="give zero or more")
        if self.bits is not None and not 1 <= self.bits <= MAX_BITS:
            raise BadInput(f"the detector has {self.bits} bits", hint="give 1 to 24, what float32 holds exactly")


def imaging_detector(photons: float) -> Detector:
    """Return a detector with a converter of 12 bits whose range holds the light and its photon noise.

    Its gain is 1 mV a photon, and above ``PHOTONS_AT_ONE_VOLT`` the one with which full light gives 1 V. A gain of 1 V
    at full light for few photons would clip their noise.

    Args:
        photons: mean count in a sample at full light.

    Raises:
        BadInput: as :class:`Detector`.
    """
    return Detector(gain=1.0 / max(PHOTONS_AT_ONE_VOLT, photons), photons_per_sample=photons, bits=12)


def detect(light: Array, rate: float, detector: Detector, rng: np.random.Generator) -> NDArray[np.float32]:
    """The detector's signal: light with photon noise, bandwidth, gain, read noise and converter, in this order.

    Without bandwidth the mean is ``gain N`` and the variance ``gain^2 N + read_noise_sd^2`` (shot-noise law), with
    N = photons_per_sample * light. For the low-pass, the light is linear between samples, so that a slow signal is
    delayed by 1 / (2 pi bandwidth_hz). The photon noise is constant within a sample, so that its variance decreases to
    N tanh(pi bandwidth_hz / rate). The low-pass starts in the steady state of the first sample's light.

    Args:
        light: relative to full light, not negative, shape (n,), n > 0.
        rate: of the samples [Hz].
        detector: its constants.
        rng: source of the noise.

    Returns:
        Shape (n,) [V].
    """
    mean = np.multiply(light, detector.photons_per_sample, dtype=np.float64)
    noise = rng.poisson(mean) - mean
    if detector.bandwidth_hz is not None:
        decay, previous, new = section_coefficients(detector.bandwidth_hz, 1 / rate)
        run_section(mean, decay, previous, new, mean[0], mean[0])
        run_section(noise, decay, 0.0, 1 - decay, 0.0, 0.0)
    signal = detector.gain * (mean + noise)
    signal += rng.normal(0.0, detector.read_noise_sd, signal.shape)
    if detector.bits is not None:
        codes = 2**detector.bits
        step = detector.full_scale / codes
        signal = np.clip(np.rint(signal / step), 0, codes - 1) * step
    return signal.astype(np.float32)
