"""Noise of the readout: white, as a device file states it, and seven kinds that it does not state.

The kinds follow real readouts: flicker noise of amplifiers, broad resonances of their supply, mains hum with harmonics,
gain noise of a source or a supply, and popcorn (random telegraph) noise of a semiconductor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rng = np.random.Generator


@dataclass(frozen=True)
class Resonance:
    """A broad line: a Gaussian in the power density.

    Attributes:
        frequency, width: centre and standard deviation [Hz].
        height: power density over that of the white part.
    """

    frequency: float
    width: float
    height: float


@dataclass(frozen=True)
class Noise:
    """Noise of one sense channel.

    Attributes:
        sd: of the white part [V].
        knee: frequency at which the 1/f part equals the white part, 0 for none [Hz].
        resonances: broad lines.
        hum: amplitudes of the mains' first harmonics [V].
        mains: mains frequency [Hz].
        gain_sd: standard deviation of the relative gain fluctuation, white up to the Nyquist frequency.
        popcorn: height of the steps [V].
        popcorn_rate: mean number of steps a second [Hz].
    """

    sd: float
    knee: float = 0.0
    resonances: tuple[Resonance, ...] = ()
    hum: tuple[float, ...] = ()
    mains: float = 50.0
    gain_sd: float = 0.0
    popcorn: float = 0.0
    popcorn_rate: float = 0.0

    @property
    def is_coloured(self) -> bool:
        """Whether the additive stationary part has a spectrum."""
        return self.knee > 0 or bool(self.resonances)

    def density(self, frequency: Array, lowest: float) -> Array:
        """Power density of the stationary part over that of its white part, (n,); constant below ``lowest`` [Hz]."""
        flat = np.ones_like(frequency) + self.knee / np.maximum(frequency, lowest)
        for line in self.resonances:
            flat = flat + line.height * np.exp(-0.5 * ((frequency - line.frequency) / line.width) ** 2)
        return flat

    def draw(self, times: Array, rng: Rng, signal: Array | None = None) -> Array:
        """One realisation.

        Args:
            times: uniform, (n,) [s].
            rng: source of randomness.
            signal: noiseless signal that the gain noise multiplies, (n,) [V]; may be None where there is none.

        Returns:
            (n,) [V].
        """
        n, sample_rate = len(times), 1 / (times[1] - times[0])
        # Drawn twice as long as needed, because a noise made by an inverse FFT is periodic.
        frequency = np.fft.rfftfreq(2 * n, 1 / sample_rate)
        spectrum = np.fft.rfft(rng.standard_normal(2 * n)) * np.sqrt(self.density(frequency, sample_rate / (2 * n)))
        noise = self.sd * np.fft.irfft(spectrum, 2 * n)[:n]
        for harmonic, amplitude in enumerate(self.hum, start=1):
            noise += amplitude * np.sin(2 * pi * self.mains * harmonic * times + rng.uniform(0, 2 * pi))
        if self.gain_sd and signal is not None:
            noise += self.gain_sd * signal * rng.standard_normal(n)
        if self.popcorn:
            noise += self.popcorn * (telegraph(times, self.popcorn_rate, rng) - 0.5)
        return noise


def telegraph(times: Array, rate: float, rng: Rng) -> Array:
    """A random telegraph signal: 0 or 1, with Poisson steps at ``rate`` [Hz], (n,)."""
    duration = times[-1] - times[0] + (times[1] - times[0])
    steps = times[0] + np.sort(rng.uniform(0, duration, rng.poisson(rate * duration)))
    return (np.searchsorted(steps, times, side="right") + rng.integers(2)) % 2.0


def _white(sd: float, sample_rate: float, duration: float, swing: float, rng: Rng) -> Noise:
    return Noise(sd)


def _coloured(sd: float, sample_rate: float, duration: float, swing: float, rng: Rng) -> Noise:
    """A 1/f part, a broad line and hum together. The stated standard deviation holds at high frequencies only."""
    knee = sample_rate / rng.uniform(40, 150)
    line = (sample_rate / rng.uniform(12, 40), sample_rate / rng.uniform(200, 600), rng.uniform(1.5, 6))
    hum = tuple((sd * rng.uniform(0.2, 1.5, 3) / np.arange(1, 4)).tolist())
    return Noise(sd, knee, (Resonance(*line),), hum, float(rng.choice([50.0, 60.0])))


def _flicker(sd: float, sample_rate: float, duration: float, swing: float, rng: Rng) -> Noise:
    """1/f noise with its knee from a thousandth to a tenth of the sampling rate."""
    return Noise(sd, knee=sample_rate * 10 ** rng.uniform(-3, -1))


def _resonances(sd: float, sample_rate: float, duration: float, swing: float, rng: Rng) -> Noise:
    """One to three broad lines, up to twenty times as strong as the white part."""
    lines = []
    for _ in range(rng.integers(1, 4)):
        frequency = sample_rate * 10 ** rng.uniform(-2.3, -0.6)
        lines.append(Resonance(frequency, frequency * rng.uniform(0.03, 0.15), 10 ** rng.uniform(0, 1.3)))
    return Noise(sd, resonances=tuple(lines))


def _hum(sd: float, sample_rate: float, duration: float, swing: float, rng: Rng) -> Noise:
    """Mains hum with seven harmonics, of which odd ones are the stronger, as a rectifier makes them."""
    harmonic = np.arange(1, 8)
    odd = np.where(harmonic % 2 == 1, 1.0, 0.3)
    amplitudes = sd * rng.uniform(0.5, 2.0) * odd * rng.uniform(0.4, 1.0, 7) / harmonic
    return Noise(sd, hum=tuple(amplitudes.tolist()), mains=float(rng.choice([50.0, 60.0])) * rng.normal(1, 3e-4))


def _proportional(sd: float, sample_rate: float, duration: float, swing: float, rng: Rng) -> Noise:
    """Gain noise that at full swing is 0.3 to 1 times as strong as the white part."""
    return Noise(sd, gain_sd=sd * rng.uniform(0.3, 1.0) / swing)


def _popcorn(sd: float, sample_rate: float, duration: float, swing: float, rng: Rng) -> Noise:
    """Steps of 0.2 to 1 standard deviations, 5 to 40 over the recording."""
    return Noise(sd, popcorn=sd * rng.uniform(0.2, 1.0), popcorn_rate=rng.uniform(5, 40) / duration)


KINDS: dict[str, Callable[[float, float, float, float, Rng], Noise]] = {
    "white": _white,
    "coloured": _coloured,
    "flicker": _flicker,
    "resonances": _resonances,
    "hum": _hum,
    "proportional": _proportional,
    "popcorn": _popcorn,
}
"""Name -> maker. Its arguments: white standard deviation [V], sampling rate [Hz], duration [s], half the signal's
range [V], source of randomness."""
