"""Line phases of successive frames, smoothed over time as a random walk observed with noise."""

from __future__ import annotations

import numpy as np

from scanner.arrays import Array

MIN_NOISE_FRACTION = 0.1
"""Smallest share of a squared standard error that is attributed to noise, because the estimate of the other part
scatters."""

STEP_VARIANCE_RATIOS = np.logspace(-6.0, 3.0, 73)
"""Variances of the walk's step that are weighed, in those of a frame's noise: from a phase that is constant over a
million frames to one that the smoothing leaves as it is."""

MIN_STEP_WEIGHT = 1e-4
"""Weight below which a step is left out of the mean: all such steps together change it by less than 1 %."""


def smooth_phases(value: Array, sd: Array, shared_sd: float = 0.0) -> tuple[Array, Array]:
    """Smooth the shifts of successive frames as a random walk observed with noise; bridge undetermined frames.

    The result is the mean over the standard deviation of the walk's step, weighted by its likelihood, because a film of
    tens of frames determines the step to a factor only.

    Args:
        value: shift of each frame [px], shape (n,); nan where undetermined.
        sd: standard errors [px], shape (n,).
        shared_sd: part of them that all frames share, which no averaging reduces [px].

    Returns:
        Shift and standard deviation of each frame [px], shape (n,).

    Source:
        Gelman 2006, "Prior distributions for variance parameters in hierarchical models": uniform in the standard
        deviation.
    """
    known = np.isfinite(value)
    noise = np.where(known, np.maximum(np.square(sd) - shared_sd**2, MIN_NOISE_FRACTION * np.square(sd)), np.inf)
    step = float(np.median(noise[known])) * STEP_VARIANCE_RATIOS
    first = int(np.argmax(known))
    mean, variance, cost = np.full(step.size, value[first]), np.full(step.size, noise[first]), np.zeros(step.size)
    for v, r in zip(value[first + 1 :], noise[first + 1 :], strict=True):
        variance = variance + step
        if np.isfinite(v):
            total = variance + r
            cost += np.square(v - mean) / total + np.log(total)
            gain = variance / total
            mean, variance = mean + gain * (v - mean), (1.0 - gain) * variance
    cost -= np.log(step)  # even steps of the logarithm of the variance, for a prior uniform in the standard deviation
    weight = np.exp(0.5 * (cost.min() - cost))
    used = weight > MIN_STEP_WEIGHT * weight.sum()
    weight = weight[used] / weight[used].sum()
    smooth, left = _smooth_walk(np.where(known, value, 0.0), noise, step[used])
    average = smooth @ weight
    return average, np.sqrt((left + np.square(smooth - average[:, None])) @ weight + shared_sd**2)


def _smooth_walk(value: Array, noise: Array, step: Array) -> tuple[Array, Array]:
    """Mean and variance of random walks given all observations, by information from before and from behind.

    Args:
        value, noise: observations and their variances, shape (n,).
        step: variances of the walks' steps, shape (k,).

    Returns:
        Mean and variance, each of shape (n, k).
    """

    def pass_over(values: Array, noises: Array) -> tuple[Array, Array]:
        """Weighted mean and information of the observations before each one, shape (n, k)."""
        mean, information = np.zeros(step.size), np.zeros(step.size)
        means, informations = np.zeros((2, values.size, step.size))
        for k, (v, r) in enumerate(zip(values, noises, strict=True)):
            information = information / (1.0 + information * step)
            means[k], informations[k] = mean, information
            weight = 1.0 / r
            if weight > 0.0:
                mean = (information * mean + weight * v) / (information + weight)
                information = information + weight
        return means, informations

    before, before_information = pass_over(value, noise)
    behind, behind_information = (each[::-1] for each in pass_over(value[::-1], noise[::-1]))
    value, noise = value[:, None], noise[:, None]
    total = before_information + behind_information + 1.0 / noise
    return (before_information * before + behind_information * behind + value / noise) / total, 1.0 / total
