"""Every term of the catalogue changes the channels of its stage in a simulated recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from phantoms.forward import InitialState, Plan, Scene, simulate
from phantoms.optics import Detector
from phantoms.waveforms import Sine
from scanner import devices
from scanner.active_terms import stated_terms
from scanner.arrays import Array
from scanner.coupled_motion import simulate_coupled
from scanner.device import Axis, Device
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.integrator.nodes import to_nodes
from scanner.stages import Mechanics
from scanner.terms import NaturalScales, Term, catalogue

DURATION, RATE = 1e-3, 5e6
DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}
START = {"x": InitialState(0.18, 0.0), "y": InitialState(0.16, 0.0)}
SCENE = Scene(np.tile(np.linspace(0.0, 1.0, 64), (64, 1)), Detector(photons_per_sample=1e12, bits=None))


def quiet() -> Device:
    """The imaging device, both axes on one electrode, without noise."""
    device = devices.load("imaging")
    return replace(device, readout=replace(device.readout, noise_var=0.0, bits=None))


def stated(device: Device, term: Term, axis: str = "x") -> Device:
    """The device with a term of its natural size on one axis."""
    m = device.axis(axis).require_mechanics()
    rate = 2 * np.pi * m.resonance
    scales = NaturalScales(
        0.18, rate, m.J, m.b, m.k, DURATION, 30.0, 21.0, 2 * rate, 1.0, 2.0, device.readout, 2.5e4, True
    )
    values = term.values([2.0 * (p.sign or 1) for p in term.free_parameters], scales)
    if term.effect == "saturation":
        values = (0.5,)
    if term.effect == "mode-coupling":  # of its natural size it takes longer to grow
        values = (5.0, rate / (4 * np.pi), *values[2:])
    terms = {term.effect: dict(zip((p.name for p in term.parameters), values, strict=True))}
    return replace(device, axes=dict(device.axes) | {axis: replace(device.axis(axis), terms=terms)})


def recorded(device: Device) -> dict[str, np.ndarray]:
    plan = Plan(DRIVES, DURATION, RATE, references=("angle",))
    recording, truth = simulate(device, plan, SCENE, start=START)
    channels = {name: channel.read() for name, channel in recording.channels.items() if "drive" not in name}
    return channels | {f"truth_{axis}": truth[f"angle_{axis}"][0] for axis in "xy"}


@pytest.fixture(scope="module")
def plain() -> dict[str, np.ndarray]:
    return recorded(quiet())


MOVING = {"truth_x", "angle_x", "sense", "intensity"}
CHANGED = {"drive": MOVING, "mechanics": MOVING, "capacitance": MOVING, "readout": {"sense"}, "timing": {"sense"}}
OPTICS = {"angle": {"angle_x"}, "place": {"intensity"}, "intensity": {"intensity"}}


@pytest.mark.parametrize("effect", catalogue())
def test_term_changes_the_channels_of_its_stage(effect: str, plain: dict[str, np.ndarray]) -> None:
    term = catalogue()[effect]
    shown = recorded(stated(quiet(), term))
    changed = {
        name for name, values in shown.items() if np.abs(values - plain[name]).max() > 1e-5 * np.ptp(plain[name])
    }
    assert changed == (OPTICS[term.channels[0]] if term.stage == "optics" else CHANGED[term.stage])


def test_noise_is_clipped_with_the_signal() -> None:
    noisy = replace(quiet(), readout=replace(quiet().readout, noise_var=1e-4))
    sense = recorded(stated(noisy, catalogue()["saturation"]))["sense"]
    assert np.ptp(sense) == 1.0
    assert np.mean(np.abs(sense) == 0.5) > 0.05


COMPARED = (
    *("cubic-stiffness", "viscoelastic", "cross-axis-coupling", "drive-lag", "profile-shape"),
    *("square-law", "filter-lag", "readout-lag", "feedthrough", "channel-delay"),
)


@pytest.mark.parametrize("effect", COMPARED)
def test_simulation_agrees_with_the_forward_model(effect: str) -> None:
    device = stated(quiet(), catalogue()[effect], "y")
    step = 1 / (4 * RATE)  # finer than the simulation's own
    time = 0.5 * step * np.arange(2 * round(DURATION / step) + 1)
    inputs = {name: DriveInput(to_nodes(drive(time)), step) for name, drive in DRIVES.items()}
    axes = {name: device.sensed_axis(name) for name in device.axes}
    paths = simulate_coupled(
        inputs,
        {name: (start.angle, start.rate) for name, start in START.items()},
        effect == "cross-axis-coupling",
        lambda name, inputs, start, other: simulate_axis(axes[name], stated_terms(axes[name]), inputs, start, other),
    )
    direct, shown = sense_signal(device.readout, list(paths.values()))[:-1:4], recorded(device)["sense"]
    assert np.abs(direct - shown)[50:].max() < 2e-4 * np.ptp(shown)


@pytest.mark.parametrize("coupling", [0.001, 0.01, 0.1])
def test_coupled_axes_of_one_resonance_exchange_their_energy(coupling: float) -> None:
    """Two equal axes of 1 kHz, of which one starts: the sum and the difference of their angles decay freely."""
    inertia, rate, quality, step, periods = 1e-10, 2 * np.pi * 1e3, 100.0, 5e-6, 60
    stiffness = inertia * rate**2
    axis = Axis(Mechanics(inertia, inertia * rate / quality, stiffness), name="x")
    terms = stated_terms(replace(axis, terms={"cross-axis-coupling": {"kappa": coupling * stiffness}}))
    inputs = DriveInput(np.zeros((round(periods * 1e-3 / step), 3)), step)
    paths = simulate_coupled(
        {"x": inputs, "y": inputs},
        {"x": (0.05, 0.0), "y": (0.0, 0.0)},
        True,
        lambda name, inputs, start, other: simulate_axis(axis, terms, inputs, start, other),
    )
    time, decay = np.arange(len(inputs.voltage) + 1) * step, 0.5 * rate / quality

    def free(sign: float) -> Array:
        frequency = np.sqrt((1.0 + sign * coupling) * rate**2 - decay**2)
        return 0.05 * np.exp(-decay * time) * (np.cos(frequency * time) + decay / frequency * np.sin(frequency * time))

    for name, exact in (("x", 0.5 * (free(1.0) + free(-1.0))), ("y", 0.5 * (free(1.0) - free(-1.0)))):
        assert np.abs(paths[name].angle - exact).max() < 1e-5 * np.abs(exact).max()


def test_term_of_one_axis_does_not_change_the_comb_of_the_other() -> None:
    """Both combs are on one electrode; only one has the term."""
    term = catalogue()["profile-shape"]
    device = quiet()
    x, y = (recorded(stated(device, term, axis))["sense"] for axis in "xy")
    assert np.abs(x - y).max() > 1e-2 * np.ptp(x)


def test_steady_motion_includes_the_terms() -> None:
    """A recording starts in the steady motion under the terms, not in that of the nominal device."""
    device = stated(quiet(), catalogue()["cubic-stiffness"])
    k3 = device.axis("x").terms["cubic-stiffness"]["k3"]
    small = replace(device.axis("x"), terms={"cubic-stiffness": {"k3": 0.02 * k3}})
    plan = Plan(DRIVES, DURATION, RATE, settle=0.04)
    swings = []
    for axes in (dict(quiet().axes), dict(quiet().axes) | {"x": small}):
        _, truth = simulate(replace(quiet(), axes=axes), plan)
        swings.append(np.abs(truth["angle_x"][0]).max())
    assert 1e-3 < abs(swings[1] / swings[0] - 1) < 0.2
