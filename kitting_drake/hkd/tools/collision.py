"""Merges many small convex hulls that fill a solid into few collision hulls.

Lengths are in mm. A hull is given as points (n, 3), which stand for their convex hull. Merging must
hardly change the projections of the tool: the xy outline decides whether the tool fits its cavity,
and the xz and yz profiles decide how it rests.
"""

import itertools
from collections.abc import Sequence

import manifold3d
import numpy as np
from manifold3d import CrossSection, JoinType, Manifold
from scipy.spatial import ConvexHull

from kitting_drake.hkd.tools.solids import SEGMENTS

# The grid spacing of the vertices of collision hulls.
GRID_MM = 0.05

_XY, _XZ, _YZ = [0, 1], [0, 2], [1, 2]
# A first pass merges hulls whose projections change by less than this. It saves time, because
# growing each hull is slow.
_EXACT_MM = 0.03
# A region counts as inside another one if at most this area (mm^2) of it lies outside.
_AREA = 1e-4


def projection(hulls: Sequence[np.ndarray], plane: Sequence[int] = _XY) -> CrossSection:
    """Returns the projection of a union of convex hulls onto a coordinate plane."""
    return CrossSection.batch_boolean(
        [CrossSection.hull_points(np.ascontiguousarray(h[:, plane])) for h in hulls],
        manifold3d.OpType.Add,
    )


def closed(profile: CrossSection, clearance: float) -> CrossSection:
    """Fills the holes of a profile, and closes its gaps that are narrower than twice the
    clearance."""

    def outer(p: CrossSection) -> CrossSection:
        return CrossSection([loop for loop in p.to_polygons() if CrossSection([loop]).area() > 0])

    grown = outer(profile.offset(clearance, JoinType.Round, circular_segments=4 * SEGMENTS))
    return grown.offset(-clearance, JoinType.Round, circular_segments=4 * SEGMENTS)


def furthest(
    inner: CrossSection, outer: CrossSection, precision: float = 0.01, area: float = _AREA
) -> float:
    """Returns the largest distance of a point of `inner` from `outer`, in mm, but at most 5.

    Args:
        inner, outer: two regions, in mm.
        precision: the precision of the distance, in mm.
        area: parts of `inner` with less than this area in total, in mm^2, may lie farther away.
    """
    low, high = 0.0, 5.0
    while high - low > precision:
        middle = 0.5 * (low + high)
        grown = outer.offset(middle, JoinType.Round, circular_segments=96)
        low, high = (low, middle) if (inner - grown).area() < area else (middle, high)
    return high


def thinned(
    points: np.ndarray,
    tolerance: float,
    outline_tolerance: float | None = None,
    grid: float = GRID_MM,
) -> np.ndarray:
    """Selects few vertices (m, 3) whose hull is within about `tolerance` of the hull of `points`.

    Points on the table are selected first, so that a flat bottom stays flat. The result is rounded
    to a grid: two facets are then either exactly in one plane or clearly not.

    Args:
        points: the points (n, 3), in mm.
        tolerance: the largest distance between the hulls, in mm.
        outline_tolerance: the tolerance for the outline from above, in mm; `tolerance` if None.
        grid: the spacing of the grid in mm.
    """
    points = points[ConvexHull(points).vertices]
    touching = np.flatnonzero(points[:, 2] < 1e-3)
    seeds: list[int] = []
    if len(touching) > 2:
        seeds = list(touching[_farthest(points[touching, :2], [], tolerance)])
    if outline_tolerance is not None:
        seeds = _farthest(points[:, :2], seeds, outline_tolerance)
    chosen = points[_farthest(points, seeds, tolerance)]
    snapped = np.round(np.round(chosen / grid) * grid, 3) + 0.0
    return np.unique(snapped[ConvexHull(snapped).vertices], axis=0)


def _farthest(points: np.ndarray, chosen: list[int], tolerance: float) -> list[int]:
    """Adds the farthest points to `chosen` until all points are within the tolerance of the hull.

    Returns:
        The indices of the chosen points, sorted.
    """
    dimension = points.shape[1]
    directions = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * dimension)).reshape(dimension, -1).T
    chosen = list(dict.fromkeys([*chosen, *np.argmax(points @ directions.T, axis=0)]))
    if len(chosen) <= dimension:
        # Keep all points if they are too few to span a hull.
        return list(range(len(points)))
    while True:
        equations = ConvexHull(points[chosen], qhull_options="QJ Pp").equations
        distance = (points @ equations[:, :-1].T + equations[:, -1]).max(axis=1)
        farthest = int(np.argmax(distance))
        if distance[farthest] <= tolerance or farthest in chosen:
            return sorted(chosen)
        chosen.append(farthest)


class _Hull:
    """A convex hull with its volume, its bounding box, and the hulls from which it was merged."""

    def __init__(self, points: np.ndarray, sources: list[np.ndarray] | None = None):
        hull = Manifold.hull_points(np.ascontiguousarray(points))
        self.points = np.asarray(hull.to_mesh64().vert_properties)[:, :3]
        self.sources = sources or [points]
        self.volume = hull.volume()
        self.low, self.high = points.min(axis=0), points.max(axis=0)

    def touches(self, other: "_Hull", gap: float) -> bool:
        return bool(np.all(self.low <= other.high + gap) and np.all(other.low <= self.high + gap))

    def joined(self, other: "_Hull") -> "_Hull":
        return _Hull(np.vstack([self.points, other.points]), self.sources + other.sources)


def _grown(profile: CrossSection, distance: float) -> CrossSection:
    return profile.offset(distance, JoinType.Round, circular_segments=SEGMENTS)


def _fits(hull: _Hull, allowed: CrossSection, tolerance: float) -> bool:
    """Whether a merged hull may replace the hulls from which it was merged.

    The hull's xy projection must stay within `allowed`. Its other two projections may extend beyond
    those of its sources by at most `tolerance` (mm).
    """
    if (projection([hull.points]) - allowed).area() > _AREA:
        return False
    return all(
        (
            projection([hull.points], plane) - _grown(projection(hull.sources, plane), tolerance)
        ).area()
        <= _AREA
        for plane in (_XZ, _YZ)
    )


def _merged(hulls: list[_Hull], allowed: CrossSection, tolerance: float) -> list[_Hull]:
    """Merges hulls as long as `_fits` allows it. Each step merges the pair that adds the least
    volume."""
    alive = dict(enumerate(hulls))

    def options(a: int, b: int) -> list[tuple[float, int, int]]:
        if not alive[a].touches(alive[b], tolerance):
            return []
        joined = alive[a].joined(alive[b])
        added = joined.volume - alive[a].volume - alive[b].volume
        return [(round(added, 3), a, b)] if _fits(joined, allowed, tolerance) else []

    pairs = [option for a in alive for b in alive if a < b for option in options(a, b)]
    while pairs:
        _, a, b = min(pairs)
        new = max(alive) + 1
        alive[new] = alive.pop(a).joined(alive.pop(b))
        pairs = [pair for pair in pairs if not {a, b} & set(pair[1:])]
        pairs += [option for c in alive if c != new for option in options(c, new)]
    return list(alive.values())


def cover(
    hulls: Sequence[np.ndarray], outline: CrossSection, allowed: CrossSection, tolerance: float
) -> list[np.ndarray]:
    """Covers `hulls` with few convex hulls, which may overlap. The result is deterministic.

    First, hulls are merged if the merged hull hardly sticks out of `outline`. Then a hull is grown
    from each of them: it is repeatedly merged with the neighbour that adds the least volume. The
    grown hull's xy projection must stay within `allowed`; its other projections may grow by at most
    `tolerance` (mm). The grown hull that covers the most uncovered volume is selected, until all of
    `hulls` are covered. Finally, hulls that hardly change any projection are dropped.
    """
    merged = _merged([_Hull(h) for h in hulls], _grown(outline, _EXACT_MM), _EXACT_MM)
    grown = [_grow(seed, merged, allowed, tolerance) for seed in range(len(merged))]
    open_hulls, result = set(range(len(merged))), []
    while open_hulls:
        gains = [
            round(sum(merged[i].volume for i in members & open_hulls), 3) for _, members in grown
        ]
        _, members = grown[int(np.argmax(gains))]
        # Make the hull of the uncovered members only, because earlier hulls cover the rest.
        wanted = np.vstack([merged[i].points for i in sorted(members & open_hulls)])
        result.append(wanted)
        open_hulls -= members
    return _pruned(result, 0.5 * tolerance)


def runs(
    sections: Sequence[np.ndarray], tolerance: float, height_tolerance: float
) -> list[np.ndarray]:
    """Merges the sections of a loft into few long hulls.

    Neighbouring sections are merged as long as the projections grow little. The xy projection has
    the smaller tolerance, because it decides whether the tool fits its cavity.

    Args:
        sections: the points (n, 3) of each section, in mm.
        tolerance: the largest growth of the xy projection, in mm.
        height_tolerance: the largest growth of the other two projections, in mm.
    """
    pairs = [np.vstack(pair) for pair in itertools.pairwise(sections)]
    result, first = [], 0
    for last in range(1, len(pairs) + 1):
        if last < len(pairs):
            trial = np.vstack(pairs[first : last + 1])
            if all(
                (
                    projection([trial], plane)
                    - _grown(projection(pairs[first : last + 1], plane), limit)
                ).area()
                <= _AREA
                for plane, limit in (
                    (_XY, tolerance),
                    (_XZ, height_tolerance),
                    (_YZ, height_tolerance),
                )
            ):
                continue
        result.append(np.vstack(pairs[first:last]))
        first = last
    return result


def _pruned(hulls: list[np.ndarray], tolerance: float) -> list[np.ndarray]:
    """Drops hulls, smallest first. The projections of their union shrink by at most `tolerance`."""
    wholes = [projection(hulls, plane) for plane in (_XY, _XZ, _YZ)]
    kept = list(hulls)
    for hull in sorted(hulls, key=lambda h: Manifold.hull_points(h).volume()):
        rest = [h for h in kept if h is not hull]
        if rest and all(
            (whole - _grown(projection(rest, plane), tolerance)).area() <= _AREA
            for whole, plane in zip(wholes, (_XY, _XZ, _YZ), strict=True)
        ):
            kept = rest
    return kept


def _grow(
    seed: int, hulls: list[_Hull], allowed: CrossSection, tolerance: float
) -> tuple[np.ndarray, set[int]]:
    """Grows the largest allowed hull from a seed; returns its points and the indices of the hulls
    merged into it."""
    current, members = hulls[seed], {seed}
    candidates = set(range(len(hulls))) - members
    while True:
        near = [i for i in sorted(candidates) if current.touches(hulls[i], tolerance)]
        trials = sorted(
            (current.joined(hulls[i]).volume - current.volume - hulls[i].volume, i) for i in near
        )
        for _, i in trials:
            # The hull only grows, so a neighbour that does not fit at this step never will.
            candidates.discard(i)
            joined = current.joined(hulls[i])
            if _fits(joined, allowed, tolerance):
                current = joined
                members.add(i)
                break
        else:
            return current.points, members
