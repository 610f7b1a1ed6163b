"""What the laws that a device omits are selected from."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from estimation.candidate_terms.discrepancy import is_discrepancy
from estimation.device_fit.fit import Fit, Likelihood
from estimation.device_fit.parameters import Candidate

Progress = Callable[[str], None]
"""Called with one line of text at every step."""


@dataclass(frozen=True)
class Search:
    """What terms are selected from.

    Attributes:
        likelihood: under the noise that the nominal device leaves.
        nominal: fit of the nominal device over the whole recordings.
        early: fits of the nominal device over the windows ``stops``.
        stops: ends of growing windows as fractions of the recordings.
        pool: named laws and discrepancy terms on all axes and channels.
        curves: further discrepancy terms, beside which no laws are selected.
        progress: called with one line of text at every step.
    """

    likelihood: Likelihood
    nominal: Fit
    early: Sequence[Fit]
    stops: Sequence[float]
    pool: Sequence[Candidate]
    curves: Sequence[Candidate]
    progress: Progress

    @property
    def discrepancies(self) -> list[Candidate]:
        """The discrepancy terms among the candidates."""
        return list(filter(is_discrepancy, self.pool))

    def of_effects(self, effects: Collection[str]) -> list[Candidate]:
        """The candidates with these effects."""
        return [candidate for candidate in self.pool if candidate.term.effect in effects]
