"""Physics of each term compared with analytic results, and checks of the term files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from scanner import devices
from scanner.active_terms import ActiveTerm, stated_terms
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.integrator.abi import LANES, Nominal
from scanner.integrator.elementary import cosine_of_half_turns, negative_exponential
from scanner.integrator.trajectories import CapacitanceTerm, TorqueTerm, TrajectorySpec, integrate, integrate_batch
from scanner.stages import Capacitance, Drive, Mechanics, Position
from scanner.terms import STAGES, NaturalScales, apply_lowpass, catalogue, load_terms, shift_samples
from tests.support.user_term import USER_TERM

F0 = 600.0
W = 2 * np.pi * F0
LINEAR = Axis(
    Mechanics(1e-12, 1e-12 * W / 1e5, 1e-12 * W**2), drive=Drive("linear", 1e-9), readout=Position(10.0, 1e-3), name="x"
)
STEP = 1 / (F0 * 100)


def free_motion(axis: Axis, effect: str, values: tuple[float, ...], amplitude: float, turns: int = 40) -> np.ndarray:
    inputs = DriveInput(np.zeros((100 * turns, 3)), STEP)
    return simulate_axis(axis, [ActiveTerm(catalogue()[effect], values)], inputs, (amplitude, 0.0)).angle


def frequency(angle: np.ndarray) -> float:
    """Frequency from the first to the last upward zero crossing."""
    up = np.flatnonzero((angle[:-1] < 0) & (angle[1:] >= 0))
    times = up - angle[up] / (angle[up + 1] - angle[up])
    return (up.size - 1) / ((times[-1] - times[0]) * STEP)


def decay(angle: np.ndarray) -> np.ndarray:
    """Peak of every cycle, by the parabola through three samples."""
    i = np.flatnonzero((angle[1:-1] > angle[:-2]) & (angle[1:-1] >= angle[2:])) + 1
    a, b, c = angle[i - 1], angle[i], angle[i + 1]
    return b - (a - c) ** 2 / (8 * (a - 2 * b + c))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_cubic_stiffness_shifts_the_frequency_by_three_eighths(sign: float) -> None:
    amplitude, ratio = 0.1, 0.02 * sign
    angle = free_motion(LINEAR, "cubic-stiffness", (ratio * LINEAR.mechanics.k / amplitude**2,), amplitude)
    assert frequency(angle) / F0 - 1 == pytest.approx(3 / 8 * ratio, rel=0.02)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_mode_at_half_the_frequency_limits_the_amplitude_to_its_threshold(sign: float) -> None:
    """The mode grows if g A exceeds 2/Q2 (Nayfeh and Mook 5.3), and then absorbs the excess power of the drive."""
    k, quality, threshold = LINEAR.mechanics.k, 100.0, 0.1
    axis = replace(LINEAR, mechanics=Mechanics(1e-12, 1e-12 * W / quality, k))
    values = sign * 2.0 / (40.0 * threshold), 0.5 * F0, 40.0, 2e-3 * threshold**0.5
    time = STEP * (np.arange(100 * 800)[:, None] + [0.0, 0.5, 1.0])
    for driven, held in ((0.08, 0.08), (0.2, threshold)):
        inputs = DriveInput(driven * k / quality / 1e-9 * np.cos(W * time), STEP)
        angle = simulate_axis(
            axis, [ActiveTerm(catalogue()["mode-coupling"], values)], inputs, (0.0, driven * W)
        ).angle[-1000:]
        assert np.ptp(angle) / 2 == pytest.approx(held, rel=0.02)
        # what it takes at the swing's frequency it takes of the mean as well: q² has both in equal parts
        assert angle.mean() == pytest.approx(sign * (held - driven) / quality, abs=2e-5)


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("second-mode", (0.05, 700.0, 1e9)),
        ("overtone-coupling", (2.0, 1200.0, 1e9)),
        ("mode-coupling", (0.6, 300.0, 1e9, 0.02)),
        ("mode-coupling", (-0.6, 300.0, 1e9, 0.02)),
    ],
)
def test_forces_of_a_mode_derive_from_one_energy(effect: str, values: tuple[float, ...]) -> None:
    """Derivatives of one energy: the mirror's force by q equals the mode's by θ, up to the inertia of the mode."""
    law, nominal = catalogue()[effect].torque, Nominal(1e-12, 1e-12, 1e-12 * W**2, 0.0, 1.0, 0.0, 0.0)
    assert law is not None

    def forces(theta: float, q: float) -> np.ndarray:
        torque, _, pushed = law(0.0, theta, 0.0, 0.0, 0.0, q, 0.0, np.array(values), nominal)
        return np.array([torque, pushed])

    ratios, h = [], 1e-6
    for theta, q in np.random.default_rng(1).uniform(-0.2, 0.2, (20, 2)):
        by_theta = (forces(theta + h, q) - forces(theta - h, q))[1]
        by_mode = (forces(theta, q + h) - forces(theta, q - h))[0]
        ratios.append(by_mode / by_theta)
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-4)
    assert ratios[0] > 0.0


def test_quintic_stiffness_shifts_the_frequency_by_five_sixteenths() -> None:
    angle = free_motion(LINEAR, "quintic-stiffness", (0.02 * LINEAR.mechanics.k / 0.1**4,), 0.1)
    assert frequency(angle) / F0 - 1 == pytest.approx(5 / 16 * 0.02, rel=0.03)


def test_quadratic_stiffness_moves_the_mean_and_lowers_the_frequency() -> None:
    angle = free_motion(LINEAR, "quadratic-stiffness", (0.05 * LINEAR.mechanics.k / 0.1,), 0.1)
    assert angle[: 100 * 39].mean() == pytest.approx(-0.05 * 0.1 / 2, rel=0.1)
    assert frequency(angle - angle.mean()) / F0 - 1 == pytest.approx(-5 / 12 * 0.05**2, rel=0.2)


def test_quadratic_drag_decays_hyperbolically() -> None:
    b2 = 1e-14
    peaks = decay(free_motion(LINEAR, "quadratic-drag", (b2,), 0.1))
    rate = 8 * b2 * W / (3 * np.pi * 2 * LINEAR.mechanics.J) / F0  # of 1/A, a turn
    np.testing.assert_allclose(np.diff(1 / peaks), rate, rtol=0.05)


def test_cubic_damping_increases_the_inverse_squared_amplitude_linearly() -> None:
    b3 = 1e-9
    peaks = decay(free_motion(LINEAR, "cubic-damping", (b3,), 0.1))
    rate = 2 * b3 / (8 * LINEAR.mechanics.J) / F0
    np.testing.assert_allclose(np.diff(1 / peaks**2), rate, rtol=0.05)


def test_coulomb_friction_decays_linearly_and_stops() -> None:
    tau = 0.002 * LINEAR.mechanics.k * 0.1
    peaks = decay(free_motion(LINEAR, "coulomb-friction", (tau, 1e-3), 0.1))
    np.testing.assert_allclose(np.diff(peaks[:25]), -4 * 0.002 * 0.1, rtol=0.05)
    assert peaks[0] > 0.08 > 50 * np.abs(free_motion(LINEAR, "coulomb-friction", (10 * tau, 1e-3), 0.1)[-100:]).max()


def test_drifts_approach_their_final_value() -> None:
    angle = free_motion(LINEAR, "resonance-drift", (0.02, 1e-4), 0.1)
    assert frequency(angle[1000:]) / F0 - 1 == pytest.approx(0.01, rel=0.02)
    lossy = replace(LINEAR, mechanics=replace(LINEAR.mechanics, b=1e-12 * W / 100))
    plain, drifted = (
        decay(free_motion(lossy, "damping-drift", (0.0, 1e-4), 0.1)),
        decay(free_motion(lossy, "damping-drift", (0.5, 1e-4), 0.1)),
    )
    assert np.log(drifted[-1] / drifted[5]) / np.log(plain[-1] / plain[5]) == pytest.approx(1.5, rel=0.01)


def test_inertia_scale_divides_the_torque_and_not_the_ringdown() -> None:
    inertia = catalogue()["inertia-scale"]
    scaled = inertia.constants(LINEAR, (2.0,))  # type: ignore[misc]
    assert (scaled.resonance, scaled.quality) == pytest.approx((LINEAR.resonance, LINEAR.quality))
    push = np.full((100, 3), 1.0)
    once = integrate(LINEAR, (0.0, 0.0), push, STEP)[0]
    np.testing.assert_allclose(integrate(scaled, (0.0, 0.0), push, STEP)[0], once / 2, rtol=1e-9, atol=1e-18)


def test_slope_of_a_profile_shape_is_the_derivative_of_its_capacitance() -> None:
    from scanner.integrator.trajectories import CapacitanceTerm

    axis = replace(LINEAR, capacitance=Capacitance(5e-12, 1e-11, 0.2, 0.01))
    angle = np.linspace(-0.4, 0.4, 4001)
    value, slope = CapacitanceTerm(catalogue()["profile-shape"].capacitance, (0.3,)).evaluate(angle, axis)
    np.testing.assert_allclose(np.gradient(value, angle)[1:-1], slope[1:-1], atol=2e-4 * np.abs(slope).max())


def test_second_mode_splits_a_resonance_by_its_coupling() -> None:
    c = 0.01
    angle = free_motion(LINEAR, "second-mode", (c, F0, 1e5), 0.1, turns=200)
    envelope = np.abs(decay(angle))
    # equal modes exchange everything at a beat of f0 sqrt(c)
    assert envelope.min() < 0.2 * envelope.max()
    spectrum = np.abs(np.fft.rfft(angle[:20000] * np.hanning(20000)))
    half = np.fft.rfftfreq(20000, STEP)
    low, high = half[np.argmax(spectrum * (half < F0))], half[np.argmax(spectrum * (half > F0))]
    assert high - low == pytest.approx(F0 * np.sqrt(c), rel=0.1)


def test_viscoelastic_stiffness_depends_on_frequency() -> None:
    stiff = frequency(free_motion(LINEAR, "viscoelastic", (0.05 * LINEAR.mechanics.k, 1.0), 0.1))
    assert stiff / F0 - 1 == pytest.approx(0.025, rel=0.03)
    soft = free_motion(LINEAR, "viscoelastic", (0.05 * LINEAR.mechanics.k, 2e-5), 0.1)
    assert frequency(soft) / F0 - 1 == pytest.approx(0.0, abs=3e-4)


def test_array_laws_agree_with_their_equations() -> None:
    time = np.arange(2000) * 1e-5
    tone = np.sin(2 * np.pi * 500 * time)
    np.testing.assert_allclose(
        shift_samples(tone, -3.5)[10:-10], np.sin(2 * np.pi * 500 * (time - 3.5e-5))[10:-10], atol=1e-6
    )
    slow = apply_lowpass(tone, 500.0, 1e-5)[1000:]
    assert slow.std() / tone[1000:].std() == pytest.approx(1 / np.sqrt(2), rel=0.01)
    assert apply_lowpass(tone, np.inf, 1e-5) is tone
    np.testing.assert_allclose(apply_lowpass(tone, -500.0, 1e-5) - tone, tone - apply_lowpass(tone, 500.0, 1e-5))


def test_readout_gain_drifts_from_the_start_of_the_recording() -> None:
    inputs = DriveInput(np.zeros((1000, 3)), STEP, t0=0.5)
    path = simulate_axis(LINEAR, [], inputs, (0.1, 0.0))
    plain = sense_signal(LINEAR.readout, [path])
    for duration, gain in ((1.0, 1 + 0.1 * inputs.time), (0.25, 1.1)):
        drifting = ActiveTerm(catalogue()["gain-drift"], (0.1, duration))
        drifted = sense_signal(LINEAR.readout, [replace(path, active_terms=(drifting,))])
        np.testing.assert_allclose(drifted, plain * gain)


def test_every_term_has_no_effect_at_zero_and_a_description() -> None:
    scales = NaturalScales(0.1, W, 1e-12, 1e-14, 1e-5, 0.1, 10.0, 5.0, W, 1.0, 1.0, LINEAR.readout, 100.0)
    for effect, term in catalogue().items():
        assert term.stage in STAGES
        assert all((term.equation, term.source, term.parameters)), effect
        if term.effect != "filter-lag":
            assert all(np.isfinite(p.value(1.0, scales)) and p.value(1.0, scales) != 0.0 for p in term.parameters), (
                effect
            )
        assert set(term.confounders) <= set(catalogue()), effect


def test_law_may_count_its_parameters_and_index_them_from_the_end(tmp_path: Path) -> None:
    path, made = tmp_path / "mine.py", []
    for law in ("-p[0] * theta**7", "-p[-1] * len(p) * theta**7"):
        path.write_text(USER_TERM.replace("-p[0] * theta**7", law))
        torque = TorqueTerm(load_terms(path)["septic-stiffness"].torque, (1e-6,))
        made.append(integrate(LINEAR, (0.1, 0.0), np.zeros((500, 3)), STEP, torques=[torque])[0])
    assert USER_TERM.count("-p[0] * theta**7") == 1
    np.testing.assert_array_equal(*made)


def test_changed_law_is_compiled_again(tmp_path: Path) -> None:
    """numba stores compiled laws on disk by their name. The change may be in a constant or function of the file."""
    helper = "POWER = 7\n\n@njit\ndef raised(x):\n    return x**POWER\n\n@njit(TORQUE_LAW)"
    text = USER_TERM.replace("@njit(TORQUE_LAW)", helper).replace("theta**7", "raised(theta)")
    for changed, replaced in ((USER_TERM, "theta**{}"), (text, "POWER = {}"), (text, "x**{}")):
        for power, effect in ((3, "cubic-stiffness"), (5, "quintic-stiffness"), (3, "cubic-stiffness")):
            path = tmp_path / "mine.py"
            path.write_text(
                changed.replace(replaced.format("POWER" if replaced[0] == "x" else 7), replaced.format(power))
            )
            (mine,) = (term for name, term in load_terms(path).items() if name == "septic-stiffness")
            made = [
                integrate(LINEAR, (0.1, 0.0), np.zeros((500, 3)), STEP, torques=[TorqueTerm(term.torque, (1e-6,))])[0]
                for term in (mine, catalogue()[effect])
            ]
            np.testing.assert_allclose(*made, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("same_drive", [True, False])
def test_batch_of_motions_equals_the_single_motions(same_drive: bool) -> None:
    known = catalogue()
    comb = Capacitance(C0=5e-12, Cb=1e-11, theta0=0.2, theta_th=0.01)
    voltage = 20.0 + 10.0 * np.sin(2 * W * STEP * (np.arange(4000)[:, None] + [0.0, 0.5, 1.0]))
    motions = []
    for i in range(LANES - 1):
        axis = replace(LINEAR, mechanics=Mechanics(1e-12, 1e-10, (1.0 + 1e-3 * i) * 1e-12 * W**2), capacitance=comb)
        mode = TorqueTerm(known["second-mode"].torque, (0.01 * i, 1.3 * F0, 50.0), (0.01, 0.2))
        cubic = TorqueTerm(known["cubic-stiffness"].torque, (1e-6 * i,))
        bell = CapacitanceTerm(known["profile-shape"].capacitance, (0.1 * i,))
        motions.append(TrajectorySpec(replace(axis, drive=None), (0.1, 1.0 + i), [mode, cubic], [bell]))
    voltages = [voltage if same_drive else (1.0 + 0.01 * i) * voltage for i in range(len(motions))]
    together = integrate_batch(motions, voltages, STEP, 0.1)
    for (axis, start, torques, bells), voltage, (angle, rate) in zip(motions, voltages, together, strict=True):
        alone = integrate(axis, start, voltage, STEP, 0.1, torques, bells)
        np.testing.assert_array_equal(angle, alone[0])
        np.testing.assert_array_equal(rate, alone[1])
    assert np.ptp([angle[-1] for angle, _ in together]) > 1e-3


def test_exponential_of_the_kernel_agrees_with_numpy() -> None:
    x, compiled = -np.geomspace(1e-12, 690.0, 3000), njit(lambda value: negative_exponential(value))
    np.testing.assert_allclose([compiled(value) for value in (*x, 0.0)], np.exp([*x, 0.0]), rtol=4e-16)
    assert compiled(-1e9) < 1e-300
    assert compiled(-np.inf) < 1e-300


def test_cosine_of_half_turns() -> None:
    x, compiled = np.linspace(-2.0, 7.0, 901), njit(lambda value: cosine_of_half_turns(value))
    np.testing.assert_allclose([compiled(value) for value in x], np.cos(np.pi * x), atol=1e-11)


def test_user_term_changes_the_motion(tmp_path) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "mine.py"
    file.write_text(USER_TERM)
    term = load_terms(file)["septic-stiffness"]
    inputs = DriveInput(np.zeros((4000, 3)), STEP)
    angle = simulate_axis(LINEAR, [ActiveTerm(term, (0.02 * LINEAR.mechanics.k / 0.1**6,))], inputs, (0.1, 0.0)).angle
    assert frequency(angle) / F0 - 1 == pytest.approx(35 / 128 * 0.02, rel=0.03)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("x = 1", "holds no term"),
        ("1 / 0", "ZeroDivisionError"),
        ("import nothing_of_this_name", "ModuleNotFoundError"),
    ],
)
def test_bad_term_file_is_refused_in_one_line(tmp_path, text: str, complaint: str) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "bad.py"
    file.write_text(text)
    with pytest.raises(BadInput, match=complaint) as caught:
        load_terms(file)
    assert "\n" not in str(caught.value)
    with pytest.raises(BadInput, match="no such file"):
        load_terms(tmp_path / "none.py")


def test_terms_of_a_device_are_checked() -> None:
    assert stated_terms(replace(LINEAR, terms={"cubic-stiffness": {"k3": 2.0}}))[0].values == (2.0,)
    with pytest.raises(BadInput, match=r"not an effect of the catalogue; known effects: cubic-stiffness, .*--terms"):
        stated_terms(replace(LINEAR, terms={"cubic-stifness": {"k3": 2.0}}))
    with pytest.raises(BadInput, match="not an effect of the catalogue"):
        stated_terms(replace(LINEAR, terms={"no-such-effect": {}}))
    with pytest.raises(BadInput, match="lacks k3"):
        stated_terms(replace(LINEAR, terms={"cubic-stiffness": {}}))
    with pytest.raises(BadInput, match="variant"):
        stated_terms(replace(LINEAR, terms={"channel-delay": {"delay": 1e-6, "variant": 7.0}}))


def test_clipping_applies_to_the_input_of_the_converter() -> None:
    """Clipping is applied after every delay, whatever their order: a clipped corner must not be interpolated."""
    inputs = DriveInput(np.zeros((1000, 3)), STEP)
    delay, limit = (
        ActiveTerm(catalogue()["channel-delay"], (0.37 * STEP,)),
        ActiveTerm(catalogue()["saturation"], (0.6,)),
    )
    path = simulate_axis(LINEAR, [], inputs, (0.1, 0.0))
    late = sense_signal(LINEAR.readout, [replace(path, active_terms=(delay,))])
    both = [
        sense_signal(LINEAR.readout, [replace(path, active_terms=order)]) for order in ((delay, limit), (limit, delay))
    ]
    assert np.array_equal(*both)
    assert both[0].max() <= 0.6 < 0.9 < late.max()
    assert np.allclose(both[0], np.clip(late, -0.6, 0.6), atol=2e-3)


@pytest.mark.parametrize("effect", ["second-mode", "overtone-coupling", "mode-coupling"])
def test_a_further_mode_is_an_oscillation_whatever_a_fit_tries(effect: str) -> None:
    scales = NaturalScales(amplitude=0.1, rate=1e3, J=1e-6, b=1e-5, k=1.0, duration=1.0)
    (quality,) = (parameter for parameter in catalogue()[effect].parameters if parameter.name == "Q2")
    assert all(quality.value(x, scales) >= 0.5 for x in np.linspace(-30.0, 5.0, 36))
    assert quality.value(0.0, scales) > 20.0


@pytest.mark.parametrize("effect", ["carrier-torque", "charging"])
def test_a_comb_that_only_senses_has_no_part_in_a_linear_drive(effect: str) -> None:
    """A carrier under a root would rectify the voltage of a coil."""
    scales = NaturalScales(0.1, W, 1e-12, 1e-14, 1e-5, 0.1, 10.0, 5.0)
    comb = devices.find("imaging").axis("x")
    assert catalogue()[effect].applies(comb, scales)
    assert not catalogue()[effect].applies(replace(comb, drive=Drive("linear", 1e-7)), scales)
