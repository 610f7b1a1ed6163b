"""The tracker's compiled filter and smoother against slow ones; what a linearisation serves for."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from worlds import blocks_of, noisy, prepared_of

from benchmarks.clipped import transimpedance_world
from estimation.tracker import signal, track
from estimation.tracker.backward import kicks, run_smoother
from estimation.tracker.linear import expected, predict, unmade
from estimation.tracker.orbit import axis_law, turn_of
from estimation.tracker.signal import Prepared
from estimation.tracker.step import DAMPING, GAIN, LOG, NONLINEAR, PHASE, RATES, STATES, STIFFNESS, TREND, change
from estimation.tracker.track import follow, signed, starting_belief
from estimation.tracker.tuning import OFFSET_WALK, Run, densities, filtered, stretches, tuned_walk
from scanner import devices

WALK = np.tile([1e-7, 0.02, 1e-6], (2, 1))


def run_of(prepared: Prepared, walk: np.ndarray = WALK, linear=None) -> Run:  # type: ignore[no-untyped-def]
    start = starting_belief(prepared, devices.load("imaging"))
    return filtered(prepared, prepared.signal, linear or unmade(prepared.signal), start, densities(walk))


def rauch_tung_striebel(prepared: Prepared, linear, run: Run) -> tuple[np.ndarray, ...]:  # type: ignore[no-untyped-def]
    """The smoother as it is written down: states, covariances, and both sides of the score (see ``kicks``)."""
    xs, Ps = run.blocks.states.copy(), run.blocks.covariances.copy()
    squares, spreads, used = np.zeros(xs.shape[1]), np.zeros(xs.shape[1]), slice(0, 2 * STATES + 1)
    for k in range(len(xs) - 2, -1, -1):
        x, P, taken = run.blocks.states[k].copy(), run.blocks.covariances[k].copy(), np.empty((2, 2, DAMPING + 1))
        predict(prepared.rows, prepared.signal, k, x, P, densities(WALK), OFFSET_WALK, linear, taken)
        F = np.eye(x.size)
        for a in range(2):
            F[a * STATES : a * STATES + 2, a * STATES : a * STATES + DAMPING + 1] = taken[a]
            F[a * STATES + STIFFNESS, a * STATES + TREND] = prepared.signal.step
        inverse = np.zeros(P.shape)
        inverse[used, used] = np.linalg.inv(P[used, used])
        squares += (inverse @ (xs[k + 1] - x)) ** 2
        spreads += np.diag(inverse @ (P - Ps[k + 1]) @ inverse)
        gain = Ps[k] @ F.T @ inverse
        xs[k] += gain @ (xs[k + 1] - x)
        Ps[k] += gain @ (Ps[k + 1] - P) @ gain.T
    return xs, Ps, squares, spreads


def test_smoother_and_score_are_those_of_the_textbook() -> None:
    prepared = prepared_of(8)
    linear = unmade(prepared.signal)
    run = [run_of(prepared, linear=linear) for _ in range(3)][-1]  # the last one changes no linearisation
    made = linear.about.copy()
    xs, Ps, squares, spreads = rauch_tung_striebel(prepared, linear, run)
    assert (linear.about == made).all()
    told = kicks(prepared.signal, linear, run.blocks)
    run_smoother(prepared.signal.step, run.blocks)
    deviations = np.sqrt(np.diagonal(Ps, axis1=1, axis2=2))
    used = slice(0, 2 * STATES + 1)
    assert np.abs((run.blocks.states - xs) / np.maximum(deviations, 1e-12))[:, used].max() < 1e-6
    own = np.sqrt(np.diagonal(run.blocks.covariances, axis1=1, axis2=2))
    assert own[:, used] == pytest.approx(deviations[:, used], rel=1e-6)
    walked = [0, 1, TREND, DAMPING, STATES, STATES + 1, STATES + TREND, STATES + DAMPING]
    assert told[0][walked] == pytest.approx(squares[walked], rel=1e-4)
    assert told[1][walked] == pytest.approx(spreads[walked], rel=1e-4)


def test_a_linearisation_serves_other_densities_as_one_of_their_own_would() -> None:
    prepared = prepared_of(8)
    linear = unmade(prepared.signal)
    run_of(prepared, 30.0 * WALK, linear)
    made = linear.about.copy()
    again, fresh = run_of(prepared, WALK, linear), run_of(prepared, WALK)
    assert np.mean((linear.about == made).all(axis=1)) > 0.5
    phases, sds = [PHASE, STATES + PHASE], np.sqrt(np.diagonal(fresh.blocks.covariances, axis1=1, axis2=2))
    off = (again.blocks.states - fresh.blocks.states)[:, phases]
    assert np.abs(off / sds[:, phases]).max() < 0.02
    assert again.log_likelihood == pytest.approx(fresh.log_likelihood, abs=0.1)


def test_half_a_turn_tells_what_a_whole_one_does() -> None:
    device = devices.load("imaging")
    assert device.readout is not None
    force = np.array([1350.0, -1800j, -450.0 + 30j, 20.0])
    for name in "xy":
        m = device.axis(name).require_mechanics()
        law = axis_law(device.axis(name), device.readout)
        for amplitude, phase in ((0.05, 0.3), (0.18, -1.0), (0.3, 2.5)):
            args = amplitude, phase, 2 * np.pi * 13840.0, 1.001 * m.k, 0.9 * m.b, force
            for own in (law, law._replace(position=True)):
                half, whole = turn_of(own, *args), turn_of(own._replace(theta_th=1e-300), *args)
                for a, b in zip(half, whole, strict=True):
                    assert np.abs(a - b).max() <= 1e-11 * np.abs(b).max()


def test_the_step_takes_what_its_jacobian_says() -> None:
    prepared = prepared_of(8)
    linear = unmade(prepared.signal)
    run = run_of(prepared, linear=linear)

    def stepped(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        P, taken = np.zeros((x.size, x.size)), np.empty((2, 2, DAMPING + 1))
        predict(prepared.rows, prepared.signal, 5, x, P, densities(0.0 * WALK), 0.0, linear, taken)
        return x, taken

    x, step = run.blocks.states[5], 1e-5
    whole, taken = stepped(x.copy())
    for a in range(2):
        for state in (PHASE, LOG, STIFFNESS, TREND, DAMPING):
            moved = x.copy()
            moved[a * STATES + state] += step
            slope = (stepped(moved)[0] - whole)[a * STATES : a * STATES + 2] / step
            assert slope == pytest.approx(taken[a, :, state], rel=1e-5, abs=1e-9)


def test_measurement_is_linearised_with_the_rate_that_stiffness_and_damping_give() -> None:
    prepared = prepared_of(8)
    x = starting_belief(prepared, devices.load("imaging")).x
    room, root = np.empty((2, RATES), np.complex128), prepared.signal.roots[prepared.signal.geometry[3]]
    x[STIFFNESS], x[DAMPING], step = 1e-3, 0.05, 1e-5

    def whitened(at: np.ndarray) -> np.ndarray:
        return sum(a @ b for a, b in zip(root, expected(prepared.rows, prepared.signal, 3, at, room)[0], strict=True))

    _, jacobian = expected(prepared.rows, prepared.signal, 3, x, room)
    for state in (PHASE, LOG, STIFFNESS, DAMPING, GAIN, STATES + STIFFNESS, x.size - 1):
        moved = np.arange(x.size) == state
        slope = (whitened(x + step * moved) - whitened(x - step * moved)) / (2 * step)
        own = sum(a @ b for a, b in zip(root, jacobian, strict=True))[:, state]
        assert np.abs(own - slope).max() < 0.05 * np.abs(slope).max()


def test_score_is_the_slope_of_the_likelihood() -> None:
    prepared = prepared_of(8)

    def told(trend: float) -> tuple[float, np.ndarray, np.ndarray]:
        linear, walk = unmade(prepared.signal), WALK.copy()
        walk[0, 1] *= trend
        run = run_of(prepared, walk, linear)
        return run.log_likelihood, *kicks(prepared.signal, linear, run.blocks)

    slope = (told(1.1)[0] - told(0.9)[0]) / 0.2
    _, squares, spreads = told(1.0)
    score = 0.5 * (squares - spreads)[TREND] * WALK[0, 1] * prepared.signal.step
    assert score == pytest.approx(slope, rel=0.1)


def test_windows_give_what_one_pass_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = prepared_of(8)
    start, _ = signed(prepared, starting_belief(prepared, devices.load("imaging")))
    walk = tuned_walk(prepared, start, stretches(prepared.signal))[None]
    (whole,) = follow(prepared, start, walk)
    module = sys.modules["estimation.tracker.track"]
    monkeypatch.setattr(module, "WINDOW", 10)
    monkeypatch.setattr(module, "LAG", 35)
    (pieces,) = follow(prepared, start, walk)
    assert (np.abs(pieces.states - whole.states) < 0.1 * whole.sds)[:, [0, 6]].all()


def test_an_earlier_track_shortens_the_tuning(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, device = noisy(8), devices.load("imaging")
    module, rounds = sys.modules["estimation.tracker.tuning"], []

    def counted(*args: object) -> object:
        rounds.append(1)
        return kicks(*args)

    monkeypatch.setattr(module.backward, "kicks", counted)
    alone = track(recording, device)
    cold = len(rounds)
    again = track(recording, device, before=alone)
    assert len(rounds) - cold < cold
    for name, axis in again.axes.items():
        assert np.all(np.abs(axis.phase - alone.axes[name].phase) < 0.2 * axis.phase_sd)


@pytest.mark.parametrize("at", [PHASE, LOG, STIFFNESS, DAMPING, GAIN, STATES + PHASE, 2 * STATES])
def test_any_state_but_the_trend_counts_as_it_is(at: int) -> None:
    x = np.zeros(2 * STATES + 1)
    x[at] = -2.0 * NONLINEAR
    assert change(x, np.zeros(x.size), 6e-4) == 2.0 * NONLINEAR


def test_a_trend_counts_as_what_it_makes_of_the_stiffness_over_a_block() -> None:
    x = np.zeros(2 * STATES + 1)
    x[STATES + TREND] = 0.1
    assert change(x, np.zeros(x.size), 6e-4) == pytest.approx(6e-5)


@pytest.mark.parametrize("share", [0.12, 0.15, 0.3])
def test_the_sign_is_told_from_either_start_whatever_the_blocks(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signal, "DECAY_SHARE", share)
    device, recording = transimpedance_world()
    prepared = blocks_of(recording, device)
    start = starting_belief(prepared, device)
    turned = start.x.copy()
    turned[PHASE] += np.pi
    told = [signed(prepared, each) for each in (start, replace(start, x=turned))]
    assert [sure for _, (sure,) in told] == ["known: the combs' offset theta_th"] * 2
    apart = told[0][0].x[PHASE] - told[1][0].x[PHASE]
    assert np.exp(1j * apart) == pytest.approx(1.0)
