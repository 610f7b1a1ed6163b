"""Targets: area means without aliasing, geometry, and picture files."""

import cv2
import numpy as np
import pytest
import tifffile

from phantoms.targets import (
    LUMINANCE_WEIGHTS,
    TARGETS,
    TISSUES,
    draw_checkerboard,
    draw_point_grid,
    draw_siemens_star,
    draw_usaf_bars,
    load_tissue,
    make_target,
    read_image_file,
)
from scanner.errors import BadInput


def block_mean(picture, factor):
    height, width = (n // factor for n in picture.shape)
    return picture.reshape(height, factor, width, factor).mean(axis=(1, 3))


@pytest.mark.parametrize("name", [*TARGETS, *TISSUES])
@pytest.mark.parametrize("size", [(400, 400), (300, 500), (361, 302)])
def test_every_target_has_the_requested_size_values_in_0_1_and_contrast(name, size):
    picture = make_target(name, size)
    assert picture.shape == size
    assert picture.dtype == np.float64
    assert picture.min() >= 0
    assert picture.max() <= 1
    assert np.ptp(picture) > 0.2


@pytest.mark.parametrize("make", [draw_usaf_bars, draw_checkerboard, draw_point_grid])
@pytest.mark.parametrize("size", [(100, 100), (70, 110)])
def test_pixels_of_axis_aligned_targets_are_exact_area_means(make, size):
    fine = make((3 * size[0], 3 * size[1]))
    np.testing.assert_allclose(make(size), block_mean(fine, 3), atol=1e-10)


def test_pixels_of_the_siemens_star_are_area_means_within_two_percent():
    error = draw_siemens_star((240, 240)) - block_mean(draw_siemens_star((1920, 1920)), 8)
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert abs(error.mean()) < 1e-3


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_mean_of_the_usaf_bars_is_the_sum_of_their_areas(depth):
    group = 30 * np.sum(2.0 ** (-np.arange(6) / 3)) / 26**2  # of its quadrant: an element has six bars of area 5 w^2
    assert draw_usaf_bars((300, 300), depth).mean() == pytest.approx(
        group, rel=1e-12
    )  # in every quadrant, at any depth


def test_widest_usaf_bars_are_one_52nd_of_the_side():
    row = draw_usaf_bars((520, 520))[40]
    edges = np.flatnonzero(np.diff(row[:130] > 0.5)) + 1
    np.testing.assert_array_equal(edges[:6], [10, 20, 30, 40, 50, 60])


@pytest.mark.parametrize("spokes", [8, 36])
def test_siemens_star_has_the_requested_spokes_and_a_grey_centre(spokes):
    star = draw_siemens_star((401, 401), spokes)
    angle = np.linspace(0, 2 * np.pi, 20000, endpoint=False)
    ring = star[np.rint(200 + 150 * np.sin(angle)).astype(int), np.rint(200 + 150 * np.cos(angle)).astype(int)]
    assert np.count_nonzero(np.diff((ring > 0.5).astype(int), prepend=int(ring[-1] > 0.5)) == 1) == spokes
    assert star[200, 200] == pytest.approx(0.5, abs=1e-6)
    assert star[0, 0] == 0


def test_point_grid_has_the_requested_number_positions_and_areas():
    points, width = 5, 0.2
    picture = draw_point_grid((500, 500), points, width)
    count, _, stats, centres = cv2.connectedComponentsWithStats((picture > 0.5).astype(np.uint8))
    assert count - 1 == points**2
    assert set(stats[1:, cv2.CC_STAT_AREA]) == {20**2}
    expected = 100 * np.arange(points) + 49.5  # middle of each cell, as an index of pixel centres
    np.testing.assert_allclose(np.unique(np.round(centres[1:, 0], 6)), expected, atol=1e-6)


def test_four_squares_of_the_checkerboard_meet_at_the_centre_of_the_field():
    board = draw_checkerboard((200, 300), squares=20)
    np.testing.assert_allclose(board[95:105, 145:155], np.kron([[1, 0], [0, 1]], np.ones((5, 5))), atol=1e-10)
    assert board.mean() == pytest.approx(0.5)


def test_tissue_in_its_original_size_is_the_luminance_of_the_picture():
    from skimage import color, data

    np.testing.assert_allclose(load_tissue(size=(512, 512)), color.rgb2gray(data.immunohistochemistry()), atol=1e-3)


def test_tissue_is_cropped_about_its_centre_to_the_requested_aspect_ratio():
    whole, wide = load_tissue(size=(512, 512)), load_tissue(size=(256, 512))
    np.testing.assert_allclose(wide, whole[128:384], atol=1e-12)


def test_resampling_does_not_shift_the_picture(tmp_path):
    """Confusing corners and centres of pixels would shift the spot by half a coarse pixel."""
    y, x = np.mgrid[:200, :200] + 0.5
    spot = np.exp(-((x - 60) ** 2 + (y - 130) ** 2) / (2 * 15**2))
    tifffile.imwrite(tmp_path / "spot.tif", spot)
    for n in (100, 400):
        picture = read_image_file(tmp_path / "spot.tif", (n, n))
        centre = (np.arange(n) + 0.5) / n * 200
        total = picture.sum()
        assert (picture.sum(0) @ centre) / total == pytest.approx(60, abs=0.02)
        assert (picture.sum(1) @ centre) / total == pytest.approx(130, abs=0.02)


GREY = np.random.default_rng(0).integers(0, 256, (12, 15)).astype(np.uint8)
COLOUR = np.random.default_rng(1).integers(0, 256, (12, 15, 3)).astype(np.uint8)


def write_png(path, pixels):
    """``pixels`` in R, G, B (A) order."""
    swapped = pixels if pixels.ndim == 2 else pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
    path.write_bytes(cv2.imencode(".png", swapped)[1].tobytes())


@pytest.mark.parametrize(
    ("name", "write", "pixels", "grey"),
    [
        ("grey.png", write_png, GREY, GREY / 255),
        ("deep.png", write_png, GREY.astype(np.uint16) * 257, GREY / 255),
        ("colour.png", write_png, COLOUR, COLOUR / 255 @ LUMINANCE_WEIGHTS),
        ("alpha.png", write_png, np.dstack([COLOUR, GREY]), COLOUR / 255 @ LUMINANCE_WEIGHTS),
        ("grey.tif", tifffile.imwrite, (GREY / 255).astype(np.float32), GREY / 255),
        ("colour.TIFF", tifffile.imwrite, COLOUR, COLOUR / 255 @ LUMINANCE_WEIGHTS),
        ("mask.tif", tifffile.imwrite, GREY > 99, (GREY > 99) * 1.0),
    ],
)
def test_image_files_are_read_as_luminance_relative_to_full_scale(tmp_path, name, write, pixels, grey):
    write(tmp_path / name, pixels)
    np.testing.assert_allclose(read_image_file(tmp_path / name, GREY.shape), grey, atol=1e-6)
    np.testing.assert_array_equal(
        make_target(tmp_path / name, GREY.shape), read_image_file(tmp_path / name, GREY.shape)
    )


def png_half(path):
    encoded = cv2.imencode(".png", COLOUR)[1].tobytes()
    path.write_bytes(encoded[: len(encoded) // 2])


def tiff_half(path):
    tifffile.imwrite(path, COLOUR)
    path.write_bytes(path.read_bytes()[:-200])


@pytest.mark.parametrize(
    ("name", "write", "says"),
    [
        ("absent.png", lambda path: None, "No such file"),
        ("absent.tif", lambda path: None, "No such file"),
        ("folder", lambda path: path.mkdir(), "directory"),
        ("junk.png", lambda path: path.write_text("no picture"), "no readable picture"),
        ("junk.tif", lambda path: path.write_text("no picture"), "no readable TIFF"),
        ("empty.jpg", lambda path: path.write_bytes(b""), "no readable picture"),
        ("half.png", png_half, "no readable picture"),
        ("half.tif", tiff_half, "no readable TIFF"),
        ("stack.tif", lambda path: tifffile.imwrite(path, np.zeros((5, 9, 8)), photometric="minisblack"), "(5, 9, 8)"),
        ("nan.tif", lambda path: tifffile.imwrite(path, np.full((4, 4), np.nan)), "NaN"),
        ("volts.tif", lambda path: tifffile.imwrite(path, np.full((4, 4), 2.5)), "outside [0, 1]"),
        ("signed.tif", lambda path: tifffile.imwrite(path, np.full((4, 4), -3, np.int16)), "outside [0, 1]"),
    ],
)
def test_unusable_image_file_is_refused_in_one_line(tmp_path, capfd, name, write, says):
    write(tmp_path / name)
    with pytest.raises(BadInput) as caught:
        read_image_file(tmp_path / name)
    line = str(caught.value)
    assert line.startswith(str(tmp_path / name))
    assert says in line
    assert "\n" not in line
    assert capfd.readouterr() == ("", "")  # the messages of the decoders are suppressed


def test_error_of_an_unknown_target_lists_the_known_ones():
    with pytest.raises(BadInput, match=r"'moon'.*usaf_bars.*checkerboard.*immunohistochemistry"):
        make_target("moon")
    with pytest.raises(BadInput, match=r"'moon'.*retina"):
        load_tissue("moon")
