"""Approximate convex decomposition of any solid for collision. Lengths are in mm.

Hydroelastic contact costs time per hull and per facet, so both are limited. First, convex polygons
cover the outline as seen from above (`convex_cover`), because the outline decides whether the tool
enters its cavity. The parts of the solid over the polygons are then cut where their hulls add much
volume. All vertices of a hull are points of the solid, so the tool rests on a table as the solid
does.
"""

from dataclasses import dataclass

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold
from scipy.spatial import QhullError

from kitting_drake.hkd.generation.generate import FINGER_LENGTH_MM
from kitting_drake.hkd.importing.convex_cover import convex_cover
from kitting_drake.hkd.tools.collision import closed, furthest, projection, thinned
from kitting_drake.hkd.tools.solids import SEGMENTS
from systems.grasp import Grasp

MOST_HULLS = 16
"""The largest number of hulls of a tool. It is exceeded only if the outline needs more hulls at the
coarsest of `OUTLINE_TOLERANCES_MM`."""
OUTLINE_TOLERANCES_MM = ((0.26, 0.12), (0.30, 0.2), (0.4, 0.2), (0.6, 0.3), (0.9, 0.3))
"""Pairs of tolerances: how far the hulls may deviate from the outline, and from the gripped faces.
If a pair needs too many hulls, the next pair is tried. Thinning the vertices may add to the
deviations."""
ADDED_SHARE = 0.05
"""A part is cut in two if its hull adds more than this share of the tool's volume."""
# The vertices of a hull are thinned with the first tolerance that leaves at most `_MOST_VERTICES`.
# If none does, the last tolerance is used. The outline has its own tolerance.
_MOST_VERTICES = 20
_VERTEX_TOLERANCES_MM = (0.2, 0.3, 0.45, 0.6)
_OUTLINE_VERTEX_TOLERANCE_MM = 0.08
# Hulls may bridge notches up to twice this wide, because cavities bridge them, too.
_NOTCH_MM = 2.0
# Parts with a smaller volume (mm^3) are dropped.
_SMALLEST_VOLUME = 0.5


@dataclass(frozen=True)
class Decomposition:
    """Convex hulls that approximate a solid."""

    hulls: list[np.ndarray]
    """The vertices (n, 3) of each hull, in mm."""
    outline_deviation_mm: float
    """The largest distance between the hulls' outline and the solid's, seen from above, in mm.

    Notches narrower than 4 mm are ignored, and distances above 5 mm count as 5. Infinity if there
    are no hulls.
    """


def decompose(solid: Manifold, grasp: Grasp) -> Decomposition:
    """Decomposes a tool into few convex hulls with few facets.

    Args:
        solid: the tool at rest in its frame T, in mm.
        grasp: a grasp in T. The hulls follow the gripped faces more closely than other faces.
    """
    solid = solid.simplify(0.03)
    outline = closed(solid.project().simplify(0.02), _NOTCH_MM).simplify(0.02)
    jaws = CrossSection.square((FINGER_LENGTH_MM + 2.0, 100.0), True)
    jaws = jaws.rotate(float(np.degrees(grasp.theta))).translate((1e3 * grasp.x, 1e3 * grasp.y))
    polygons: list[CrossSection] = []
    for tolerance, grip in OUTLINE_TOLERANCES_MM:
        inner = _grown(outline, -tolerance) + (_grown(outline, -grip) ^ jaws)
        outer = _grown(outline, tolerance) - (jaws - _grown(outline, grip))
        polygons = convex_cover(inner, outer, outline)
        if len(polygons) <= MOST_HULLS:
            break
    parts = _split_by_height([_within(solid, polygon) for polygon in polygons])
    hulls = []
    for part in parts:
        try:
            hulls.append(_thinned(np.asarray(part.hull().to_mesh64().vert_properties)[:, :3]))
        except QhullError:
            # Rounding may leave a part without volume.
            continue
    hulls.sort(key=lambda hull: tuple(np.round(hull.mean(axis=0), 3)))
    return Decomposition(hulls, _deviation(hulls, outline))


def _deviation(hulls: list[np.ndarray], outline: CrossSection) -> float:
    if not hulls:
        return np.inf
    seen = projection(hulls)
    return max(furthest(seen, outline), furthest(outline, closed(seen, _NOTCH_MM)))


def _grown(profile: CrossSection, distance: float) -> CrossSection:
    return profile.offset(distance, JoinType.Round, circular_segments=SEGMENTS)


def _within(solid: Manifold, polygon: CrossSection) -> Manifold:
    low, high = np.array(solid.bounding_box()).reshape(2, 3)[:, 2]
    return solid ^ polygon.extrude(high - low + 2.0).translate((0.0, 0.0, low - 1.0))


def _split_by_height(parts: list[Manifold]) -> list[Manifold]:
    """Repeatedly cuts in two the part whose hull adds the most volume.

    Stops when no hull adds too much volume, or at `MOST_HULLS` parts.
    """
    parts = [part for part in parts if part.volume() >= _SMALLEST_VOLUME]
    most = ADDED_SHARE * sum(part.volume() for part in parts)
    added = [_added_volume(part) for part in parts]
    while len(parts) < MOST_HULLS and max(added, default=0.0) > most:
        worst = int(np.argmax(added))
        halves = [half for half in _halves(parts.pop(worst)) if half.volume() >= _SMALLEST_VOLUME]
        added.pop(worst)
        parts += halves
        added += [_added_volume(half) for half in halves]
    return parts


def _added_volume(part: Manifold) -> float:
    return float(part.hull().volume() - part.volume())


def _thinned(points: np.ndarray) -> np.ndarray:
    result = points
    for tolerance in _VERTEX_TOLERANCES_MM:
        result = thinned(points, tolerance, _OUTLINE_VERTEX_TOLERANCE_MM)
        if len(result) <= _MOST_VERTICES:
            break
    return result


def _halves(part: Manifold) -> tuple[Manifold, Manifold]:
    """Cuts a part by an axis-aligned plane so that the hulls of the halves have the least
    volume."""
    low, high = np.array(part.bounding_box()).reshape(2, 3)
    size = high - low
    vertices = np.asarray(part.to_mesh64().vert_properties)[:, :3]
    best, best_volume = None, np.inf
    for axis in range(3):
        if size[axis] < max(1.0, 0.25 * size.max()):
            continue
        for share in (0.35, 0.5, 0.65, *_steps((vertices[:, axis] - low[axis]) / size[axis])):
            normal = np.eye(3)[axis]
            halves = part.split_by_plane(tuple(normal), low[axis] + share * size[axis])
            volume = sum(half.hull().volume() for half in halves)
            # Among equally good cuts, prefer the one nearest to the middle.
            volume *= 1.0 + 0.02 * abs(share - 0.5)
            if volume < best_volume:
                best, best_volume = halves, volume
    assert best is not None
    return best


def _steps(shares: np.ndarray) -> list[float]:
    """Returns the positions with many vertices, such as a shoulder or a jaw's end.

    Args:
        shares: the positions (n) of the vertices along an axis, from 0 to 1.
    """
    within = shares[(shares > 0.08) & (shares < 0.92)]
    values, counts = np.unique(np.round(within, 3), return_counts=True)
    order = np.argsort(-counts, kind="stable")[:3]
    many = max(4, len(shares) // 50)
    # The values are rounded. For each one, return the median of the exact positions near it.
    return [
        float(np.median(within[np.abs(within - values[i]) <= 6e-4]))
        for i in order
        if counts[i] >= many
    ]
