"""The angle at any sample from slow phase, amplitude and harmonics, without a sine for each sample.

Time is cut into segments of SEGMENT samples. At a segment's ends phase, amplitude and harmonics are interpolated from
the blocks; inside, the phase runs straight, so that a segment's phasors follow from its first by doubling.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.reference import Reference
from scanner.motion import AngleTrack

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SEGMENT = 128  # a power of two
RAMP = np.arange(SEGMENT, dtype=np.float64)
PIECE = 1 << 20  # samples made at a time


@dataclass(frozen=True)
class SlowMotion:
    """Motion of one axis on the blocks' clock: theta(t) = Re(sum of line[n] exp(i n u)), u = psi(t) + phi(t).

    Attributes:
        reference: gives psi.
        time: uniform, shape (blocks,) [s].
        phase, phase_rate: phi and its slope [rad, rad/s]. log, log_rate: of the amplitude [1, 1/s].
        lines: harmonics over the amplitude, shape (blocks, lines); the first harmonic is -i.
    """

    reference: Reference
    time: Array
    phase: Array
    phase_rate: Array
    log: Array
    log_rate: Array
    lines: Complex

    def at(self, time: Array) -> tuple[Array, Complex]:
        """Phase u [rad] and lines [rad] at ``time``, shapes (n,) and (n, lines)."""
        step = self.time[1] - self.time[0]
        at = (time - self.time[0]) / step
        k = np.clip(np.floor(at).astype(np.int64), 0, self.time.size - 2)
        s = at - k
        phase = _hermite(self.phase, self.phase_rate, k, s, step) + self.reference.phase(time)
        amplitude = np.exp(_hermite(self.log, self.log_rate, k, s, step))
        share = np.clip(s, 0.0, 1.0)[:, None]
        return phase, (self.lines[k] * (1.0 - share) + self.lines[k + 1] * share) * amplitude[:, None]


def _hermite(values: Array, slopes: Array, k: NDArray[np.int64], s: Array, step: float) -> Array:
    """Cubic through values and slopes, at fraction ``s`` behind knot ``k``; straight on beyond the ends."""
    inside = np.clip(s, 0.0, 1.0)
    rest = 1.0 - inside
    a, b = values[k], values[k + 1]
    da, db = slopes[k] * step, slopes[k + 1] * step
    curve = rest**2 * ((1.0 + 2.0 * inside) * a + inside * da) + inside**2 * ((1.0 + 2.0 * rest) * b - rest * db)
    return curve + (s - inside) * np.where(s < 0.0, da, db)


@dataclass(frozen=True)
class Segments:
    """Phasors of a run of samples, segment by segment: what the compiled kernels take.

    Attributes:
        first: exp(i u) at each segment's first sample. turn: exp(i du) from one sample to the next. shape (segments,).
        lines, line_steps: lines at the first sample and their change a sample, shape (segments, lines) [rad].
    """

    first: Complex
    turn: Complex
    lines: Complex
    line_steps: Complex


def segments(motion: SlowMotion, rate: float, start: float, count: int) -> Segments:
    """Segments that cover ``count`` samples from ``start`` [s] at ``rate`` [Hz]."""
    edges: Array = start + np.arange(-(-count // SEGMENT) + 1, dtype=np.float64) * (SEGMENT / rate)
    phase, lines = motion.at(edges)
    return Segments(
        np.exp(1j * phase[:-1]), np.exp(1j * np.diff(phase) / SEGMENT), lines[:-1], np.diff(lines, axis=0) / SEGMENT
    )


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def segment_angles(first, turn, lines, line_steps, re, im, out):  # type: ignore[no-untyped-def]
    """Angles of one segment into ``out`` (SEGMENT,) [rad]; ``re``, ``im`` (SEGMENT,) are room for its phasors.

    ``lines`` are harmonics 0, 1, 2, ...; three are 1, 3, 5. The amplitude runs straight over the segment, the small
    harmonics keep the value of its middle.
    """
    re[0], im[0] = first.real, first.imag
    done, far = 1, turn
    while done < SEGMENT:  # each step turns all phasors there are at once, and so doubles them
        a, b = far.real, far.imag
        next_re, next_im = re[done : 2 * done], im[done : 2 * done]
        for i in range(done):
            x, y = re[i], im[i]
            next_re[i], next_im[i] = x * a - y * b, x * b + y * a
        far *= far
        done *= 2
    if lines.size == 3:
        swing, swing_step = lines[0].imag, line_steps[0].imag
        third, fifth = lines[1] + 0.5 * SEGMENT * line_steps[1], lines[2] + 0.5 * SEGMENT * line_steps[2]
        r3, i3, r5, i5 = third.real, third.imag, fifth.real, fifth.imag
        for i in range(SEGMENT):
            x, y = re[i], im[i]
            px, py = x * x - y * y, 2.0 * x * y
            sx, sy = r3 + r5 * px - i5 * py, i3 + r5 * py + i5 * px
            tx, ty = sx * px - sy * py, swing + RAMP[i] * swing_step + sx * py + sy * px
            out[i] = x * tx - y * ty
    else:
        for i in range(SEGMENT):
            out[i] = lines[0].real - (lines[1].imag + RAMP[i] * line_steps[1].imag) * im[i]
        for n in range(2, lines.size):
            line = lines[n] + 0.5 * SEGMENT * line_steps[n]
            a, b = line.real, line.imag
            for i in range(SEGMENT):
                x, y = re[i], im[i]
                px, py = x, y
                for _ in range(n - 1):
                    px, py = px * x - py * y, px * y + py * x
                out[i] += a * px - b * py


@njit(cache=True, error_model="numpy")
def _angles(first, turn, lines, line_steps, out):  # type: ignore[no-untyped-def]
    re, im, buffer = np.empty(SEGMENT), np.empty(SEGMENT), np.empty(SEGMENT)
    for s in range(first.size):
        at = s * SEGMENT
        segment_angles(first[s], turn[s], lines[s], line_steps[s], re, im, buffer)
        for i in range(min(SEGMENT, out.size - at)):
            out[at + i] = buffer[i]


class SlowAngle(AngleTrack):
    """Angle at a channel's samples, made when it is read, so that a long recording costs no memory.

    Attributes:
        motion: slow motion that the angles come from.
    """

    motion: SlowMotion
    _size: int

    def __init__(self, motion: SlowMotion, sample_rate: float, start: float, size: int):
        self.__dict__.update(motion=motion, sample_rate=sample_rate, start=start, _size=size)  # frozen, as its parent

    @property
    def size(self) -> int:
        """Number of samples."""
        return self._size

    @cached_property
    def values(self) -> Array:
        """All angles, shape (size,) [rad]."""
        return self.read(0, self.size)

    def read(self, first: int = 0, stop: int | None = None) -> Array:
        """Angles of samples ``first`` up to ``stop``, shape (n,) [rad]."""
        low, high, _ = slice(first, stop).indices(self.size)
        out = np.empty(max(high - low, 0))
        for at in range(0, out.size, PIECE):
            part = out[at : at + PIECE]
            own = self.segments(low + at, low + at + part.size)
            _angles(own.first, own.turn, own.lines, own.line_steps, part)
        return out

    def segments(self, first: int, stop: int) -> Segments:
        """Segments of samples ``first`` up to ``stop``."""
        return segments(self.motion, self.sample_rate, self.start + first / self.sample_rate, stop - first)

    def turned(self) -> SlowAngle:
        """The same motion with the other sign."""
        motion = replace(self.motion, phase=self.motion.phase + np.pi, lines=_turned(self.motion.lines))
        return SlowAngle(motion, self.sample_rate, self.start, self.size)


def _turned(lines: Complex) -> Complex:
    """Lines that make -theta with u + pi: even harmonics change sign, odd ones do not."""
    out = lines.copy()
    if lines.shape[1] != 3:
        out[:, ::2] *= -1.0
    return out
