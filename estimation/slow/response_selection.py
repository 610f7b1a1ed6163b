"""Selection of the effects that a frequency response shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from estimation.device_fit.open_loop import OpenLoop, is_worse
from estimation.slow.response import (
    MIN_SCORE_GAIN,
    READOUT_SUBSETS,
    SECOND_MODE,
    SUBSETS,
    Response,
    ResponseFit,
    fit_common_modes,
    fit_response,
)

MAX_CONSISTENT_ERROR = 0.05
"""Error on held-out tones, as a fraction of the response, up to which a fit may be called consistent."""


def fit_subsets(response: Response) -> dict[tuple[str, ...], ResponseFit]:
    """A fit of every combination of effects."""
    return {effects: fit_response(response, effects) for effects in SUBSETS}


def select_response_effects(
    response: Response, table: Mapping[tuple[str, ...], ResponseFit] | None = None
) -> ResponseFit:
    """The fit of the lowest score, without effects that predict worse than the same fit without them.

    Args:
        response: of one axis.
        table: fits of all combinations; None computes them.
    """
    table = table or fit_subsets(response)
    best = min(table.values(), key=lambda fit: fit.score)
    if table[()].score - best.score < MIN_SCORE_GAIN:
        return table[()]
    for effect in best.effects:
        without = table[tuple(each for each in best.effects if each != effect)]
        if predicts_worse(prediction_error(response, without), prediction_error(response, best)):
            return without
    return best


def with_common_modes(responses: Sequence[Response], selected: list[ResponseFit]) -> list[ResponseFit]:
    """The fits with two modes that all axes have in common, unless those of single axes have a clearly lower score.

    Modes belong to the structure. A single axis determines a weak mode less well than all of them.
    """
    same = all(np.array_equal(response.frequency, responses[0].frequency) for response in responses)
    if len(responses) < 2 or not same or not any(SECOND_MODE in fit.effects for fit in selected):
        return selected
    variants = [fit_common_modes(responses, (SECOND_MODE, *more)) for more in READOUT_SUBSETS]
    score, fits = min(variants, key=lambda variant: variant[0])
    return fits if score < sum(fit.score for fit in selected) + MIN_SCORE_GAIN else selected


def prediction_error(response: Response, fit: ResponseFit) -> OpenLoop:
    """Error of a fit on the tones that are held out, in the unit of the response."""
    rows = response.held_out
    squares = np.abs(response.values - fit.predicted)[rows] ** 2
    return OpenLoop(squares, float(np.sqrt(np.mean(np.abs(response.values[rows]) ** 2))))


def predicts_worse(before: OpenLoop, after: OpenLoop) -> bool:
    return is_worse({"response": before}, {"response": after})
