"""Geometry of the mirror: the ray that leaves the scanner at given mechanical angles.

Coordinates: z along the outgoing beam at rest, x and y such that positive angles move the beam towards +x and +y. The
origin is the point of the last mirror that the beam at rest leaves from.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from scanner.arrays import Array
from scanner.device_toml import FINITE, NOT_NEGATIVE, check_values
from scanner.errors import DeviceInvalid


@dataclass(frozen=True)
class Geometry:
    """Path of the beam over the mirror or mirrors, and the lens behind them.

    Attributes:
        kind: ``"gimbal"``, one mirror with two axes, or ``"two-mirror"``, one axis each with folds of 90 degrees.
        order: ``"xy"`` or ``"yx"``: the outer axis of the gimbal first, or the mirror first that the beam meets first.
        incidence: angle between the incoming beam and the normal of the mirror at rest, of a gimbal [rad].
        incidence_plane: ``"x"`` or ``"y"``: the plane with z in which the beam of a gimbal comes in.
        axis_offset: distance of the mirror's surface from the crossing of its axes, of a gimbal; distance between the
            axes of two mirrors [m].
        magnification: field angle behind the lens by that before it.
        distortion: c1, c2, …: the field angle r behind the lens is magnification r (1 + c1 r² + c2 r⁴ + …) [1/rad², …].
        range_offset: what the range finder shows for a target at the origin; it is subtracted [m].
        range_sd: standard deviation of one range [m].
    """

    KINDS: ClassVar[tuple[str, ...]] = ("gimbal", "two-mirror")

    kind: str = "gimbal"
    order: str = "xy"
    incidence: float = field(default=0.0, metadata=FINITE)
    incidence_plane: str = "y"
    axis_offset: float = field(default=0.0, metadata=FINITE)
    magnification: float = field(default=1.0, metadata=FINITE)
    distortion: tuple[float, ...] = field(default=(), metadata=FINITE)
    range_offset: float = field(default=0.0, metadata=FINITE)
    range_sd: float = field(default=0.0, metadata=NOT_NEGATIVE)

    def __post_init__(self) -> None:
        choices = {"kind": self.KINDS, "order": ("xy", "yx"), "incidence_plane": ("x", "y")}
        for key, known in choices.items():
            if getattr(self, key) not in known:
                hint = f"write one of {', '.join(known)}"
                raise DeviceInvalid(f"{getattr(self, key)!r} is unknown", channel=key, hint=hint)
        check_values(self)
        if not abs(self.incidence) < np.pi / 2:
            hint = "give radians between -1.57 and 1.57"
            raise DeviceInvalid(f"{self.incidence:g} rad is no angle of incidence", channel="incidence", hint=hint)


def trace_rays(geometry: Geometry, theta_x: Array, theta_y: Array) -> tuple[Array, Array, Array]:
    """Return where the beams leave the last mirror, their directions, and the paths up to there.

    Args:
        geometry: of the scanner.
        theta_x, theta_y: mechanical angles, shape (n,) [rad].

    Returns:
        Origins, shape (n, 3) [m]; directions, shape (n, 3), of length 1; and by how much the path up to the origin is
        longer than at rest, shape (n,) [m].
    """
    trace = _trace_gimbal if geometry.kind == "gimbal" else _trace_two_mirrors
    origin, direction, path = trace(geometry, theta_x, theta_y)
    return origin, _through_lens(geometry, direction), path


def locate_points(geometry: Geometry, theta_x: Array, theta_y: Array, distance: Array) -> Array:
    """Return the points at the measured distances, shape (n, 3) [m].

    Args:
        geometry: of the scanner.
        theta_x, theta_y: mechanical angles, shape (n,) [rad].
        distance: as the range finder states it, shape (n,) [m].
    """
    origin, direction, path = trace_rays(geometry, theta_x, theta_y)
    return origin + (distance - geometry.range_offset - path)[:, None] * direction


def _trace_gimbal(geometry: Geometry, theta_x: Array, theta_y: Array) -> tuple[Array, Array, Array]:
    """Rays of one mirror that turns about two axes in its surface, the inner one carried by the outer one."""
    sine, cosine = np.sin(geometry.incidence), np.cos(geometry.incidence)
    if geometry.incidence_plane == "y":
        normal = np.array([0.0, sine, cosine])
        axes = {"x": np.array([0.0, cosine, -sine]), "y": np.array([-1.0, 0.0, 0.0])}
    else:
        normal = np.array([sine, 0.0, cosine])
        axes = {"x": np.array([0.0, 1.0, 0.0]), "y": np.array([-cosine, 0.0, sine])}
    angles = {"x": theta_x, "y": theta_y}
    outer, inner = geometry.order[0], geometry.order[1]
    turned = _rotate(axes[inner], angles[inner], np.broadcast_to(normal, (theta_x.size, 3)))
    turned = _rotate(axes[outer], angles[outer], turned)
    incoming = _reflect(np.array([0.0, 0.0, 1.0]), normal)
    # the mirror's plane lies axis_offset before the axes; the beam meets the middle of the mirror at rest
    path = geometry.axis_offset * (1.0 - turned @ normal) / (turned @ incoming)
    return path[:, None] * incoming, _reflect(incoming, turned), path


def _trace_two_mirrors(geometry: Geometry, theta_x: Array, theta_y: Array) -> tuple[Array, Array, Array]:
    """Rays of two mirrors at 45° whose axes are perpendicular and ``axis_offset`` apart."""
    first, second = geometry.order[0], geometry.order[1]
    angles = {"x": theta_x, "y": theta_y}
    unit = {"x": np.array([1.0, 0.0, 0.0]), "y": np.array([0.0, 1.0, 0.0])}
    z = np.array([0.0, 0.0, 1.0])
    between, incoming = -unit[second], unit[first]  # directions of the beam at rest
    normals = (between - incoming) / np.sqrt(2.0), (z - between) / np.sqrt(2.0)
    count = theta_x.size
    # each mirror turns about the normal of its plane of incidence, towards positive angles
    axis_first, axis_second = np.cross(between, unit[first]), np.cross(z, unit[second])
    one = _rotate(axis_first, angles[first], np.broadcast_to(normals[0], (count, 3)))
    two = _rotate(axis_second, angles[second], np.broadcast_to(normals[1], (count, 3)))
    start = -geometry.axis_offset * between
    beam = _reflect(incoming, one)
    length = -(two @ start) / np.sum(beam * two, axis=1)
    return start + length[:, None] * beam, _reflect(beam, two), length - geometry.axis_offset


def _rotate(axis: Array, angle: Array, vectors: Array) -> Array:
    """Vectors, shape (n, 3), turned about an axis of length 1 by ``angle``, shape (n,) (Rodrigues)."""
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return vectors * cosine + np.cross(axis, vectors) * sine + np.outer(vectors @ axis, axis) * (1.0 - cosine)


def _reflect(beam: Array, normal: Array) -> Array:
    """Direction of a beam behind a mirror; either may be shape (3,) or (n, 3)."""
    return np.asarray(beam - 2.0 * np.sum(beam * normal, axis=-1, keepdims=True) * normal)


def _through_lens(geometry: Geometry, direction: Array) -> Array:
    """Directions behind a lens that is symmetric about z."""
    if geometry.magnification == 1.0 and not geometry.distortion:
        return direction
    across = np.hypot(direction[:, 0], direction[:, 1])
    before = np.arctan2(across, direction[:, 2])
    powers = sum(c * before ** (2 * (k + 1)) for k, c in enumerate(geometry.distortion))
    behind = geometry.magnification * before * (1.0 + powers)
    scale = np.divide(np.sin(behind), across, out=np.zeros_like(across), where=across > 0.0)
    return np.stack([direction[:, 0] * scale, direction[:, 1] * scale, np.cos(behind)], axis=1)
