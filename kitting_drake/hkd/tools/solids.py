"""Building blocks of the generated hand tools: parts, profiles, plates and lofts.

Lengths are in mm, in the *design frame* of a tool: x along its length with the working end toward
+x, and z up when the tool lies flat. Each shape is built twice from the same numbers: as an exact
solid, for its looks and mass; and as many small point sets whose convex hulls fill it.
`collision.cover` merges these point sets into few collision hulls.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import manifold3d
import numpy as np
from manifold3d import CrossSection, JoinType, Manifold
from numpy.typing import ArrayLike

# The number of segments of a full circle. Pass it in every call, because manifold3d's default is
# too coarse for lengths in mm.
SEGMENTS = 48


class Material(NamedTuple):
    """The material of a part: density (kg/m^3) and diffuse colour (r, g, b, a in [0, 1])."""

    density: float
    rgba: tuple[float, float, float, float]


MATERIALS: dict[str, Material] = {
    "polished_steel": Material(7850.0, (0.80, 0.81, 0.83, 1.0)),
    "steel": Material(7850.0, (0.62, 0.64, 0.67, 1.0)),
    "dark_steel": Material(7850.0, (0.27, 0.28, 0.30, 1.0)),
    "hickory": Material(750.0, (0.82, 0.60, 0.34, 1.0)),
    "dark_wood": Material(950.0, (0.45, 0.27, 0.14, 1.0)),
    "leather": Material(900.0, (0.55, 0.30, 0.14, 1.0)),
    "painted_wood": Material(750.0, (0.62, 0.13, 0.10, 1.0)),
    # This material is painted aluminium.
    "red_enamel": Material(2700.0, (0.74, 0.07, 0.06, 1.0)),
    "red_grip": Material(1150.0, (0.80, 0.10, 0.09, 1.0)),
    "blue_grip": Material(1150.0, (0.07, 0.26, 0.62, 1.0)),
    "yellow_grip": Material(1150.0, (0.96, 0.71, 0.06, 1.0)),
    "green_grip": Material(1150.0, (0.08, 0.45, 0.22, 1.0)),
    "amber_plastic": Material(1190.0, (0.90, 0.55, 0.08, 1.0)),
    "orange_grip": Material(1150.0, (0.93, 0.40, 0.05, 1.0)),
    "black_rubber": Material(1200.0, (0.12, 0.12, 0.13, 1.0)),
}


@dataclass
class Part:
    """One homogeneous part of a tool, in mm, in the design frame.

    Where parts overlap, the volume belongs to the part that is earlier in the tool's list.
    """

    name: str
    # The material, a key of MATERIALS.
    material: str
    solid: Manifold
    # Point sets (n, 3) whose convex hulls fill the solid. The list is empty for a part that lies
    # inside the hulls of other parts.
    hulls: list[np.ndarray] = field(default_factory=list)


class Shape(NamedTuple):
    """A solid, and point sets (n, 3) whose convex hulls fill it."""

    solid: Manifold
    hulls: list[np.ndarray]

    def flipped(self) -> "Shape":
        """Returns the shape, rotated by 180 degrees about x."""
        flip = np.array([1.0, -1.0, -1.0])
        return Shape(self.solid.rotate((180, 0, 0)), [h * flip for h in self.hulls])


# Profiles: closed polygons (n, 2) in a plane, counter-clockwise.


def circle(
    radius: float, center: Sequence[float] = (0.0, 0.0), segments: int = SEGMENTS
) -> np.ndarray:
    """Returns a regular polygon (segments, 2) inscribed in a circle, with its first vertex toward
    +x."""
    angles = 2 * np.pi * np.arange(segments) / segments
    return np.asarray(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def fillet(
    points: Sequence[Sequence[float]], radii: float | Sequence[float], segments: int = 6
) -> np.ndarray:
    """Replaces each corner of a closed polygon by an arc.

    If a radius is too large for the edges at its corner, it is reduced; zero keeps the corner.
    """
    corners = np.asarray(points, dtype=float)
    corner_radii = np.broadcast_to(np.asarray(radii, dtype=float), len(corners))
    result = []
    for before, corner, after, radius in zip(
        np.roll(corners, 1, axis=0),
        corners,
        np.roll(corners, -1, axis=0),
        corner_radii,
        strict=True,
    ):
        u, v = before - corner, after - corner
        length_u, length_v = np.linalg.norm(u), np.linalg.norm(v)
        u, v = u / length_u, v / length_v
        half = 0.5 * np.arccos(np.clip(u @ v, -1.0, 1.0))
        # Leave a short piece of each edge, so that neighbouring arcs share no point.
        setback = min(radius / np.tan(half), 0.49 * length_u, 0.49 * length_v)
        if setback < 1e-6 or half > 0.5 * np.pi - 1e-3:
            result.append(corner)
            continue
        bisector = (u + v) / np.linalg.norm(u + v)
        radius = setback * np.tan(half)
        center = corner + bisector * radius / np.sin(half)
        start, end = corner + setback * u - center, corner + setback * v - center
        sweep = np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end)
        for t in np.linspace(0.0, sweep, segments + 1):
            c, s = np.cos(t), np.sin(t)
            result.append(
                center + np.array([c * start[0] - s * start[1], s * start[0] + c * start[1]])
            )
    return np.array(result)


def rounded_rectangle(width: float, height: float, radius: float, segments: int = 4) -> np.ndarray:
    """Returns a rectangle (n, 2) about the origin with arcs as corners; n = 4 (segments + 1)."""
    x, y = width / 2, height / 2
    radius = min(radius, 0.98 * min(x, y))
    return fillet([(-x, -y), (x, -y), (x, y), (-x, y)], radius, segments)


def ribbon(path: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Returns the outline (2n, 2) of a band around a path (n, 2) with given widths (n)."""
    tangent = np.gradient(path, axis=0)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normal *= 0.5 * np.asarray(widths)[:, None] / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.vstack([path - normal, (path + normal)[::-1]])


def blend(profile: CrossSection, inner_radius: float, outer_radius: float = 0.0) -> CrossSection:
    """Rounds a profile's concave corners to `inner_radius`, its convex ones to `outer_radius`."""
    for radius in (inner_radius, -outer_radius):
        profile = profile.offset(radius, JoinType.Round, circular_segments=SEGMENTS)
        profile = profile.offset(-radius, JoinType.Round, circular_segments=SEGMENTS)
    return profile.simplify(0.02)


def without_holes(profile: CrossSection) -> CrossSection:
    """Fills the holes of a profile."""
    outer = [p for p in profile.to_polygons() if CrossSection([p]).area() > 0]
    return CrossSection(outer) if outer else profile


def _stitched(rings: np.ndarray, caps: tuple[np.ndarray, np.ndarray]) -> Manifold:
    """Makes a solid: joins m loops of n points each by quads, and closes the ends by caps.

    Args:
        rings: the loops (m, n, 3).
        caps: the triangles (k, 3) of the first and the last loop, as indices of its points.
    """
    count, size = rings.shape[:2]
    i = np.arange(size)
    j = (i + 1) % size
    walls = [
        np.concatenate(
            [
                np.column_stack([k + i, k + j, k + size + j]),
                np.column_stack([k + i, k + size + j, k + size + i]),
            ]
        )
        for k in size * np.arange(count - 1)
    ]
    faces = np.vstack([caps[0][:, ::-1], *walls, caps[1] + size * (count - 1)])
    return _closed_solid(rings.reshape(-1, 3), faces)


def _closed_solid(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    """Makes the solid of a closed mesh; flips all faces if they point inward."""
    solid = Manifold(manifold3d.Mesh64(np.ascontiguousarray(vertices), faces.astype(np.uint64)))
    if solid.status() != manifold3d.Error.NoError:
        raise ValueError(f"the mesh is not manifold: {solid.status()}")
    return solid if solid.volume() > 0 else _closed_solid(vertices, faces[:, ::-1])


def plate(
    profile: CrossSection | np.ndarray,
    z_low: float,
    z_high: float,
    bevel: float = 0.8,
    cells: Sequence[CrossSection] = (),
) -> Shape:
    """Makes a plate between two heights, with its outer edges bevelled at 45 degrees.

    Holes are not bevelled, and the hulls cover them. There is one hull for the part of the profile
    in each of `cells`. Without cells, there is one for each triangle of a triangulation.
    """
    if isinstance(profile, np.ndarray):
        profile = CrossSection([profile])
    filled = without_holes(profile).simplify(0.01)
    solid = _bevelled(filled, z_low, z_high, bevel)
    holes = filled - profile
    if not holes.is_empty():
        solid -= holes.extrude(z_high - z_low + 2).translate((0, 0, z_low - 1))
    return Shape(solid, _plate_hulls(filled, z_low, z_high, bevel, cells))


def _bevelled(profile: CrossSection, z_low: float, z_high: float, bevel: float) -> Manifold:
    """Makes the solid of a bevelled plate.

    The profile, inset by the bevel, may have other vertices or loops than the profile itself. So
    the strip between the two is triangulated in the plane and then lifted.
    """
    outer = profile.to_polygons()
    inner = profile.offset(-bevel, JoinType.Miter).to_polygons()
    rim, top = np.vstack(outer), np.vstack(inner)
    strip = manifold3d.triangulate([*outer, *(loop[::-1] for loop in inner)])
    # The strip's inner loops are reversed. Give their vertices the numbers that they have in `top`.
    numbers = np.arange(len(top))
    starts = np.cumsum([len(loop) for loop in inner])[:-1]
    backward = np.concatenate([n[::-1] for n in np.split(numbers, starts)])
    strip = np.concatenate([np.arange(len(rim)), len(rim) + backward])[strip]
    cap = len(rim) + manifold3d.triangulate(inner)
    upper = np.vstack([strip, cap])
    count = len(rim) + len(top)
    walls, first = [], 0
    for loop in outer:
        i = first + np.arange(len(loop))
        j = first + (np.arange(len(loop)) + 1) % len(loop)
        walls += [np.column_stack([i, j, count + j]), np.column_stack([i, count + j, count + i])]
        first += len(loop)
    heights = ((z_low + bevel, z_low), (z_high - bevel, z_high))
    vertices = np.vstack(
        [
            np.column_stack([points, np.full(len(points), z)])
            for level in heights
            for points, z in zip((rim, top), level, strict=True)
        ]
    )
    return _closed_solid(vertices, np.vstack([upper[:, ::-1], *walls, count + upper]))


def _plate_hulls(
    profile: CrossSection,
    z_low: float,
    z_high: float,
    bevel: float,
    cells: Sequence[CrossSection],
) -> list[np.ndarray]:
    """Makes prisms over the cells of a plate's profile, or over its triangles if it has no cells.
    The prisms' lower edges are bevelled."""
    coarse = profile.simplify(0.08)
    loops = coarse.to_polygons()
    points = np.vstack(loops)
    # Leave out the upper bevel: nothing slides over it, and each vertex slows down the contact.
    levels = [(z_low, bevel), (z_low + bevel, 0.0), (z_high, 0.0)]
    insets = {
        inset: coarse.offset(-inset, JoinType.Miter, circular_segments=SEGMENTS)
        for _, inset in levels
    }
    hulls = []
    for piece in cells or [CrossSection([points[t]]) for t in manifold3d.triangulate(loops)]:
        rings = [
            np.column_stack([p, np.full(len(p), z)])
            for z, inset in levels
            for p in (piece ^ insets[inset]).to_polygons()
        ]
        if rings:
            hulls.append(np.vstack(rings))
    return hulls


def loft(sections: Sequence[np.ndarray]) -> Shape:
    """Makes a solid whose surface passes through cross-sections (n, 3), all with the same n.

    Each section must be star-shaped about its mean. There is one hull for each pair of neighbouring
    sections.
    """
    rings = np.asarray(sections, dtype=float)
    caps = tuple(manifold3d.triangulate([_planar(ring)]) for ring in (rings[0], rings[-1]))
    return Shape(_stitched(rings, caps), [np.vstack(pair) for pair in itertools.pairwise(rings)])


def _planar(ring: np.ndarray) -> np.ndarray:
    """Converts a flat ring (n, 3) to coordinates (n, 2) in its own plane, counter-clockwise."""
    centered = ring - ring.mean(axis=0)
    u = centered[0] / np.linalg.norm(centered[0])
    normal = np.sum(np.cross(centered, np.roll(centered, -1, axis=0)), axis=0)
    normal /= np.linalg.norm(normal)
    return np.ascontiguousarray(np.column_stack([centered @ u, centered @ np.cross(normal, u)]))


def across_x(profile: np.ndarray, x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """Returns a section (n, 3) of a loft along x, with the profile's axes along y and z."""
    return np.column_stack([np.full(len(profile), x), profile[:, 0] + y, profile[:, 1] + z])


def across_path(profile: np.ndarray, point: ArrayLike, angle: float) -> np.ndarray:
    """Returns a section (n, 3) of a loft along a path in the xy plane.

    At the section, the path passes through `point` (2,) in the direction `angle` (rad) from +x.
    """
    left = np.array([-np.sin(angle), np.cos(angle)])
    xy = np.asarray(point) + profile[:, :1] * left
    return np.column_stack([xy, profile[:, 1]])
