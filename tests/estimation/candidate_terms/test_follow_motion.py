"""A motion that the growing windows of the nominal fit lose, and that windows in between follow or lose too."""

from types import SimpleNamespace

import pytest

from estimation.candidate_terms import anchor

STOPS = (0.1, 0.3, 1.0)


@pytest.mark.parametrize(
    ("ratios", "grown_ratio", "start", "is_grown"),
    [
        ((0.01, 0.02, 0.1), 0.0, None, False),  # it is followed
        ((0.01, 0.02, 2.0), 0.1, 0.3, True),
        ((0.01, 1.50, 2.0), 0.1, 0.1, True),
        ((0.01, 0.02, 2.0), 1.0, 0.3, False),  # an effect is missing
    ],
)
def test_windows_in_between_are_used_where_only_they_follow_the_motion(
    monkeypatch: pytest.MonkeyPatch,
    ratios: tuple[float, ...],
    grown_ratio: float,
    start: float | None,
    is_grown: bool,
) -> None:
    early = [SimpleNamespace(model="nominal", x=stop, ratio=ratio) for stop, ratio in zip(STOPS, ratios, strict=True)]
    grown, started = SimpleNamespace(ratio=grown_ratio), []
    monkeypatch.setattr(anchor, "residual_ratio", lambda likelihood, fit, stop=1.0: fit.ratio)
    monkeypatch.setattr(anchor, "fit_growing", lambda likelihood, model, x, stop: started.append((x, stop)) or grown)
    assert anchor.follow_motion(None, early, STOPS) is (grown if is_grown else early[-1])  # type: ignore[arg-type]
    assert started == ([] if start is None else [(start, start)])
