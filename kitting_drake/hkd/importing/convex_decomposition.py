"""Approximate convex decomposition of a solid of any shape, for collision.

The solid is cut in two, again and again, until the hull of every part is true to it; then
`collision.cover` joins the hulls that can be joined. Lengths in mm.
"""

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold
from scipy.spatial import QhullError

from kitting_drake.hkd.tools.collision import closed, cover, thinned
from kitting_drake.hkd.tools.generate import FINGER_LENGTH_MM
from kitting_drake.hkd.tools.solids import SEGMENTS
from systems.grasp import Grasp

# How far a hull may stand out of the tool's outline; the second, if the first needs many hulls.
OUTLINE_TOLERANCES_MM = (0.30, 0.45)
_ENOUGH = 30
# The same for the faces that the jaws grip.
GRIP_TOLERANCE_MM = 0.12
# How much a part's hull may add to it above and below, on average over its outline.
HEIGHT_TOLERANCE_MM = 0.5
# Notches narrower than twice this are no part of a cavity: they may be bridged.
_NOTCH_MM = 2.0
_VERTEX_TOLERANCE_MM = 0.2
_SMALLEST_MM, _SMALLEST_VOLUME = 2.5, 0.5
_MOST_PARTS = 400
_AREA = 0.02


def decompose(solid: Manifold, grasp: Grasp) -> list[np.ndarray]:
    """Arrays (n, 3) of points whose hulls together fill a tool at rest in its frame T."""
    hulls: list[np.ndarray] = []
    for tolerance in OUTLINE_TOLERANCES_MM:
        hulls = _decomposed(solid, grasp, tolerance)
        if len(hulls) <= _ENOUGH:
            break
    return hulls


def _decomposed(solid: Manifold, grasp: Grasp, tolerance: float) -> list[np.ndarray]:
    outline = closed(solid.project().simplify(0.02), _NOTCH_MM)
    grown = _grown(outline, tolerance)
    jaws = CrossSection.square((FINGER_LENGTH_MM + 2.0, 100.0), True)
    jaws = jaws.rotate(float(np.degrees(grasp.theta))).translate((1e3 * grasp.x, 1e3 * grasp.y))
    allowed = grown - (jaws - _grown(outline, GRIP_TOLERANCE_MM))
    parts = [_vertices(part) for part in _parts(solid.simplify(0.03), allowed)]
    hulls = []
    for hull in cover(parts, outline, allowed, tolerance):
        try:
            hulls.append(thinned(hull, _VERTEX_TOLERANCE_MM))
        except QhullError:
            # A sliver that has no volume on the grid of vertices.
            continue
    return sorted(hulls, key=lambda hull: tuple(np.round(hull.mean(axis=0), 3)))


def _grown(profile: CrossSection, distance: float) -> CrossSection:
    return profile.offset(distance, JoinType.Round, circular_segments=SEGMENTS)


def _vertices(solid: Manifold) -> np.ndarray:
    return np.asarray(solid.hull().to_mesh64().vert_properties)[:, :3]


def _parts(solid: Manifold, allowed: CrossSection) -> list[Manifold]:
    """Parts of a solid whose hulls stay within `allowed`, seen from above, and near its heights."""
    done: list[Manifold] = []
    waiting = solid.decompose()
    while waiting:
        part = waiting.pop()
        if part.volume() < _SMALLEST_VOLUME:
            continue
        if len(done) + len(waiting) > _MOST_PARTS or _is_near_its_hull(part, allowed):
            done.append(part)
            continue
        waiting += [body for half in _halves(part) for body in half.decompose()]
    return done


def _is_near_its_hull(part: Manifold, allowed: CrossSection) -> bool:
    low, high = np.array(part.bounding_box()).reshape(2, 3)
    if (high - low)[:2].max() <= _SMALLEST_MM:
        return True
    hull = part.hull()
    footprint = hull.project()
    if (footprint - allowed).area() > _AREA:
        return False
    return bool(hull.volume() - part.volume() <= HEIGHT_TOLERANCE_MM * footprint.area())


def _halves(part: Manifold) -> tuple[Manifold, Manifold]:
    """The part cut in two by the plane that leaves the least that is not solid in the hulls."""
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
            volume = sum(body.hull().volume() for half in halves for body in half.decompose())
            # Among equal cuts the middle one, which leaves the smallest parts.
            volume *= 1.0 + 0.02 * abs(share - 0.5)
            if volume < best_volume:
                best, best_volume = halves, volume
    assert best is not None
    return best


def _steps(shares: np.ndarray) -> list[float]:
    """Places, from 0 to 1, of planes with many vertices: of a shoulder, or of a jaw's end."""
    within = shares[(shares > 0.08) & (shares < 0.92)]
    values, counts = np.unique(np.round(within, 3), return_counts=True)
    order = np.argsort(-counts, kind="stable")[:3]
    many = max(4, len(shares) // 50)
    # The middle of the vertices themselves, not the rounded place.
    return [
        float(np.median(within[np.abs(within - values[i]) <= 6e-4]))
        for i in order
        if counts[i] >= many
    ]
