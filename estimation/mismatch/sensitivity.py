"""What a recording can tell: every effect's size in sigma, and how far it stands from its nearest look-alike.

The sensitivities are those of the whitened channels with everything nominal projected out. Two effects that lie d sigma
apart are told apart with probability about Phi(d/2): 95 % at 3.3; one is named alone from 4.5 on.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.mismatch.experiment import Output
from estimation.mismatch.fit import Comparison, Fit, unmoved
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.noise import Whitener, flat_psd, whitener
from estimation.mismatch.screen import all_candidates, amplitudes, from_starts
from scanner.errors import BadInput
from scanner.terms import Term

Array = NDArray[np.float64]

APART = 4.5
"""Distance [sigma] from which an effect is named alone."""


@dataclass(frozen=True)
class Visible:
    """How well one effect of its natural size shows.

    Attributes:
        candidate: the effect, with axis and channel.
        sigma: its size.
        nearest: the effect that imitates it best, itself where there is no other.
        distance: what is left of it after that and all nominal values have done their best [sigma].
    """

    candidate: Candidate
    sigma: float
    nearest: Candidate
    distance: float


def visibility(comparison: Comparison, fit: Fit, terms: Iterable[Term]) -> list[Visible]:
    """Every effect around ``fit``, the clearest first; effects already in it are left out.

    An effect with a time constant or a frequency has the median size of those that it is searched from; a look-alike
    may take whichever imitates best.
    """
    taken = {each.key for each in fit.model.candidates}
    candidates = [c for c in all_candidates(fit.model.device, fit.model, terms) if c.key not in taken]
    blocks = columns(comparison, fit, candidates)
    found = [(candidate, block) for candidate, own in zip(candidates, blocks, strict=True) for block in own]
    if not found:
        return []
    sizes, apart = distances(fit, [block for _, block in found], comparison.rows)
    keys = np.array([candidate.key for candidate, _ in found])
    effects = np.array([candidate.term.effect for candidate, _ in found])
    shown = []
    for candidate in candidates:
        own = np.flatnonzero(keys == candidate.key)
        if not own.size:
            continue
        i = own[np.argsort(sizes[own])[own.size // 2]]
        others = np.flatnonzero(effects != candidate.term.effect)
        nearest = min(others, key=lambda j: apart[i, j], default=i)
        shown.append(Visible(candidate, float(sizes[i]), found[nearest][0], float(apart[i, nearest])))
    return sorted(shown, key=lambda each: -each.sigma)


def columns(comparison: Comparison, fit: Fit, candidates: Sequence[Candidate]) -> list[list[Array]]:
    """Sensitivities to every candidate around ``fit``, shape (N, q), for each of its starts that shows anything.

    What the unknown start of a hidden state could do is no sign of the effect and is taken out.
    """
    rows, shown = comparison.rows, []
    for screened in from_starts(comparison, fit, candidates):
        blocks = []
        for each in screened:
            own, hidden = np.split(each.columns, [max(1, len(amplitudes(each.model, each.candidate)))], axis=1)
            if np.any(own):
                blocks.append(own - hidden @ np.linalg.lstsq(hidden[rows], own[rows], rcond=None)[0])
        shown.append(blocks)
    return shown


def distances(fit: Fit, blocks: Sequence[Array], rows: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Sizes and distances of effects of their natural size.

    Args:
        blocks: sensitivities to each, shape (N, q).

    Returns:
        (size [sigma], shape (n,); distance of effect i to effect j [sigma], shape (n, n)).
    """
    signals = np.stack([block[rows] @ np.full(block.shape[1], block.shape[1] ** -0.5) for block in blocks], axis=1)
    return left_over(fit.jacobian[rows], fit.model.precision, signals, [block[rows] for block in blocks])


def left_over(nominal: Array, precision: Array, signals: Array, blocks: Sequence[Array]) -> tuple[Array, Array]:
    """What of ``signals`` neither nominal values nor a look-alike can imitate, within their priors.

    Args:
        nominal: sensitivities to the nominal values, shape (N, m); ``precision``: of their priors, (m,).
        signals: shape (N, n).
        blocks: sensitivities to each look-alike, per prior standard deviation, shape (N, q).

    Returns:
        (size behind the nominal values, shape (n,); size behind look-alike j too, shape (n, len(blocks))).
    """
    whole = np.column_stack([signals, *blocks])
    cross = nominal.T @ whole
    gram = whole.T @ whole - cross.T @ np.linalg.solve(nominal.T @ nominal + np.diag(precision), cross)
    n = signals.shape[1]
    ends = n + np.cumsum([0, *(block.shape[1] for block in blocks)])
    size = np.maximum(np.diag(gram)[:n], 0.0)
    apart = np.empty((n, len(blocks)))
    for j in range(len(blocks)):
        part = slice(ends[j], ends[j + 1])
        overlap = gram[part, :n]
        inner = gram[part, part] + np.eye(blocks[j].shape[1])
        apart[:, j] = size - np.einsum("ij,ij->j", overlap, np.linalg.solve(inner, overlap))
    return np.sqrt(size), np.sqrt(np.maximum(apart, 0.0))


def linearised(model: Model, x: Array, whiteners: Sequence[Sequence[Whitener]]) -> tuple[Comparison, Fit]:
    """The comparison that a model would meet if its own signals at ``x`` were recorded, and its perfect fit there."""
    runs = [
        replace(run, outputs=tuple(replace(o, data=signal) for o, signal in zip(run.outputs, signals, strict=True)))
        for run, signals in zip(model.runs, model.outputs(x), strict=True)
    ]
    made = Model(runs, model.device, model.candidates, model.mains)
    comparison = Comparison(runs, whiteners)
    return comparison, unmoved(comparison, made, x)


def stated_whitener(output: Output) -> Whitener:
    """The whitening for the noise that is stated; for that of the channel's own high frequencies where none is.

    Raises:
        BadInput: the stated noise is zero.
    """
    if output.noise_sd is None:
        return whitener(flat_psd(output.data, output.bins), output.data.size, output.guard)
    if output.noise_sd <= 0.0:
        hint = "state noise_var or noise_sd of the readout"
        raise BadInput("its readout states no noise: every effect would show", channel=output.name, hint=hint)
    thinning = output.step * output.full_rate
    power = output.data.size * output.noise_sd**2 / thinning
    return whitener(np.full(output.bins, power), output.data.size, output.guard)
