"""From a recording to its motion by block demodulation and smoothing: ``--estimator tracker``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimation.signals import Sense, intensity_clock, is_capacitive, reference_of, senses
from estimation.tracker import backward, linear
from estimation.tracker.censored import expanded_about
from estimation.tracker.course import Course, axis_motion, course, joined
from estimation.tracker.signal import Layout, Prepared, laid_out, prepare
from estimation.tracker.smoother import LOST, SIGNIFICANT
from estimation.tracker.step import FLOOR, LOG, PHASE, STATES, Signal
from estimation.tracker.tuning import (
    START_WALK,
    Belief,
    Likely,
    densities,
    filtered,
    likely_walks,
    stretches,
    tuned_walk,
    window,
)
from scanner.device import Amdm, Device, Position
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

STIFFNESS_SPREAD = 0.003  # relative: how far a resonance may have moved since its calibration, beside its tolerance
DAMPING_SPREAD = 0.05
TREND_SD = 0.3  # of the stiffness [1/s]: 0.3 % within 10 ms
POSITION_GAIN_SD = 1e-4  # relative: what a position sensor says is what the angle is
OFFSET_SD = 1.0  # of the readout [V]
SECTION = 16384  # blocks whose samples are brought together at a time, some 10 s
WINDOW, LAG = 4096, 512  # blocks smoothed at a time, and how far a window looks ahead of what it gives
LISTENED = 64  # blocks that may be taken together to find a motion in noise
EXPANSIONS, STAYS = 30, 0.05  # of clipped blocks about a track, at most; its change at which it stays [sd]
PROBED = 200  # blocks from which the sign is told


class PhaseSeen(NamedTuple):
    """Measurements of one axis's phase, made some other way: times [s], phases as in ``AxisMotion`` [rad], sds [rad].

    Each is taken at the middle of the block that it falls in. NaN, or an infinite sd, is no measurement.
    """

    time: Array
    phase: Array
    sd: Array


@dataclass(frozen=True)
class Track:
    """State along the blocks.

    Attributes:
        states: shape (blocks, states), see ``step``. sds: their standard deviations.
        log_likelihood: of the projections, up to a constant.
        chi2: mean squared normalised innovation; 1 where model and noise are right.
        live: whether the motion of each axis was found.
        onward: what is known before the block behind the last one, if there is one.
    """

    states: Array
    sds: Array
    log_likelihood: float
    chi2: float
    live: NDArray[np.bool_]
    onward: Belief


def track(
    recording: Recording,
    device: Device,
    causal: bool = False,
    seen: Mapping[str, PhaseSeen] | None = None,
    before: Motion | None = None,
) -> Motion:
    """Phase and amplitude of all axes from their sense signals.

    Args:
        causal: each block from what came before it only (a filter); its latency is half a block. By default all
            blocks from all of the recording (a smoother).
        seen: further measurements of an axis's phase, from a picture that shows forward beside backward, by axis.
        before: track of an earlier stretch of the same scan, from whose process noise the tuning starts.

    Raises:
        BadInput: a channel shows no motion, or cannot be used. ChannelMissing: an axis has no sense channel.
        DeviceInvalid: the device lacks a value.
    """
    axes: dict[str, AxisMotion] = {}
    info: dict[str, object] = {}
    for sense in senses(recording, device, gaps_ok=True):
        even = is_capacitive(sense.readout)
        references = {name: reference_of(recording, device, name, sense.channel, even) for name in sense.axes}
        layout = laid_out(recording, device, sense, references)
        signs, belief, walk = [""] * len(sense.axes), None, _walk_of(before, sense)
        courses: list[list[Course]] = [[] for _ in sense.axes]
        live = np.zeros(len(sense.axes), bool)
        kept: list[Kept] = []
        for first, stop in sections(layout.share):
            section = tuned(prepare(layout, first, stop + LAG), device, belief, walk, causal)
            prepared, walk, signs = section.prepared, section.walk, signs if kept else section.signs
            helped = with_phases(prepared, seen or {})
            found = averaged(helped, section.belief, section.likely, causal, stop - first)
            for a, own in enumerate(courses):
                own.append(course(prepared, found.states, found.sds, a))
            belief, live = found.onward, live | found.live
            kept.append(Kept(stop - first, prepared.clean, prepared.noise_var, found.chi2, found.log_likelihood))
        if all(np.isnan(section.noise_var) for section in kept):
            raise BadInput("holds no sample that can be used", file=sense.channel.file, channel=sense.channel.name)
        clock = intensity_clock(recording, sense.channel)
        for a, name in enumerate(sense.axes):
            if not live[a]:
                raise BadInput(
                    f"shows no motion of axis {name} near {references[name].frequency:.6g} Hz",
                    file=sense.channel.file,
                    channel=sense.channel.name,
                    hint="the resonance did not start; check drive voltage and frequency",
                )
            axes[name] = axis_motion(layout.references[name], joined(courses[a]), clock, signs[a])
        info[sense.channel.name] = _facts(layout, kept, walk)
    return Motion(axes, "tracker-causal" if causal else "tracker", info)


class Kept(NamedTuple):
    """What is kept of a section beside its courses, each as in ``Prepared`` or ``Track``."""

    blocks: int
    clean: float
    noise_var: float
    chi2: float
    log_likelihood: float


def sections(share: Array) -> Iterator[tuple[int, int]]:
    """First block and the one behind the last of parts that are tracked one after the other.

    None ends between two blocks of which the drive switched. ``share`` is that of ``step.Signal``, (blocks, axes).
    """
    first, blocks = 0, len(share)
    steady = (share == 0.5).all(axis=1)
    while first < blocks:
        stop = min(first + SECTION, blocks)
        while not steady[stop - 1]:
            stop += 1
        yield first, stop
        first = stop


class Tuned(NamedTuple):
    """A section ready to be tracked.

    Attributes:
        prepared: with what clipped samples tell. belief: before its first block. signs: as in ``signed``.
        walk: process noise, shape (axes, 3). likely: what it may be as well.
    """

    prepared: Prepared
    belief: Belief
    signs: list[str]
    walk: Array
    likely: Likely


def tuned(prepared: Prepared, device: Device, belief: Belief | None, walk: Array, causal: bool) -> Tuned:
    """Process noise of a section by its own blocks, from ``walk`` on.

    Args:
        belief: of the section before, None for the first.
    """
    start, signs = signed(prepared, starting_belief(prepared, device))
    # by the signal alone: it would bend the motion to each of a few phases seen
    prepared = uncensored(prepared, belief or start, walk, causal)
    parts = stretches(prepared.signal)
    walk = tuned_walk(prepared, start, parts, walk)
    if prepared.clipped.block.size:
        prepared = uncensored(prepared, belief or start, walk, causal)
        parts = stretches(prepared.signal)
    return Tuned(prepared, belief or start, signs, walk, likely_walks(prepared, start, parts, walk))


def with_phases(prepared: Prepared, seen: Mapping[str, PhaseSeen]) -> Prepared:
    """The blocks with further measurements of their phase; several in one block count as their weighted mean."""
    signal = prepared.signal
    known, var = signal.known.copy(), signal.known_var.copy()
    for a, name in enumerate(prepared.sense.axes):
        if name in seen:
            time, phase, sd = seen[name]
            used = np.isfinite(phase) & np.isfinite(sd)
            block = np.round((time[used] - prepared.time[0]) / signal.step).astype(np.int64)
            inside = (block >= 0) & (block < prepared.time.size)
            weight = 1.0 / sd[used][inside] ** 2
            total = np.bincount(block[inside], weight, prepared.time.size)
            told = total > 0.0
            mean = np.bincount(block[inside], weight * phase[used][inside], prepared.time.size)
            known[told, a], var[told, a] = mean[told] / total[told], 1.0 / total[told]
    return replace(prepared, signal=signal._replace(known=known, known_var=var))


def starting_belief(prepared: Prepared, device: Device) -> Belief:
    """What is known before the first block: the device within its tolerances, and the motion of the first blocks."""
    readout, signal = prepared.sense.readout, prepared.signal
    n = STATES * len(prepared.laws) + 1
    x, variance = np.zeros(n), np.zeros(n)
    for a, name in enumerate(prepared.sense.axes):
        at = a * STATES
        x[at + LOG] = np.log(FLOOR * prepared.laws[a].theta0)
        if isinstance(readout, Position):
            gain = POSITION_GAIN_SD
        else:
            own = "a_cir" if isinstance(readout, Amdm) else "R_s"
            gain = np.hypot(device.tolerance(name, own), device.tolerance(name, "C0"))
        variance[at : at + STATES] = np.square([
            LOST[0],
            LOST[1],
            np.hypot(device.tolerance(name, "k"), STIFFNESS_SPREAD),
            TREND_SD,
            np.hypot(device.tolerance(name, "b"), DAMPING_SPREAD),
            gain,
        ])  # fmt: skip
    x[-1] = readout.b_cir if isinstance(readout, Amdm) else readout.offset if isinstance(readout, Position) else 0.0
    variance[-1] = OFFSET_SD**2
    live = np.array([_listen(signal, a, x) for a in range(len(prepared.laws))])
    return Belief(x, np.diag(variance), live)


def _listen(signal: Signal, a: int, x: Array) -> bool:
    """Set phase and amplitude of axis ``a`` in ``x`` from as few first blocks as show its main line; False for none."""
    (i,) = np.flatnonzero((signal.lines[:, 0] == a) & (signal.lines[:, 1] == signal.main))
    count = min(LISTENED, len(signal.whitened))
    unroots = signal.unroots[signal.geometry[:count]]
    fitted = np.einsum("kij,kj->ki", unroots, signal.whitened[:count])
    back = np.exp(-1j * signal.main * signal.psi[:count, a]) / signal.passed[:count, i]
    lines = (fitted[:, 1 + 2 * i] - 1j * fitted[:, 2 + 2 * i]) * back
    variances = signal.noise_var[:count] * (unroots[:, 1 + 2 * i] ** 2).sum(axis=1) * np.abs(back) ** 2
    told = variances > 0.0
    blocks = 1
    while blocks <= count:
        used = told[:blocks]
        line, sd = lines[:blocks][used].sum(), np.sqrt(variances[:blocks][used].sum())
        if used.any() and abs(line) > SIGNIFICANT * sd:
            line = line / used.sum()
            x[a * STATES + LOG] = np.log(np.interp(abs(line), signal.ladder[a, 1], signal.ladder[a, 0]))
            x[a * STATES + PHASE] = (np.angle(line) + (0.5 * np.pi if signal.main == 1 else 0.0)) / signal.main
            return True
        blocks *= 2
    return False


def follow(
    prepared: Prepared, start: Belief, walks: Array, causal: bool = False, stop: int | None = None
) -> list[Track]:
    """The track of all blocks, or those before ``stop``, under each of the ``walks``, shape (walks, axes, 3).

    It goes window by window, so that memory does not grow with the covariances of all blocks.
    """
    blocks = len(prepared.time)
    stop, n = min(stop or blocks, blocks), start.x.size
    states, sds = np.empty((2, len(walks), stop, n))
    live = np.tile(start.live, (len(walks), 1))
    totals, beliefs, first = np.zeros((len(walks), 3)), [start] * len(walks), 0
    while first < stop:
        done = min(first + WINDOW, stop)
        inner, part = done - first, window(prepared.signal, first, min(done + LAG, blocks))
        own = linear.unmade(part)  # about the first track: the others are near it
        for i, values in enumerate(walks):
            run = filtered(prepared, part, own, beliefs[i], densities(values))
            live[i] |= run.live
            totals[i] += run.log_likelihood, run.chi2, run.used
            if done < blocks:
                x, P = run.blocks.predicted_states[inner, :n], run.blocks.predicted_covariances[inner, :n, :n]
                floor = np.log([2.0 * FLOOR * law.theta0 for law in prepared.laws])
                beliefs[i] = Belief(x.copy(), P.copy(), x[LOG::STATES][: floor.size] > floor)
            if not causal:
                backward.run_smoother(part.step, run.blocks)
            variances = np.diagonal(run.blocks.covariances[:inner], axis1=1, axis2=2)[:, :n]
            states[i, first:done] = run.blocks.states[:inner, :n]
            sds[i, first:done] = np.sqrt(np.maximum(variances, 0.0))
        first = done
    return [
        Track(xs, each, total, chi2 / max(count, 1.0), found, onward)
        for xs, each, (total, chi2, count), found, onward in zip(
            states, sds, totals.tolist(), live, beliefs, strict=True
        )
    ]


def uncensored(prepared: Prepared, start: Belief, walk: Array, causal: bool) -> Prepared:
    """The blocks with what their samples beyond a rail tell, expanded about the track until it stays."""
    before: Array | None = None
    for _ in range(EXPANSIONS if prepared.clipped.block.size else 0):
        found = follow(prepared, start, walk[None], causal)[0]
        if before is not None and (np.abs(found.states - before) <= STAYS * found.sds).all():
            break
        before = found.states
        prepared = expanded_about(prepared, before)
    return prepared


def averaged(prepared: Prepared, start: Belief, likely: Likely, causal: bool = False, stop: int | None = None) -> Track:
    """The track averaged over the process noise that may be, its deviations with what that leaves uncertain.

    Where noise leaves the drift's law uncertain, the track for the most probable law is as good as any, but its
    covariance takes that law for known: intervals of 95 % would hold the truth in 91 % (docs/bound.md).
    """
    tracks = follow(prepared, start, likely.walks, causal, stop)
    centre = tracks[len(tracks) // 2]
    states, sds = centre.states.copy(), centre.sds.copy()
    for a in range(len(prepared.laws)):
        own = slice(a * STATES, (a + 1) * STATES)
        moved = np.stack([each.states[:, own] - centre.states[:, own] for each in tracks])
        period = 2.0 * np.pi / prepared.signal.main
        moved[:, :, PHASE] -= period * np.round(moved[:, :, PHASE] / period)
        shift = np.tensordot(likely.mean[a], moved, 1)
        variance = np.tensordot(likely.mean[a], np.stack([each.sds[:, own] ** 2 for each in tracks]), 1)
        variance += np.einsum("ij,iks,jks->ks", likely.square[a], moved, moved) - shift**2
        states[:, own] += shift
        sds[:, own] = np.sqrt(np.maximum(variance, 0.0))
    return replace(centre, states=states, sds=sds)


def signed(prepared: Prepared, start: Belief) -> tuple[Belief, list[str]]:
    """The start with each axis's sign as its odd harmonics tell it over the first blocks, and what told it.

    An even capacitance has no odd harmonics and leaves theta and -theta alike. Where there are some, they follow from
    the even ones but for their sign: with the wrong one the first blocks are far less likely.
    """
    axes = len(prepared.laws)
    if not is_capacitive(prepared.sense.readout):
        return start, ["known: position readout"] * axes
    if not (prepared.signal.lines[:, 1] % 2).any():
        return start, ["ambiguous"] * axes
    signal = window(prepared.signal, 0, PROBED)
    walk = densities(np.tile(START_WALK, (axes, 1)))

    def likelihood(belief: Belief) -> float:
        with np.errstate(all="ignore"):  # the wrong sign may burst
            found = filtered(prepared, signal, linear.unmade(signal), belief, walk).log_likelihood
        return found if np.isfinite(found) else -np.inf

    own, told = likelihood(start), []
    for a in range(axes):
        x = start.x.copy()
        x[a * STATES + PHASE] += np.pi
        turned = replace(start, x=x)
        other = likelihood(turned)
        sure = 2.0 * abs(other - own) > SIGNIFICANT**2
        told.append("known: the combs' offset theta_th" if sure else "ambiguous")
        if sure and other > own:
            start, own = turned, other
    return start, told


def _walk_of(motion: Motion | None, sense: Sense) -> Array:
    """The process noise that a track tells of one channel, shape (axes, 3); the tuning's start where it tells none."""
    facts = {} if motion is None else motion.info.get(sense.channel.name, {})
    told = facts.get("walk") if isinstance(facts, Mapping) else None
    if told is None:
        return np.tile(START_WALK, (len(sense.axes), 1))
    return np.array([list(told[axis].values()) for axis in sense.axes])


def _facts(layout: Layout, sections: Sequence[Kept], walk: Array) -> dict[str, object]:
    """What is worth reporting of one channel; ``walk`` is that of its last section."""
    blocks, clean, noise_var, chi2, log_likelihood = np.array(sections).T
    names = ("white_phase", "stiffness_trend", "damping")
    return {
        "block_s": layout.length / layout.sense.channel.sample_rate,
        "used": float(np.average(clean, weights=blocks)),
        "noise_sd": float(np.sqrt(np.nanmedian(noise_var))),
        "mean_squared_innovation": float(np.average(chi2, weights=blocks)),
        "log_likelihood": float(log_likelihood.sum()),
        "walk": {
            axis: dict(zip(names, row.tolist(), strict=True)) for axis, row in zip(layout.sense.axes, walk, strict=True)
        },
    }
