"""Posterior Cramér-Rao bound of the phase: the least standard deviation that any estimator can have.

The Fisher information of every single sample about phase, amplitude, gain and offset is summed along the true
trajectory, without demodulation. It is propagated through the process by the recursion of Tichavsky, Muravchik and
Nehorai. The bound of a smoother is the backward pass of that recursion.

docs/explanation/tracker.md derives it.

Source: Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal Process. 46, 1386 (1998).
"""

from __future__ import annotations

import numpy as np

from estimation.tracker.averaged_dynamics import MAX_READOUT_HARMONIC, average_cycle, unpack_parameters
from estimation.tracker.demodulation import sample_offsets
from estimation.tracker.kalman_filter import empty_history
from estimation.tracker.linearisation import empty_linearisation, linearise, predict
from estimation.tracker.observations import BlockObservations
from estimation.tracker.rts_smoother import run_smoother
from estimation.tracker.state_space import AXIS_STATES, DAMPING, GAIN, LOG_AMPLITUDE, PHASE, STIFFNESS, padded_size
from scanner.arrays import Array
from scanner.harmonics import readout_response

NO_RAILS = (-np.inf, np.inf)
"""Rails of a signal that is not clipped [V]."""


def phase_sd_bounds(
    observations: BlockObservations,
    states: Array,
    P: Array,
    densities: Array,
    noise_var: float,
    rails: tuple[float, float] = NO_RAILS,
) -> tuple[Array, Array]:
    """Least standard deviations of phi of any filter and of any smoother, each of shape (blocks, axes) [rad].

    Args:
        states: true states at the blocks' middles, shape (blocks, states), see ``state_space``.
        P: prior covariance before the first block, shape (states, states).
        densities: of the true process noise, shape (axes, 4); the offset is constant.
        noise_var: of a sample [V^2].
        rails: beyond which only the side of a sample is known [V].
    """
    blocks, n = states.shape
    parameter_rows, signal = observations.parameter_rows, observations.signal
    linear, history = empty_linearisation(signal), empty_history(blocks, len(parameter_rows))
    covariance, x = np.zeros((padded_size(n), padded_size(n))), np.zeros(padded_size(n))
    covariance[:n, :n] = P
    history.states[:], history.predicted_states[:] = 0.0, 0.0
    x[:n] = states[0]
    linearise(parameter_rows, signal, 0, x, linear)
    for k in range(blocks):
        if k > 0:
            x[:n] = states[k - 1]
            predict(parameter_rows, signal, k - 1, x, covariance, densities, 0.0, linear, history.transitions[k])
        history.predicted_covariances[k] = covariance
        information = _fisher_information(observations, k, states[k], noise_var, rails)
        covariance[:n, :n] = np.linalg.inv(np.linalg.inv(covariance[:n, :n]) + information)
        history.covariances[k] = covariance
    phases = [a * AXIS_STATES + PHASE for a in range(len(parameter_rows))]
    filtered = np.sqrt(np.diagonal(history.covariances, axis1=1, axis2=2)[:, phases])
    run_smoother(signal.step, history)
    return filtered, np.sqrt(np.diagonal(history.covariances, axis1=1, axis2=2)[:, phases])


def censored_information_fraction(h: Array, rails: tuple[float, float], sd: float) -> Array:
    """Fraction of the Fisher information of samples that remains if beyond ``rails`` only the side is known, (n,).

    With z the distance from h to a rail over sd, and g and Q the normal density and upper tail, each rail subtracts
    Q + z g (samples lost, and selection of those that are left) and adds g^2 / Q (the number of samples beyond).

    Args:
        h: expected samples, shape (n,) [V]. rails: [V]. sd: of the noise [V].

    Source: Tobin, Econometrica 26, 24 (1958).
    """
    from scipy.stats import norm

    out = np.ones(h.shape)
    for z in ((rails[1] - h) / sd, (h - rails[0]) / sd):
        near = np.clip(z, -30.0, 30.0)
        out += np.exp(2.0 * norm.logpdf(near) - norm.logsf(near)) - near * norm.pdf(near) - norm.sf(near)
    return out


def _fisher_information(
    observations: BlockObservations, k: int, x: Array, noise_var: float, rails: tuple[float, float]
) -> Array:
    """Fisher information of all samples of block ``k`` about the state ``x``, shape (states, states)."""
    signal, channel = observations.signal, observations.sense.channel
    length = round(signal.step * channel.sample_rate)
    offset = sample_offsets(length, channel.sample_rate)
    gradient, h = np.zeros((x.size, length)), np.full(length, x[-1])
    gradient[-1] = 1.0
    orders = np.arange(MAX_READOUT_HARMONIC + 1)
    for a, law in enumerate(observations.parameters):
        at = a * AXIS_STATES
        row, amplitude = unpack_parameters(observations.parameter_rows[a]), np.exp(x[at + LOG_AMPLITUDE])
        cycle = average_cycle(row, amplitude, x[at + PHASE], signal.w[k, a], law.k, law.b, signal.force[k, a])
        w = signal.w[k, a] + cycle.rate.imag
        u = signal.psi[k, a] + x[at + PHASE] + w * offset
        response = readout_response(observations.sense.readout, orders * w / (2 * np.pi))
        phasors = response[:, None] * np.exp(1j * orders[:, None] * u)
        h += np.exp(x[at + GAIN]) * np.real(cycle.readout_harmonics @ phasors)
        gradient[at + PHASE] = np.real((1j * orders * cycle.readout_harmonics) @ phasors)
        gradient[at + LOG_AMPLITUDE] = np.real(cycle.readout_by_log @ phasors)
        gradient[at + GAIN] = np.real(cycle.readout_harmonics[1:] @ phasors[1:])
        for state, by in ((STIFFNESS, cycle.by_stiffness), (DAMPING, cycle.by_damping)):  # through the rate
            gradient[at + state] = offset * (by.imag * gradient[at + PHASE] + by.real * gradient[at + LOG_AMPLITUDE])
    if rails == NO_RAILS:
        return gradient @ gradient.T / noise_var
    fraction = censored_information_fraction(h, rails, float(np.sqrt(noise_var)))
    return gradient * fraction @ gradient.T / noise_var
