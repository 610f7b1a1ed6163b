"""Detectability of every effect in sigma, and its distance from the nearest confounder.

Sensitivities are those of the whitened channels with the nominal values projected out. Two effects at a distance of d
sigma are distinguished with probability Phi(d/2): 95 % at 3.3. From 4.5 on an effect is identified alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import erfc, sqrt

import numpy as np

from estimation.candidate_terms.screening import all_candidates, amplitude_indices, score_candidate_starts
from estimation.candidate_terms.significance import residual_is_noise
from estimation.device_fit.fit import Fit, Likelihood, nominal_values_are_improbable, stated_values
from estimation.device_fit.parameters import Candidate
from scanner.arrays import Array
from scanner.terms import Term

DISCRIMINATION_SIGMA = 4.5
"""Distance [sigma] from which an effect is identified alone. The wrong one of two effects at this distance is chosen
with a probability of about 1 %."""

MIN_NOMINAL_CHANGE = 1e-9
"""Change of a nominal value, in tolerances, below which it is rounding and the value counts as unchanged."""

MAX_POSTERIOR_VARIANCE = 0.5
"""Ratio of posterior to prior variance of a direction of the nominal values above which the recording does not
determine it: then the recording has less information on it than the stated tolerance."""


def confusion_probability(distance: float) -> float:
    """Probability that noise favours the wrong one of two effects at this distance [sigma]: Phi(-d/2)."""
    return 0.5 * erfc(0.5 * distance / sqrt(2.0))


def determined_parameters(fit: Fit) -> Array:
    """Parameters of a fit with the nominal values changed only along directions that the recording determines.

    Along the others, for example readout gain against torque of a linear drive, they have their stated values. All
    other parameters are refitted under that condition, to first order. All nominal values are as stated where they have
    absorbed a misfit that no finding explains.

    Returns:
        shape of ``fit.x``.
    """
    if _has_absorbed_misfit(fit):
        return stated_values(fit.model, fit.x)
    nominal, covariance = fit.model.indices("nominal"), fit.covariance
    variance, directions = np.linalg.eigh(covariance[np.ix_(nominal, nominal)])
    fixed = directions[:, variance > MAX_POSTERIOR_VARIANCE].T
    if not fixed.size:
        return fit.x
    condition = np.zeros((len(fixed), fit.x.size))
    condition[:, nominal] = fixed
    gain = covariance @ condition.T @ np.linalg.inv(condition @ covariance @ condition.T)
    x = fit.x - gain @ (condition @ fit.x)
    unchanged = [i for i in nominal if abs(x[i]) < MIN_NOMINAL_CHANGE]
    x[unchanged] = 0.0
    return np.asarray(x)


def _has_absorbed_misfit(fit: Fit) -> bool:
    """Whether nominal values lie improbably far from the stated ones in a fit that leaves a misfit.

    It matters where combs alone sense the motion: the angle then rests on the shape of the capacitance, which a misfit
    of any cause changes. In a simulated scan whose second drift was not found, an angle was 15 % too large.
    """
    model = fit.model
    senses_alone = all(output.kind == "sense" for run in model.runs for output in run.outputs)
    if not (senses_alone and all(model.device.axes[axis].capacitance for axis in model.axes)):
        return False
    return nominal_values_are_improbable(fit) and not residual_is_noise(fit)


@dataclass(frozen=True)
class Detectability:
    """Detectability of one effect of its natural size.

    Attributes:
        candidate: the effect, with axis and channel.
        sigma: norm of its signal after all nominal values are refitted [sigma].
        nearest: the confounder that fits its signal best; the effect itself if there is no other.
        distance: norm that remains after that confounder is also fitted [sigma].
    """

    candidate: Candidate
    sigma: float
    nearest: Candidate
    distance: float


def detectability(likelihood: Likelihood, fit: Fit, terms: Iterable[Term]) -> list[Detectability]:
    """Detectability of every effect that ``fit`` does not contain, the largest first.

    The sensitivity to an effect with a time constant or frequency depends on that parameter: the effect itself is
    evaluated at the grid point of median size, a confounder at the one that fits best.
    """
    present = {candidate.key for candidate in fit.model.candidates}
    candidates = [c for c in all_candidates(fit.model, terms) if c.key not in present]
    linearisations = [
        (candidate, block[likelihood.rows])
        for candidate, blocks in zip(candidates, candidate_sensitivities(likelihood, fit, candidates), strict=True)
        for block in blocks
    ]
    if not linearisations:
        return []
    blocks = [block for _, block in linearisations]
    signals = np.stack([block @ np.full(block.shape[1], block.shape[1] ** -0.5) for block in blocks], axis=1)
    nominal = fit.jacobian[likelihood.rows]
    sizes, distances = unexplained_norms(nominal, fit.model.precision, signals, blocks)
    keys = np.array([candidate.key for candidate, _ in linearisations])
    effects = np.array([candidate.term.effect for candidate, _ in linearisations])
    results = []
    for candidate in candidates:
        of_candidate = np.flatnonzero(keys == candidate.key)
        if not of_candidate.size:
            continue
        i = of_candidate[np.argsort(sizes[of_candidate])[of_candidate.size // 2]]
        other_effects = np.flatnonzero(effects != candidate.term.effect)
        nearest = min(other_effects, key=lambda j: distances[i, j], default=i)
        results.append(
            Detectability(candidate, float(sizes[i]), linearisations[nearest][0], float(distances[i, nearest]))
        )
    return sorted(results, key=lambda result: -result.sigma)


def candidate_sensitivities(likelihood: Likelihood, fit: Fit, candidates: Sequence[Candidate]) -> list[list[Array]]:
    """Sensitivities of the whitened samples to every candidate around ``fit``.

    The effect of the unknown initial hidden state is projected out, because it is no evidence for the term.

    Returns:
        for each candidate a list of arrays of shape (N, q): one for each point of linearisation with any effect.
    """
    rows, sensitivities = likelihood.rows, []
    for scores in score_candidate_starts(likelihood, fit, candidates):
        blocks = []
        for score in scores:
            amplitudes = max(1, len(amplitude_indices(score.model, score.candidate)))
            columns, hidden = np.split(score.columns, [amplitudes], axis=1)
            if np.any(columns):
                blocks.append(columns - hidden @ np.linalg.lstsq(hidden[rows], columns[rows], rcond=None)[0])
        sensitivities.append(blocks)
    return sensitivities


def unexplained_norms(nominal: Array, precision: Array, signals: Array, blocks: Sequence[Array]) -> tuple[Array, Array]:
    """Norms of ``signals`` that remain after nominal values, and also a confounder, are fitted within their priors.

    Args:
        nominal: sensitivities to the nominal values, shape (N, m); ``precision``: of their priors, (m,).
        signals: shape (N, n).
        blocks: sensitivities to each confounder, per prior standard deviation, shape (N, q).

    Returns:
        (norm after the nominal values, shape (n,); norm after confounder j too, shape (n, len(blocks))).
    """
    columns = np.column_stack([signals, *blocks])
    cross = nominal.T @ columns
    gram = columns.T @ columns - cross.T @ np.linalg.solve(nominal.T @ nominal + np.diag(precision), cross)
    n = signals.shape[1]
    ends = n + np.cumsum([0, *(block.shape[1] for block in blocks)])
    size = np.maximum(np.diag(gram)[:n], 0.0)
    remaining = np.empty((n, len(blocks)))
    for j in range(len(blocks)):
        part = slice(ends[j], ends[j + 1])
        overlap = gram[part, :n]
        inner = gram[part, part] + np.eye(blocks[j].shape[1])
        remaining[:, j] = size - np.einsum("ij,ij->j", overlap, np.linalg.solve(inner, overlap))
    return np.sqrt(size), np.sqrt(np.maximum(remaining, 0.0))
