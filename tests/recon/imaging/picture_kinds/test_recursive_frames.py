"""Frames that use the samples of earlier frames: gain at rest, and a scene that changes."""

import numpy as np

from recon.imaging.picture_kinds.held_out import SplitSums
from recon.imaging.picture_kinds.kernel_picture import PictureEstimate
from recon.imaging.picture_kinds.recursive_frames import CarriedFrames, recursive_picture
from recon.imaging.pixel_noise import SampleNoise
from scanner.arrays import Array

SIZE, SAMPLES, NOISE_SD = 64, 2000, 0.1
CHANGED = slice(20, 44), slice(20, 44)


def steps(changed: bool) -> Array:
    """A scene of two steps; ``changed`` adds a bright square."""
    scene = np.zeros((SIZE, SIZE))
    scene[:, 16:] = 0.5
    scene[48:] = 1.0
    if changed:
        scene[CHANGED] = 1.5
    return scene


def sample(scene: Array, seed: int) -> SplitSums:
    """Sums of samples at random pixels, a tenth of them held out."""
    rng = np.random.default_rng(seed)
    pixel = rng.integers(0, SIZE**2, SAMPLES)
    values = scene.ravel()[pixel] + rng.normal(0.0, NOISE_SD, SAMPLES)

    def images(part: slice) -> tuple[Array, Array]:
        sums = np.bincount(pixel[part], values[part], SIZE**2), np.bincount(pixel[part], minlength=SIZE**2)
        return sums[0].reshape(SIZE, SIZE), sums[1].reshape(SIZE, SIZE).astype(float)

    return SplitSums(*images(slice(None)), *images(slice(None, None, 10)))


def last_frame(scenes: list[Array], unit: float = 1.0) -> PictureEstimate:
    """Picture of the last of successive frames."""
    carried: CarriedFrames | None = None
    for seed, scene in enumerate(scenes):
        samples = SplitSums(*(part if k % 2 else unit * part for k, part in enumerate(sample(scene, seed))))
        estimate, carried = recursive_picture(samples, SampleNoise((unit * NOISE_SD) ** 2, 0.0, 0.0), carried)
    return estimate


def error(estimate: PictureEstimate, scene: Array, part: tuple[slice, slice] = (slice(None), slice(None))) -> float:
    return float(np.sqrt(np.mean((estimate.image - scene)[part] ** 2)))


def test_earlier_frames_lower_the_error_of_a_scene_at_rest() -> None:
    scene = steps(changed=False)
    early, late = last_frame([scene]), last_frame([scene] * 8)
    assert error(late, scene) < 0.8 * error(early, scene)  # 2 dB
    held = np.mean(np.abs(late.image - scene) < 1.96 * late.sd)
    assert held > 0.9


def test_a_part_that_changes_is_not_mixed_with_earlier_frames() -> None:
    before, after = steps(changed=False), steps(changed=True)
    estimate = last_frame([before] * 6 + [after])
    inner = slice(26, 38), slice(26, 38)
    assert error(estimate, after, inner) < 0.1
    assert np.mean((np.abs(estimate.image - after) < 1.96 * estimate.sd)[CHANGED]) > 0.85


def test_frames_do_not_depend_on_the_unit_of_the_intensity() -> None:
    scenes = [steps(False), steps(False), steps(True)]
    picture, scaled = last_frame(scenes), last_frame(scenes, 1e-9)
    np.testing.assert_allclose(scaled.image, 1e-9 * picture.image, rtol=1e-3, atol=1e-11)
    np.testing.assert_allclose(scaled.sd, 1e-9 * picture.sd, rtol=1e-2)
