"""Grammar of messages."""

import numpy as np
import pytest

from lissajous import Recording
from scanner.wording import counted, sentence


@pytest.mark.parametrize(("number", "text"), [(0, "0 values"), (1, "1 value"), (2, "2 values")])
def test_one_is_singular(number: int, text: str) -> None:
    assert counted(number, "value") == text


def test_a_sentence_keeps_the_name_of_its_channel() -> None:
    assert sentence("the picture is mirrored") == "The picture is mirrored."
    assert sentence("sense_x: is clipped in 3 %") == "sense_x: is clipped in 3 %."


def test_a_recording_counts_its_edges() -> None:
    for number, text in ((1, "sync_x: 1 edge, turn"), (2, "sync_x: 2 edges, turn")):
        recording = Recording.from_arrays({"sync_x": (np.arange(float(number)), "s", {"event": "turn"})})
        assert text in repr(recording)
