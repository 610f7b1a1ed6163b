"""What a diagnosis says about the device that it writes."""

import pytest

from recon.report.conclusions import conclude_diagnosis

CORRECTED, NOMINAL = "Use the corrected device.toml", "device.toml is the nominal device"


@pytest.mark.parametrize(
    ("improved", "channel", "text"), [(0.2, "sense", CORRECTED), (0.9, "sense", NOMINAL), (0.9, "intensity", CORRECTED)]
)
def test_a_device_that_is_not_corrected_is_not_recommended(improved: float, channel: str, text: str) -> None:
    finding = {"axis": "x", "stage": "mechanics", "effect": "unknown", "parameters": [], "channel": channel}
    loops = {"sense_x": {"nominal": {"rmse": 0.9}, "improved": {"rmse": improved}}}
    assert text in conclude_diagnosis({"verdict": "mismatch", "findings": [finding], "open_loop": loops})


def test_what_was_not_tested_is_said_and_nothing_else_of_it() -> None:
    content = {"verdict": "consistent", "findings": [], "untested": "the picture, because it cannot be made"}
    text = conclude_diagnosis(content)
    assert text.endswith("Not tested: the picture, because it cannot be made.")
    assert "pictures agree" not in text
