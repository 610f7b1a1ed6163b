"""What a further law has to explain beside laws that take the bulk of a misfit."""

from hypothesis import given
from hypothesis import strategies as st

from estimation.diagnosis.necessity import MIN_EXPLAINED_RATIO, NO_LAWS, Need, least_explained


@given(remaining=st.floats(1.0, 1e6), explained=st.floats(0.0, 1e6))
def test_a_law_that_explains_less_cannot_be_the_answer(remaining: float, explained: float) -> None:
    """Corrections beside the law explain at least ``remaining - explained``, of which it needs a part."""
    least = least_explained(Need(possible=True, certain=True, takes_bulk=True, remaining=remaining))
    enough = explained >= MIN_EXPLAINED_RATIO * (remaining - explained)
    if abs(explained - least) > 1e-9 * remaining:
        assert enough == (explained > least)


def test_beside_laws_that_do_not_take_the_bulk_nothing_is_excluded() -> None:
    assert least_explained(NO_LAWS) == 0.0
    assert least_explained(Need(possible=True, certain=False, takes_bulk=False, remaining=100.0)) == 0.0
