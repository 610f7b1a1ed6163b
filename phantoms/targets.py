"""Targets: pictures of the sample's reflectance, in [0, 1], over the whole field.

Every target is a float64 array of shape (H, W). Row 0 lies at theta_y = -half_angle_y, column 0 at
theta_x = -half_angle_x, and a pixel holds the *mean* of the pattern over its own area, so that edges do not alias and
detail finer than a pixel fades to grey as it would under a real spot. Pixels are assumed square: the size should
have the aspect ratio of the field.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array
from scanner.errors import BadInput

Size = tuple[int, int]

DEFAULT_SIZE: Size = (1600, 1600)
"""Height and width in pixels: four target pixels to one pixel of a 400 x 400 picture."""

LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
"""Weights of red, green and blue in the luminance, shape (3,). Source: ITU-R BT.709."""

TISSUES = ("immunohistochemistry", "retina", "cell", "microaneurysms")
"""Names of the pictures that scikit-image has of tissue."""


def draw_usaf_bars(size: Size = DEFAULT_SIZE, depth: int = 3) -> Array:
    """Bright three-bar elements with fine and coarse bars in all parts of the field, shape (H, W).

    An element has three vertical and three horizontal bars of width w and length 5w at distances w. The six elements of
    a group shrink by 2^(-1/6) each, and the next group has half the size. A group fills one quadrant of the square. The
    other three quadrants have the whole layout at half scale: a phase error blurs the centre of a scan line and not its
    ends, so that a single copy of the fine bars would test one place only.

    Args:
        size: (H, W). The layout fills the middle square.
        depth: number of halvings. The widest bar is 1/52 of the square's side, the finest ``2^(-depth - 5/6) / 26``
            (1.1 pixels of a 400 x 400 picture for the default).

    Source: USAF 1951 resolution target, MIL-STD-150A.
    """
    picture = np.zeros(size)
    side = min(size)

    def add_group(top: float, left: float, box: float) -> None:
        for column, x in enumerate((1.0, 14.5)):
            y = 1.5
            for bar in 2.0 ** (-np.arange(column, 6, 2) / 6):
                _add_element(picture, top + y * box / 26, left + x * box / 26, bar * box / 26)
                y += 9.5 * bar

    def add_layout(top: float, left: float, box: float, halvings: int) -> None:
        half = box / 2
        add_group(top, left, half)
        for y, x in ((top, left + half), (top + half, left), (top + half, left + half)):
            if halvings > 1:
                add_layout(y, x, half, halvings - 1)
            else:
                add_group(y, x, half)

    add_layout((size[0] - side) / 2, (size[1] - side) / 2, side, depth)
    return picture


def draw_siemens_star(size: Size = DEFAULT_SIZE, spokes: int = 36, radius: float = 0.47) -> Array:
    """Star of bright spokes, whose pitch decreases to zero at the centre of the field, shape (H, W).

    Args:
        size: (H, W).
        spokes: number of bright spokes; at ``r`` pixels from the centre their pitch is ``2 pi r / spokes`` pixels.
        radius: of the star, as a fraction of the field's shorter side.
    """
    y, x = _centred(size)
    r = np.hypot(y, x)
    position = np.arctan2(y, x) / (2 * np.pi) * spokes  # in periods
    pixel_in_periods = spokes / (2 * np.pi * np.maximum(r, 1e-9))
    rim = np.clip(radius * min(size) - r + 0.5, 0.0, 1.0)
    return _pulse_mean(position, pixel_in_periods) * rim


def draw_point_grid(size: Size = DEFAULT_SIZE, points: int = 25, width: float = 0.08) -> Array:
    """Bright square dots on a square lattice, with one at the centre of the field if ``points`` is odd, shape (H, W).

    Args:
        size: (H, W).
        points: number of dots along the shorter side.
        width: of a dot, as a fraction of the lattice's pitch.
    """
    pitch = min(size) / points
    y, x = (_pulse_mean((v / pitch + (points - 1 + width) / 2), 1 / pitch, width) for v in _centred(size))
    return y * x


def draw_checkerboard(size: Size = DEFAULT_SIZE, squares: int = 20) -> Array:
    """Black and white squares; if ``squares`` is even, four meet at the centre of the field, shape (H, W).

    Args:
        size: (H, W).
        squares: number of squares along the shorter side.
    """
    period = 2 * min(size) / squares
    y, x = (2 * _pulse_mean(v / period + squares / 4, 1 / period) - 1 for v in _centred(size))
    return 0.5 + 0.5 * y * x


def load_tissue(name: str = "immunohistochemistry", size: Size = DEFAULT_SIZE) -> Array:
    """Luminance of a picture of scikit-image, cropped and resampled as by ``read_image_file``, shape (H, W).

    Args:
        name: one of ``TISSUES``.
        size: (H, W).

    Raises:
        BadInput: there is no such picture.
    """
    from skimage import data

    if name not in TISSUES:
        raise BadInput(f"no tissue picture is called {name!r}", hint=f"there are {', '.join(TISSUES)}")
    return _fit(_grey(getattr(data, name)()), size)


def read_image_file(path: str | Path, size: Size = DEFAULT_SIZE) -> Array:
    """Luminance of the picture in a file, cropped about its centre to the aspect ratio of ``size`` and resampled.

    Integers are divided by the largest value of their type. Floats must be in [0, 1]. Transparency is ignored.

    Args:
        path: of a PNG, JPEG, TIFF, BMP, GIF or WebP file.
        size: (H, W).

    Returns:
        Shape (H, W), in [0, 1].

    Raises:
        BadInput: no such file, no picture in it, more than one picture, or values outside [0, 1].
    """
    pixels = _decode(Path(path))
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in (3, 4))):
        raise BadInput(f"holds an array of shape {pixels.shape}", file=path, hint="one picture, grey or RGB, is needed")
    grey = _grey(pixels)
    if not (np.isfinite(grey).all() and grey.min() >= 0 and grey.max() <= 1):
        raise BadInput("has values outside [0, 1] or NaN", file=path, hint="scale it to [0, 1] first")
    return _fit(grey, size)


def make_target(name: str | Path, size: Size = DEFAULT_SIZE) -> Array:
    """The target of a name, or the picture in a file, shape (H, W), in [0, 1].

    Args:
        name: a key of ``TARGETS``, one of ``TISSUES``, or a path.
        size: (H, W), covering the whole field.

    Raises:
        BadInput: neither a known name nor a file, or a file without a usable picture.
    """
    if not isinstance(name, (str, Path)):
        raise BadInput(f"is {name!r}", channel="target", hint="give the name of a target or an image file, as text")
    if name in TARGETS:
        return TARGETS[str(name)](size)
    if name in TISSUES:
        return load_tissue(str(name), size)
    if not Path(name).is_file():
        known = ", ".join((*TARGETS, *TISSUES))
        raise BadInput(f"no target and no file is called {str(name)!r}", hint=f"give a file or one of {known}")
    return read_image_file(name, size)


TARGETS: dict[str, Callable[[Size], Array]] = {
    "usaf_bars": draw_usaf_bars,
    "siemens_star": draw_siemens_star,
    "point_grid": draw_point_grid,
    "checkerboard": draw_checkerboard,
}
"""Functions that draw a target, by its name."""


def _centred(size: Size) -> tuple[Array, Array]:
    """Pixel centres from the centre of the field [px]: y of shape (H, 1), x of shape (1, W)."""
    y, x = (np.arange(n, dtype=np.float64) + 0.5 - n / 2 for n in size)
    return y[:, None], x[None, :]


def _pulse_mean(position: Array, width: Array | float, duty: float = 0.5) -> Array:
    """Mean over ``position +- width/2`` of a square wave, 1 on [0, duty) and 0 on [duty, 1) of every period."""

    def integral(p: Array) -> Array:
        whole = np.floor(p)
        return duty * whole + np.minimum(p - whole, duty)

    mean = (integral(position + 0.5 * width) - integral(position - 0.5 * width)) / width
    return np.clip(mean, 0.0, 1.0)  # rounding errors of the difference may exceed the interval


def _add_element(picture: Array, top: float, left: float, bar: float) -> None:
    """Add, in place, three vertical bars and, two bars further right, three horizontal ones, all 5 bars long [px]."""
    for offset in (0, 2 * bar, 4 * bar):
        _add_rectangle(picture, top, left + offset, 5 * bar, bar)
        _add_rectangle(picture, top + offset, left + 7 * bar, bar, 5 * bar)


def _add_rectangle(picture: Array, top: float, left: float, height: float, width: float) -> None:
    """Add, in place, the exact coverage of each pixel by a rectangle given in pixels from the picture's corner."""
    rows, cover_y = _interval(top, height)
    columns, cover_x = _interval(left, width)
    picture[rows, columns] += np.outer(cover_y, cover_x)


def _interval(start: float, length: float) -> tuple[slice, Array]:
    """Pixels that [start, start + length) touches, and the covered fraction of each."""
    first, stop = int(np.floor(start)), int(np.ceil(start + length))
    edges = np.clip(np.arange(first, stop + 1), start, start + length)
    return slice(first, stop), np.diff(edges)


def _decode(path: Path) -> NDArray[Any]:
    """Pixels of the picture in a file as stored, (H, W) or (H, W, colours); colours in the order R, G, B."""
    import cv2
    import tifffile

    try:
        if path.suffix.lower() in (".tif", ".tiff"):  # OpenCV reads fewer kinds of TIFF
            return tifffile.imread(path)
        encoded = np.fromfile(path, np.uint8)
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror or error})", file=path) from None
    except ValueError as error:
        raise BadInput(f"holds no readable TIFF picture ({error})", file=path) from None
    log = cv2.utils.logging
    level = log.setLogLevel(log.LOG_LEVEL_SILENT)  # the error below reports a damaged file
    try:
        pixels = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED) if encoded.size else None
    except cv2.error:
        pixels = None
    finally:
        log.setLogLevel(level)
    if pixels is None:
        raise BadInput("holds no readable picture", file=path, hint="PNG, JPEG, TIFF, BMP, GIF and WebP are read")
    return pixels if pixels.ndim == 2 else pixels[..., 2::-1]


def _grey(pixels: NDArray[Any]) -> Array:
    """Luminance as float64: integers relative to the largest value of their type, floats as they are."""
    full_scale = np.iinfo(pixels.dtype).max if np.issubdtype(pixels.dtype, np.integer) else 1.0
    scaled = pixels.astype(np.float64) / full_scale
    return scaled if scaled.ndim == 2 else scaled[..., :3] @ LUMINANCE_WEIGHTS


def _fit(picture: Array, size: Size) -> Array:
    """Crop about the centre to the aspect ratio of ``size`` and resample: area means down, clipped cubic up."""
    import cv2

    scale = min(available / asked for available, asked in zip(picture.shape, size, strict=True))
    crop = [max(1, round(asked * scale)) for asked in size]
    top, left = ((available - used) // 2 for available, used in zip(picture.shape, crop, strict=True))
    cropped = picture[top : top + crop[0], left : left + crop[1]]
    method = cv2.INTER_AREA if scale > 1 else cv2.INTER_CUBIC
    return np.clip(cv2.resize(cropped, size[::-1], interpolation=method), 0.0, 1.0)
