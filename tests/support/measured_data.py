"""Where the measured data of other laboratories lie: in ``../shared/data`` beside the checkout, never inside it."""

from pathlib import Path

MEASURED_DATA = Path(__file__).parent.parent.parent.parent / "shared" / "data"
