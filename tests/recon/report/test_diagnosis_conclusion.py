"""What a diagnosis says about the device that it writes."""

import pytest

from recon.report.conclusions import conclude_diagnosis


@pytest.mark.parametrize(("improved", "text"), [(0.2, "Use the corrected device.toml"), (0.9, "is the nominal device")])
def test_a_device_that_is_not_corrected_is_not_recommended(improved: float, text: str) -> None:
    finding = {"axis": "x", "stage": "mechanics", "effect": "unknown", "parameters": []}
    loops = {"sense_x": {"nominal": {"rmse": 0.9}, "improved": {"rmse": improved}}}
    assert text in conclude_diagnosis({"verdict": "mismatch", "findings": [finding], "open_loop": loops})
