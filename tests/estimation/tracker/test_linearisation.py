"""Filter, smoother, linearisation and process noise of the tracker, compared with direct computations."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.clipped import simulate_transimpedance
from estimation.tracker import block_tracking, observations, rts_smoother, track
from estimation.tracker.averaged_dynamics import average_cycle, axis_parameters
from estimation.tracker.block_tracking import track_blocks
from estimation.tracker.filter_run import FilterRun, filter_blocks
from estimation.tracker.initial_state import choose_signs, initial_estimate
from estimation.tracker.linearisation import empty_linearisation, expected_projections, predict
from estimation.tracker.observations import BlockObservations
from estimation.tracker.process_noise import tune_process_noise, tuning_parts
from estimation.tracker.rts_smoother import disturbance_scores, run_smoother
from estimation.tracker.state_space import (
    AXIS_STATES,
    DAMPING,
    GAIN,
    LOG_AMPLITUDE,
    PHASE,
    RATE_TERMS,
    RELINEARISE_DISTANCE,
    STIFFNESS,
    STIFFNESS_RATE,
    state_distance,
)
from scanner import devices
from tests.support.simulated import blocks_of, noisy, prepared_of

WALK = np.tile([1e-7, 0.02, 1e-6, 1e-8], (2, 1))


def run_of(prepared: BlockObservations, walk: np.ndarray = WALK, linear=None) -> FilterRun:  # type: ignore[no-untyped-def]
    start = initial_estimate(prepared, devices.load("imaging"))
    return filter_blocks(prepared, prepared.signal, linear or empty_linearisation(prepared.signal), start, walk)


def rauch_tung_striebel(prepared: BlockObservations, linear, run: FilterRun) -> tuple[np.ndarray, ...]:  # type: ignore[no-untyped-def]
    """Textbook smoother: states, covariances, and both terms of the score (see ``disturbance_scores``)."""
    xs, Ps = run.history.states.copy(), run.history.covariances.copy()
    squares, spreads, used = np.zeros(xs.shape[1]), np.zeros(xs.shape[1]), slice(0, 2 * AXIS_STATES + 1)
    for k in range(len(xs) - 2, -1, -1):
        x, P, taken = run.history.states[k].copy(), run.history.covariances[k].copy(), np.empty((2, 2, DAMPING + 1))
        predict(
            prepared.parameter_rows,
            prepared.signal,
            k,
            x,
            P,
            WALK,
            prepared.signal.offset_density,
            linear,
            taken,
        )
        F = np.eye(x.size)
        for a in range(2):
            F[a * AXIS_STATES : a * AXIS_STATES + 2, a * AXIS_STATES : a * AXIS_STATES + DAMPING + 1] = taken[a]
            F[a * AXIS_STATES + STIFFNESS, a * AXIS_STATES + STIFFNESS_RATE] = prepared.signal.step
        inverse = np.zeros(P.shape)
        inverse[used, used] = np.linalg.inv(P[used, used])
        squares += (inverse @ (xs[k + 1] - x)) ** 2
        spreads += np.diag(inverse @ (P - Ps[k + 1]) @ inverse)
        gain = Ps[k] @ F.T @ inverse
        xs[k] += gain @ (xs[k + 1] - x)
        Ps[k] += gain @ (Ps[k + 1] - P) @ gain.T
    return xs, Ps, squares, spreads


def test_smoother_and_score_agree_with_the_textbook() -> None:
    prepared = prepared_of(8)
    linear = empty_linearisation(prepared.signal)
    run = [run_of(prepared, linear=linear) for _ in range(3)][-1]  # the last one changes no linearisation
    made = linear.point.copy()
    xs, Ps, squares, spreads = rauch_tung_striebel(prepared, linear, run)
    assert (linear.point == made).all()
    scores = disturbance_scores(prepared.signal, linear, run.history)
    run_smoother(prepared.signal.step, run.history)
    deviations = np.sqrt(np.diagonal(Ps, axis1=1, axis2=2))
    used = slice(0, 2 * AXIS_STATES + 1)
    assert np.abs((run.history.states - xs) / np.maximum(deviations, 1e-12))[:, used].max() < 1e-6
    own = np.sqrt(np.diagonal(run.history.covariances, axis1=1, axis2=2))
    assert own[:, used] == pytest.approx(deviations[:, used], rel=1e-6)
    walked = [
        0,
        1,
        STIFFNESS_RATE,
        DAMPING,
        AXIS_STATES,
        AXIS_STATES + 1,
        AXIS_STATES + STIFFNESS_RATE,
        AXIS_STATES + DAMPING,
    ]
    assert scores[0][walked] == pytest.approx(squares[walked], rel=1e-4)
    assert scores[1][walked] == pytest.approx(spreads[walked], rel=1e-4)


def test_stored_linearisation_gives_the_same_result_for_other_densities() -> None:
    prepared = prepared_of(8)
    linear = empty_linearisation(prepared.signal)
    run_of(prepared, 30.0 * WALK, linear)
    made = linear.point.copy()
    again, fresh = run_of(prepared, WALK, linear), run_of(prepared, WALK)
    assert np.mean((linear.point == made).all(axis=1)) > 0.5
    phases, sds = [PHASE, AXIS_STATES + PHASE], np.sqrt(np.diagonal(fresh.history.covariances, axis1=1, axis2=2))
    off = (again.history.states - fresh.history.states)[:, phases]
    assert np.abs(off / sds[:, phases]).max() < 0.02
    assert again.log_likelihood == pytest.approx(fresh.log_likelihood, abs=0.1)


def test_half_a_cycle_gives_the_harmonics_of_a_whole_one() -> None:
    device = devices.load("imaging")
    assert device.readout is not None
    force = np.array([1350.0, -1800j, -450.0 + 30j, 20.0])
    for name in "xy":
        m = device.axis(name).require_mechanics()
        law = axis_parameters(device.axis(name), device.readout)
        for amplitude, phase in ((0.05, 0.3), (0.18, -1.0), (0.3, 2.5)):
            args = amplitude, phase, 2 * np.pi * 13840.0, 1.001 * m.k, 0.9 * m.b, force
            for own in (law, law._replace(is_position=True)):
                half, whole = average_cycle(own, *args), average_cycle(own._replace(theta_th=1e-300), *args)
                for a, b in zip(half, whole, strict=True):
                    assert np.abs(a - b).max() <= 1e-11 * np.abs(b).max()


def test_step_agrees_with_its_jacobian() -> None:
    prepared = prepared_of(8)
    linear = empty_linearisation(prepared.signal)
    run = run_of(prepared, linear=linear)

    def stepped(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        P, taken = np.zeros((x.size, x.size)), np.empty((2, 2, DAMPING + 1))
        predict(prepared.parameter_rows, prepared.signal, 5, x, P, 0.0 * WALK, 0.0, linear, taken)
        return x, taken

    x, step = run.history.states[5], 1e-5
    whole, taken = stepped(x.copy())
    for a in range(2):
        for state in (PHASE, LOG_AMPLITUDE, STIFFNESS, STIFFNESS_RATE, DAMPING):
            moved = x.copy()
            moved[a * AXIS_STATES + state] += step
            slope = (stepped(moved)[0] - whole)[a * AXIS_STATES : a * AXIS_STATES + 2] / step
            assert slope == pytest.approx(taken[a, :, state], rel=1e-5, abs=1e-9)


def test_measurement_jacobian_includes_the_rate_by_stiffness_and_damping() -> None:
    prepared = prepared_of(8)
    x = initial_estimate(prepared, devices.load("imaging")).mean
    room, root = np.empty((2, RATE_TERMS), np.complex128), prepared.signal.whitened_moments[prepared.signal.geometry[3]]
    x[STIFFNESS], x[DAMPING], step = 1e-3, 0.05, 1e-5

    def whitened(at: np.ndarray) -> np.ndarray:
        return sum(
            a @ b
            for a, b in zip(
                root, expected_projections(prepared.parameter_rows, prepared.signal, 3, at, room)[0], strict=True
            )
        )

    _, jacobian = expected_projections(prepared.parameter_rows, prepared.signal, 3, x, room)
    for state in (PHASE, LOG_AMPLITUDE, STIFFNESS, DAMPING, GAIN, AXIS_STATES + STIFFNESS, x.size - 1):
        moved = np.arange(x.size) == state
        slope = (whitened(x + step * moved) - whitened(x - step * moved)) / (2 * step)
        own = sum(a @ b for a, b in zip(root, jacobian, strict=True))[:, state]
        assert np.abs(own - slope).max() < 0.05 * np.abs(slope).max()


def test_score_is_the_derivative_of_the_likelihood() -> None:
    prepared = prepared_of(8)

    def evaluate_with(trend: float) -> tuple[float, np.ndarray, np.ndarray]:
        linear, walk = empty_linearisation(prepared.signal), WALK.copy()
        walk[0, 1] *= trend
        run = run_of(prepared, walk, linear)
        return run.log_likelihood, *disturbance_scores(prepared.signal, linear, run.history)

    slope = (evaluate_with(1.1)[0] - evaluate_with(0.9)[0]) / 0.2
    _, squares, spreads = evaluate_with(1.0)
    score = 0.5 * (squares - spreads)[STIFFNESS_RATE] * WALK[0, 1] * prepared.signal.step
    assert score == pytest.approx(slope, rel=0.1)


def test_windows_give_the_result_of_one_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = prepared_of(8)
    start, _ = choose_signs(prepared, initial_estimate(prepared, devices.load("imaging")))
    walk = tune_process_noise(prepared, start, tuning_parts(prepared.signal))[0][None]
    (whole,) = track_blocks(prepared, start, walk)
    monkeypatch.setattr(block_tracking, "WINDOW_BLOCKS", 10)
    monkeypatch.setattr(block_tracking, "LOOKAHEAD_BLOCKS", 35)
    (pieces,) = track_blocks(prepared, start, walk)
    assert (np.abs(pieces.states - whole.states) < 0.1 * whole.sds)[:, [0, 6]].all()


def test_tuning_from_an_earlier_track_needs_fewer_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, device = noisy(8), devices.load("imaging")
    rounds = []

    def counted(*args: object) -> object:
        rounds.append(1)
        return disturbance_scores(*args)

    monkeypatch.setattr(rts_smoother, "disturbance_scores", counted)
    alone = track(recording, device)
    cold = len(rounds)
    again = track(recording, device, previous=alone)
    assert len(rounds) - cold < cold
    for name, axis in again.axes.items():
        assert np.all(np.abs(axis.phase - alone.axes[name].phase) < 0.2 * axis.phase_sd)


@pytest.mark.parametrize("at", [PHASE, LOG_AMPLITUDE, STIFFNESS, DAMPING, GAIN, AXIS_STATES + PHASE, 2 * AXIS_STATES])
def test_state_distance_is_the_largest_difference_of_a_state(at: int) -> None:
    x = np.zeros(2 * AXIS_STATES + 1)
    x[at] = -2.0 * RELINEARISE_DISTANCE
    assert state_distance(x, np.zeros(x.size), 6e-4) == 2.0 * RELINEARISE_DISTANCE


def test_stiffness_rate_counts_by_its_change_of_stiffness_over_a_block() -> None:
    x = np.zeros(2 * AXIS_STATES + 1)
    x[AXIS_STATES + STIFFNESS_RATE] = 0.1
    assert state_distance(x, np.zeros(x.size), 6e-4) == pytest.approx(6e-5)


@pytest.mark.parametrize("share", [0.12, 0.15, 0.3])
def test_sign_does_not_depend_on_the_start_or_the_block_length(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observations, "BLOCK_DECAY_TIMES", share)
    device, recording = simulate_transimpedance()
    prepared = blocks_of(recording, device)
    start = initial_estimate(prepared, device)
    turned = start.mean.copy()
    turned[PHASE] += np.pi
    results = [choose_signs(prepared, estimate) for estimate in (start, replace(start, mean=turned))]
    assert [sign for _, (sign,) in results] == ["known: the combs' offset theta_th"] * 2
    difference = results[0][0].mean[PHASE] - results[1][0].mean[PHASE]
    assert np.exp(1j * difference) == pytest.approx(1.0)
