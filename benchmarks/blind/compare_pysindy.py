"""PySINDy (ensemble, weak form) on blind recordings, for comparison with the diagnosis: names and false alarms.

    python -m venv sindy && sindy/bin/pip install pysindy==2.1.0 h5py
    sindy/bin/python benchmarks/blind/compare_pysindy.py RECORDINGS KEYS.json [OUT.json]

PySINDy needs the state, so only recordings with a position sensor (``tf``, ``pendulum``, ``sharp-resonance``) or a
reference angle (part of ``ring``) are used, and only effects of the mechanics have a candidate term. Its input is the
angle and its derivative by a Savitzky-Golay filter, in units of the swing and of the resonance. It is fitted at several
thresholds, of which the one with the least Bayes information criterion of the weak residual counts. A term is reported
when at least 90 % of the ensemble's models contain it, strongest first.

This file imports nothing of the project, so that PySINDy needs no place in the project's environment.
"""

from __future__ import annotations

import json
import sys
import time
import tomllib
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.signal import decimate, savgol_filter

Array = NDArray[np.float64]

NAMED_TERMS = {
    "theta^2": "quadratic-stiffness",
    "theta^3": "cubic-stiffness",
    "theta^5": "quintic-stiffness",
    "|omega| omega": "quadratic-drag",
    "theta^2 omega": "cubic-damping",
    "sign omega": "coulomb-friction",
    "t theta": "resonance-drift",
    "t omega": "damping-drift",
}
"""Candidate terms of the library and the catalogue's name of each."""
ALSO_RIGHT = {"sine-stiffness": {"cubic-stiffness", "quintic-stiffness", "gravity-stiffness"}}
THRESHOLDS = (5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2)
"""Smallest coefficients that STLSQ retains, in units of the linear spring's. Effects of the benchmark start at 3e-3."""
MIN_INCLUSION = 0.9
"""Fraction of the ensemble's models that must contain a reported term."""
MODELS = 20
TEST_FUNCTIONS = 400
HALF_WIDTH = np.pi
"""Of a test function, in radians of the resonance. Wider ones average the oscillation away, and the fit fails."""
SAMPLES_PER_CYCLE = 250
"""To which a recording is decimated; a faster one only costs time."""
FILTER_SAMPLES = 41
"""Window of the Savitzky-Golay filter: a sixth of a cycle, over which a quartic follows a sine to 1e-4."""


def load(path: Path) -> tuple[Array, Array, float, Array | None] | None:
    """Angle and drive over their maxima, samples a radian of the resonance, and the shape of the comb's torque.

    None for a recording without a measured angle.
    """
    with h5py.File(path) as file:
        device = tomllib.loads(file["device"].attrs["toml"])
        channels = {name: data[:].astype(float) for name, data in file["channels"].items()}
        rate = float(next(iter(file["channels"].values())).attrs["sample_rate"])
    axis = device["x"]
    if "angle_x" in channels:
        theta = channels["angle_x"]
    elif axis.get("readout", {}).get("kind") == "position":
        theta = channels["sense_x"] / axis["readout"]["gain"]
    else:
        return None
    omega = np.sqrt(axis["mechanics"]["k"] / axis["mechanics"]["J"])
    step = max(1, round(2 * np.pi * rate / omega / SAMPLES_PER_CYCLE))
    if step > 1:
        theta = decimate(theta, step, ftype="fir", zero_phase=True)
    volt = channels.get("drive_x", np.zeros(theta.size * step))[::step][: theta.size]
    theta = theta[: volt.size]
    if np.ptp(volt) == 0:
        volt = np.zeros(theta.size)
    comb = None
    if "capacitance" in axis:  # the nominal device's torque under a constant bias, which is no missing physics
        comb = theta * np.exp(-((theta / axis["capacitance"]["theta0"]) ** 2)) / np.abs(theta).max()
    return theta / np.abs(theta).max(), volt / max(np.abs(volt).max(), 1e-300), rate / step / omega, comb


def candidate_terms(theta: Array, omega: Array, volt: Array, t: Array) -> dict[str, Array]:
    """Candidate terms of the acceleration beside omega, which is the state, by name, each (n,)."""
    span = t / t[-1]
    terms = {
        "theta": theta, "theta^2": theta**2, "theta^3": theta**3, "theta^5": theta**5,
        "|omega| omega": np.abs(omega) * omega, "theta^2 omega": theta**2 * omega, "sign omega": np.sign(omega),
        "t theta": span * theta, "t omega": span * omega,
    }  # fmt: skip
    return terms | ({"volt": volt} if volt.any() else {})


def weak_residual(omega: Array, terms: Array, coefficients: Array, dt: float) -> Array:
    """Residual of omega' = terms @ coefficients against test functions (1 - u^2)^4 side by side, (windows,)."""
    half = round(HALF_WIDTH / dt)
    u = np.linspace(-1, 1, 2 * half + 1)
    test = (1 - u**2) ** 4
    slope = -8 * u * (1 - u**2) ** 3 / (half * dt)
    error = terms @ coefficients
    starts = np.arange(0, omega.size - test.size, half)
    return np.array([-(omega[i : i + test.size] @ slope + error[i : i + test.size] @ test) * dt for i in starts])


def reported_names(path: Path) -> list[str] | None:
    """The catalogue's names of the terms that PySINDy reports, strongest first; None without a measured angle."""
    import pysindy as ps

    loaded = load(path)
    if loaded is None:
        return None
    theta, volt, samples_per_radian, comb = loaded
    dt = 1 / samples_per_radian
    omega = savgol_filter(theta, FILTER_SAMPLES, 4, deriv=1, delta=dt)
    theta = savgol_filter(theta, FILTER_SAMPLES, 4)
    t = dt * np.arange(theta.size)
    terms = candidate_terms(theta, omega, volt, t) | ({} if comb is None else {"comb": comb})
    # Every candidate is a control input of a linear library, so that terms in |omega| and time need no special library.
    inputs = np.column_stack(list(terms.values()))
    matrix = np.column_stack([omega, inputs])
    best: tuple[float, list[str]] | None = None
    for threshold in THRESHOLDS:
        np.random.seed(1)  # noqa: NPY002 (PySINDy draws from numpy's global state)
        library = ps.WeakPDELibrary(
            function_library=ps.PolynomialLibrary(degree=1, include_bias=False),
            spatiotemporal_grid=t, K=TEST_FUNCTIONS, H_xt=[HALF_WIDTH],
        )  # fmt: skip
        stlsq = ps.STLSQ(threshold=threshold, alpha=1e-10)
        optimizer = ps.EnsembleOptimizer(stlsq, bagging=True, n_models=MODELS)
        ps.SINDy(feature_library=library, optimizer=optimizer).fit(omega[:, None], t=t, u=inputs)
        models = np.array(optimizer.coef_list)[:, 0, :]
        included = np.mean(models != 0, axis=0) >= MIN_INCLUSION
        coefficients = np.where(included, np.median(models, axis=0), 0.0)
        residual = weak_residual(omega, matrix, coefficients, dt)
        bic = residual.size * np.log(np.mean(residual**2)) + np.count_nonzero(included) * np.log(residual.size)
        if best is None or bic < best[0]:
            strength = np.abs(coefficients[1:]) * inputs.std(axis=0)
            order = [list(terms)[i] for i in np.argsort(-strength) if strength[i] > 0]
            best = (float(bic), [NAMED_TERMS[name] for name in order if name in NAMED_TERMS])
    assert best is not None
    return best[1]


def main(arguments: list[str]) -> int:
    recordings, keys = Path(arguments[0]), json.loads(Path(arguments[1]).read_text())
    rows: list[dict[str, Any]] = []
    for name, key in keys.items():
        if not (recordings / f"{name}.h5").exists():
            continue
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                names = reported_names(recordings / f"{name}.h5")
            except (ValueError, np.linalg.LinAlgError) as error:
                print(f"{name}: {error}", file=sys.stderr)
                names = []
        if names is None:
            continue
        effects = [effect["effect"] for effect in key.get("effects", [])]
        rows.append({"name": name, "family": key["family"], "kind": key["kind"], "concealed": effects,
                     "imperfect": bool(key.get("imperfection")), "reported": names,
                     "seconds": time.perf_counter() - start})  # fmt: skip
        print(f"{name} {key['family']}: concealed {effects}, reported {names}", flush=True)
    if len(arguments) > 2:
        Path(arguments[2]).write_text(json.dumps(rows, indent=1))
    print(table(rows))
    return 0


def table(rows: list[dict[str, Any]]) -> str:
    """Names and false alarms in Markdown."""
    expressible = [row for row in rows if row["concealed"] and _right(row["concealed"][0]) & set(NAMED_TERMS.values())]
    first = sum(bool(row["reported"]) and row["reported"][0] in _right(row["concealed"][0]) for row in expressible)
    among = sum(bool(_right(row["concealed"][0]) & set(row["reported"])) for row in expressible)
    alone = sum(bool(row["reported"]) and set(row["reported"]) <= _right(row["concealed"][0]) for row in expressible)
    none = [row for row in rows if not row["concealed"]]
    others = [row for row in rows if row["concealed"] and row not in expressible]
    alarms, inventions = (sum(bool(row["reported"]) for row in group) for group in (none, others))
    lines = [
        "| PySINDy, ensemble, weak form | count | of |", "|---|---|---|",
        f"| right name first, effects with a candidate term | {first} | {len(expressible)} |",
        f"| right name among the reported | {among} | {len(expressible)} |",
        f"| right name and no other | {alone} | {len(expressible)} |",
        f"| nothing concealed, something reported (false alarm) | {alarms} | {len(none)} |",
        f"| effect without a candidate term, something reported | {inventions} | {len(others)} |",
    ]  # fmt: skip
    if rows:
        lines.append(f"| seconds, median | {float(np.median([row['seconds'] for row in rows])):.2g} | {len(rows)} |")
    return "\n".join(lines)


def _right(effect: str) -> set[str]:
    return {effect} | ALSO_RIGHT.get(effect, set())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
