"""Films in TIFF files, read and written frame by frame, so that a film may be larger than memory."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from recon.io.tiff_size import needs_bigtiff
from scanner.errors import BadInput

COLOURS = (2, 3, 6, 8)
"""Photometric interpretations of colour pictures: RGB, palette, YCbCr, CIELAB (TIFF 6.0)."""

OME_LENGTHS = ("PhysicalSizeX", "PhysicalSizeY", "PhysicalSizeZ", "TimeIncrement")
"""Attributes of OME's pixels that hold for a film whose values are changed; each may have a unit."""


@dataclass(frozen=True)
class Film:
    """A film in a TIFF file.

    Attributes:
        path: the file.
        axes: letters of ``shape`` as tifffile names them, of which the last two are Y and X.
        shape: of the whole film.
        dtype: of the pixels.
        offset: of the first plane, if all planes stand one behind the other uncompressed; else None.
        description: what else the file states, to be written again.
    """

    path: Path
    axes: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    offset: int | None
    description: dict[str, Any] = field(default_factory=dict)

    @property
    def channels(self) -> int:
        """Detectors of a frame: the last axis before the lines, if it is called C."""
        return self.shape[-3] if self.axes[-3:-2] == "C" else 1

    @property
    def frames(self) -> int:
        """Number of frames; slices of a stack count as frames."""
        return math.prod(self.shape[:-2]) // self.channels

    def read(self, indices: Iterable[int]) -> Iterator[NDArray[Any]]:
        """Yield the frames of these indices, each of shape (channels, rows, columns).

        Raises:
            BadInput: a page is damaged, or a pixel is not a finite number.
        """
        import tifffile

        with tifffile.TiffFile(self.path) as file:
            series = _full_series(file)
            pages = series[0].pages if len(series) == 1 else [page for each in series for page in each.pages]
            for index in indices:
                planes = range(index * self.channels, (index + 1) * self.channels)
                try:
                    frame = np.stack([self._plane(file, pages, plane) for plane in planes])
                except Exception as error:  # tifffile and its codecs raise errors of many types
                    reason = " ".join(str(error).split()) or type(error).__name__
                    raise BadInput(f"frame {index} is damaged: {reason}", file=self.path) from None
                if not np.isfinite(frame).all():
                    hint = "replace them by the values around, or leave the frame out"
                    raise BadInput(f"frame {index} holds pixels that are not finite", file=self.path, hint=hint)
                yield frame

    def _plane(self, file: Any, pages: Any, index: int) -> NDArray[Any]:
        size = self.shape[-2:]
        if self.offset is None:
            return np.asarray(pages[index].asarray()).reshape(size)
        count = math.prod(size)
        file.filehandle.seek(self.offset + index * count * self.dtype.itemsize)
        stored = self.dtype.newbyteorder(file.byteorder)
        plane = np.frombuffer(file.filehandle.read(count * stored.itemsize), stored).reshape(size)
        return plane.astype(self.dtype, copy=False)


def open_film(path: Path) -> Film:
    """Read what a TIFF file states of its film.

    Raises:
        BadInput: the file is no TIFF, is truncated, or holds colour pictures or no integers or floats.
    """
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what is damaged is said in one line
    try:
        with tifffile.TiffFile(path) as file:
            several = _full_series(file)
            series, page = several[0], several[0].keyframe
            film = Film(path, series.axes, series.shape, series.dtype, series.dataoffset, _description(file, page))
            colour = "S" in series.axes or page.photometric in COLOURS
            planes, size = len(series.pages), path.stat().st_size
            if len(several) > 1:
                film, planes = _join_series(film, several), len(several)
    except OSError as error:
        raise BadInput(f"cannot be read: {error.strerror}", file=path, hint="name a film (TIFF)") from None
    except (tifffile.TiffFileError, ValueError, IndexError, KeyError, AttributeError) as error:
        reason = " ".join(str(error).split())
        hint = "name a film (TIFF); tifffile.imwrite makes one of an array"
        raise BadInput(f"is no TIFF file that can be read: {reason}", file=path, hint=hint) from None
    if colour:
        hint = (
            "give the detectors as channels (axis C), not as RGB; tifffile.imwrite needs photometric='minisblack' for "
        )
        hint += "a film of 3 or 4 frames"
        raise BadInput("is a colour picture", file=path, hint=hint)
    if film.axes[-2:] != "YX":
        raise BadInput(f"has the axes {film.axes}", file=path, hint="lines and columns have to be the last two")
    if film.dtype.kind not in "iuf":
        raise BadInput(f"holds pixels of type {film.dtype}", file=path, hint="integers or floats are needed")
    stored = math.prod(film.shape) * film.dtype.itemsize
    if film.offset is not None and film.offset + stored > size:
        raise BadInput("is truncated: its frames are longer than the file", file=path, hint="copy it again")
    if film.offset is None and planes != film.frames * film.channels:
        raise BadInput(f"states {film.frames * film.channels} planes and holds {planes}", file=path)
    return film


def _full_series(file: Any) -> list[Any]:
    """Series of an open TIFF file, without thumbnails."""
    return [each for each in file.series if not each.keyframe.is_reduced] or list(file.series[:1])


def _join_series(film: Film, series: Sequence[Any]) -> Film:
    """The film whose frames were written one by one, so that the file lists each as a series of its own.

    Raises:
        BadInput: they are no single planes of one size and type.
    """
    shapes = {f"{'x'.join(map(str, each.shape))} {each.axes} {each.dtype}" for each in series}
    if len(shapes) > 1 or film.axes != "YX":
        what = f"holds {len(series)} series ({', '.join(sorted(shapes))})"
        raise BadInput(what, file=film.path, hint="write the film that is meant into a file of its own")
    return replace(film, axes="TYX", shape=(len(series), *film.shape), offset=None)


def write_film(path: Path, film: Film, planes: Iterable[NDArray[Any]]) -> None:
    """Write planes, each of shape (rows, columns), as a TIFF file of the form, shape and type of ``film``."""
    import tifffile

    large = needs_bigtiff(film.shape, film.dtype)
    description = {**film.description, "metadata": {"axes": film.axes, **film.description.get("metadata", {})}}
    if large:  # ImageJ's form ends at 4 GB
        description["imagej"] = False
    tifffile.imwrite(
        path,
        iter(planes),
        shape=film.shape,
        dtype=film.dtype.newbyteorder("="),
        photometric="minisblack",
        bigtiff=large,
        **description,
    )


def _description(file: Any, page: Any) -> dict[str, Any]:
    """Arguments for tifffile that write again the resolution, and what ImageJ or OME states of length and time."""
    stated: dict[str, Any] = {"imagej": bool(file.is_imagej), "ome": bool(file.is_ome)}
    if "XResolution" in page.tags and "YResolution" in page.tags:
        stated["resolution"], stated["resolutionunit"] = page.resolution, page.resolutionunit
    if file.is_imagej:
        kept = ("unit", "finterval", "fps", "spacing", "tunit")
        stated["metadata"] = {key: value for key, value in file.imagej_metadata.items() if key in kept}
    elif file.is_ome:
        stated["metadata"] = _ome_statements(file.ome_metadata)
    return stated


def _ome_statements(description: str) -> dict[str, Any]:
    """Sizes of a pixel, time from frame to frame and names of the channels in a description by OME; empty without."""
    try:
        root = ElementTree.fromstring(description)
    except ElementTree.ParseError:
        return {}
    pixels = root.find(".//{*}Pixels")
    if pixels is None:
        return {}
    keys = [key for length in OME_LENGTHS for key in (length, f"{length}Unit")]
    stated: dict[str, Any] = {key: pixels.attrib[key] for key in keys if key in pixels.attrib}
    names = [channel.get("Name") for channel in pixels.iterfind("{*}Channel")]
    return stated | ({"Channel": {"Name": names}} if names and all(names) else {})
