"""Optics parameters of a scan fitted to its intensity samples, with the scene unknown and eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.least_squares import fit_levenberg_marquardt
from estimation.optics.samples import OpticsParameters, ScanSamples, measure_cell_variances, project_samples
from estimation.optics.scene import CellVariances, SamplingGeometry, SceneFit, SceneSolver, render_intensity
from estimation.parallel import map_parallel
from scanner.arrays import Array
from scanner.device import AXES

PATCH_CELLS = 4
"""Side of the patches whose samples count as correlated [cells]: what the grid does not resolve is common to samples
within a few cells."""

UNRESOLVED_SD_CELLS = 0.1
"""Assumed standard deviation of a position error caused by detail finer than a cell [cells]: such detail pulls samples
of different half-periods in different directions, so that only a tenth of a cell remains."""

MIN_MISFIT_DECREASE = 0.1
"""Fall in misfit below which the fit has converged: a third of a standard deviation."""

COMPARISON_ROUNDS = 3
"""Rounds in which scene and variances are estimated in turn; the second already starts from a fitted scene."""


@dataclass(frozen=True)
class OpticsFit:
    """Fitted optics.

    Attributes:
        names: of the fitted parameters, p in number; prior_sd: standard deviations of their priors, shape (p,).
        parameters: all parameters, fitted and fixed.
        scene: scene and residual at the fit.
        information: Fisher information of the fitted parameters in their own units, without the priors and robust
            against detail that the grid does not resolve, shape (p, p).
        validation_chi2: reduced chi-square of the samples that were left out.
    """

    names: tuple[str, ...]
    prior_sd: Array
    parameters: OpticsParameters
    scene: SceneFit
    information: Array
    validation_chi2: float


class _Residuals:
    """Residuals of all samples over the scaled optics parameters, the scene being solved for at each evaluation.

    A last entry holds the root of the scene's penalty, so that the sum of squares is the misfit. ``x`` is in prior
    standard deviations. The last evaluation is kept for the Jacobian and as the start of the next scene.
    """

    def __init__(
        self,
        scan: ScanSamples,
        priors: OpticsParameters,
        parameters: OpticsParameters,
        variances: CellVariances,
        cells: int,
    ):
        self.scan, self.base, self.variances, self.cells = scan, parameters, variances, cells
        self.names, self.prior_sd = tuple(priors), np.array(list(priors.values()))
        steps = _half_cell_steps(scan, cells)
        self.steps = np.array([steps[name] for name in self.names]) / self.prior_sd
        self.x = np.full(self.prior_sd.size, np.nan)
        self.fit: SceneFit | None = None

    def parameters(self, x: Array) -> OpticsParameters:
        return {**self.base, **dict(zip(self.names, (x * self.prior_sd).tolist(), strict=True))}

    def geometry(self, x: Array) -> SamplingGeometry:
        return project_samples(self.scan, self.parameters(x), self.cells)

    def evaluate(self, x: Array) -> SceneFit:
        if self.fit is None or not np.array_equal(x, self.x):
            start = None if self.fit is None else self.fit.scene
            weight = self.scan.train_mask / self.variances.noise
            self.solver = SceneSolver(self.geometry(x), weight, self.variances.prior, self.cells, self.scan.run_bounds)
            self.fit, self.x = self.solver.fit(self.scan.intensity, start), x.copy()
        return self.fit

    def residual(self, x: Array) -> Array:
        fit = self.evaluate(x)
        return np.append(fit.residual / np.sqrt(self.variances.noise), np.sqrt(fit.penalty))

    def jacobian(self, x: Array, _residual: Array) -> Array:
        """Derivatives after projecting out every change that a different scene would also cause; 0 for the penalty.

        Source: Kaufman, "A variable projection method", BIT 15, 49 (1975).
        """
        scene = self.evaluate(x).scene
        columns, steps = np.zeros((self.scan.intensity.size + 1, x.size)), np.diag(self.steps)

        def fill(k: int) -> None:
            ahead, behind = (
                render_intensity(self.geometry(x + step), scene, self.scan.run_bounds) for step in (steps[k], -steps[k])
            )
            columns[:-1, k] = -self.solver.project_out_scene((ahead - behind) / (2 * self.steps[k]))

        map_parallel(fill, range(x.size))
        return columns / np.sqrt(self.variances.noise)


def fit_optics(
    scan: ScanSamples,
    priors: OpticsParameters,
    parameters: OpticsParameters,
    variances: CellVariances,
    cells: int,
    max_iterations: int = 6,
) -> OpticsFit:
    """Fit optics parameters to the intensity, with the scene eliminated at every step.

    Args:
        priors: standard deviation of each fitted parameter's prior, whose mean is 0, by name.
        parameters: start of all parameters.
        variances: noise of the samples and prior of the scene.
        cells: along each side of the grid.
        max_iterations: 0 evaluates the fit at ``parameters``.
    """
    residuals = _Residuals(scan, priors, parameters, variances, cells)
    sd = residuals.prior_sd
    start = np.array([parameters[name] for name in residuals.names]) / sd
    fit = fit_levenberg_marquardt(
        residuals.residual,
        residuals.jacobian,
        start,
        np.ones(sd.size),
        rows=np.append(scan.train_mask, True),
        max_step=2.0 * residuals.steps,  # one cell: the slope of the scene is not valid farther away
        max_iterations=max_iterations,
        tolerance=MIN_MISFIT_DECREASE,
    )
    scene = residuals.evaluate(fit.x)
    score = np.where(scan.train_mask, fit.residual[:-1], 0.0)[:, None] * fit.jacobian[:-1]
    patch_scores = _sum_over_patches(residuals.geometry(fit.x), score, cells)
    information = _cluster_robust_information(fit.information, patch_scores) / np.outer(sd, sd)
    validation = float(np.mean(scene.residual[scan.validation_mask] ** 2) / variances.noise)
    return OpticsFit(residuals.names, sd, residuals.parameters(fit.x), scene, information, validation)


def _sum_over_patches(geometry: SamplingGeometry, score: Array, cells: int) -> Array:
    """``score`` (n, p) summed over the samples of each patch of the grid, shape (patches, p)."""
    across = cells // PATCH_CELLS + 1
    column, row = (
        np.clip(position // PATCH_CELLS, 0, across - 1).astype(np.intp) for position in (geometry.u, geometry.v)
    )
    patch, patches = row * across + column, across**2
    sums = np.array([np.bincount(patch, column_score, patches) for column_score in score.T])
    return sums.reshape(score.shape[1], patches).T


def _cluster_robust_information(information: Array, patch_scores: Array) -> Array:
    """Information H S^-1 H of samples whose residuals are correlated within a patch; S is the scatter of the scores.

    Detail that the cells do not resolve is common to all samples of a place and does not average out as noise does. No
    direction gains information by this.

    Source: Liang & Zeger 1986, "Longitudinal data analysis using generalized linear models", eq 7.
    """
    root = np.linalg.cholesky(information + 1e-9 * (1.0 + np.trace(information)) * np.eye(len(information)))
    whitened = np.linalg.solve(root, patch_scores.T)
    scatter, vectors = np.linalg.eigh(whitened @ whitened.T)
    vectors = root @ vectors
    return np.asarray(vectors / np.maximum(scatter, 1.0) @ vectors.T)


def validation_error(scan: ScanSamples, parameters: OpticsParameters, cells: int) -> float:
    """Mean square error of the samples left out, in the intensity's unit squared; noise is estimated with the scene."""
    undetected = {
        **parameters,
        "intensity_delay": parameters["intensity_delay"] + parameters["intensity_lag"],
        "intensity_lag": 0.0,
    }
    variances = measure_cell_variances(scan, project_samples(scan, undetected, cells), cells)
    geometry, scene = project_samples(scan, parameters, cells), None
    for _ in range(COMPARISON_ROUNDS):
        solver = SceneSolver(geometry, scan.train_mask / variances.noise, variances.prior, cells, scan.run_bounds)
        fit = solver.fit(scan.intensity, scene)
        scene = fit.scene
        prior = 0.5 * float(np.mean(np.diff(scene, axis=0) ** 2) + np.mean(np.diff(scene, axis=1) ** 2))
        variances = CellVariances(float(np.mean(fit.residual[scan.train_mask] ** 2)), prior)
    return float(np.mean(fit.residual[scan.validation_mask] ** 2))


def _half_cell_steps(scan: ScanSamples, cells: int) -> dict[str, float]:
    """Change of each parameter that moves samples by at most half a cell, or the light by 5 %."""
    half_cell, speed = 1.0 / cells, scan.largest_speed
    fastest = half_cell / max(speed.values())
    steps = {"decay": 0.1, "intensity_delay": fastest, "intensity_lag": fastest}
    for axis in AXES:
        delay = half_cell / speed[axis]
        steps |= {f"delay_{axis}": delay, f"delay_growth_{axis}": 2 * delay, f"amplitude_growth_{axis}": 2 * half_cell}
        steps |= {f"drift_{axis}": half_cell}
    return steps
