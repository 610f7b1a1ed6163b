"""A second effect beside a first: when it is believed, and when it has to go."""

from pathlib import Path

from test_growing_mode import searched

from benchmarks.concealed.generator import Order


def test_a_clip_level_that_no_held_out_turn_reaches_is_found_beside_a_drift(tmp_path: Path) -> None:
    """A lead of 670 that gains 7 of 18 on samples that no fit saw, which scatters by 9, is no chance."""
    order = Order("sealed-001", "two", "ring", ("resonance-drift", "saturation"), False, 2209816513)
    _, found = searched(order, tmp_path, ("resonance-drift", "saturation", "sensor-cubic", "charging"))
    assert {each.candidate.term.effect for each in found.rounds} == {"resonance-drift", "saturation"}


def test_a_drift_that_slow_noise_explains_goes_though_it_came_with_a_true_lag(tmp_path: Path) -> None:
    """The two took a free correction's place together: the drift's lead of 184 is but 2 beyond what is excused."""
    order = Order("sealed-001", "one", "drive", ("readout-lag",), True, 2317301653)
    _, found = searched(order, tmp_path, ("readout-lag", "channel-delay", "offset-drift"))
    assert [each.candidate.term.effect for each in found.rounds] == ["readout-lag"]
