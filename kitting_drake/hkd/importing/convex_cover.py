"""Covers an outline, within a tolerance, with a few convex polygons. Lengths in mm."""

import numpy as np
from manifold3d import CrossSection, OpType
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A region counts as inside another one if at most this area (mm^2) of it lies outside.
_AREA = 0.02
# The number of corners through which to try a cut, and the number of angles at each corner.
_CORNERS, _ANGLES = 6, 8
_FAR = 1e3
# Cells smaller than `_SMALLEST_MM` are not cut again. Cutting stops at `_MOST_CELLS` cells.
_SMALLEST_MM, _MOST_CELLS = 1.0, 150
# The steps by which the edges of the final polygons are moved outward, in this order.
_PUSHES_MM = (0.8, 0.4, 0.2, 0.1)


def convex_cover(
    inner: CrossSection, outer: CrossSection, outline: CrossSection
) -> list[CrossSection]:
    """Covers the region `inner` with convex polygons that stay within `outer`.

    The inner region is cut into cells whose hulls are within the outer region. Larger hulls are
    grown from the cells, and those that cover most are selected. Finally the edges of the polygons
    are moved to match `outline` as closely as possible. The result is deterministic.

    Args:
        inner: the region to cover; it may have holes.
        outer: the allowed region; it contains `inner`.
        outline: the preferred region; it contains `inner` and lies within `outer`.
    """
    cells = _cells(inner, outer)
    grown = [_grown(seed, cells, outer) for seed in range(len(cells))]
    areas = [cell.area() for cell in cells]
    still_open, chosen = set(range(len(cells))), []
    while still_open:
        gains = [round(sum(areas[i] for i in cover & still_open), 3) for cover in grown]
        cover = grown[int(np.argmax(gains))] & still_open
        chosen.append(_hull([cells[i] for i in sorted(cover)]))
        still_open -= cover
    pushed = [_pushed(polygon, outline, outer) for polygon in chosen]
    return _needed(pushed, inner)


def _hull(profiles: list[CrossSection]) -> CrossSection:
    return CrossSection.batch_hull(profiles)


def _fits(profile: CrossSection, outer: CrossSection) -> bool:
    return bool((profile - outer).area() <= _AREA)


def _cells(inner: CrossSection, outer: CrossSection) -> list[CrossSection]:
    """Cuts the region `inner` into parts whose hulls are within `outer`."""
    done: list[CrossSection] = []
    waiting = inner.decompose()
    while waiting:
        part = waiting.pop()
        if part.area() <= _AREA:
            continue
        small = np.ptp(_corners(part), axis=0).max() < _SMALLEST_MM
        if small or len(done) + len(waiting) > _MOST_CELLS or _fits(part.hull(), outer):
            done.append(part)
        else:
            waiting += _best_cut(part, outer)
    return done


def _corners(profile: CrossSection) -> Array:
    return np.vstack(profile.to_polygons())


def _best_cut(part: CrossSection, outer: CrossSection) -> list[CrossSection]:
    """Cuts a part so that the hulls of its pieces have the least area outside `outer`."""
    best, least = [part.hull()], np.inf
    for point in _cut_points(part):
        for angle in np.arange(_ANGLES) * 180.0 / _ANGLES:
            half = CrossSection.square((_FAR, _FAR)).translate((-_FAR / 2, 0.0)).rotate(angle)
            half = half.translate(tuple(point))
            pieces = [p for side in (part ^ half, part - half) for p in side.decompose()]
            hulls = [piece.hull() for piece in pieces]
            excess = sum((hull - outer).area() for hull in hulls)
            if len(pieces) > 1 and excess < least:
                best, least = pieces, excess
    return best


def _cut_points(part: CrossSection) -> list[Array]:
    """Returns the points (2,) through which to try cuts of a part.

    These are the centre of its bounding box, and the corners that lie deepest inside its hull.
    Corners that are close to a chosen corner are skipped.
    """
    corners = _corners(part)
    hull = _corners(part.hull())
    edges = np.roll(hull, -1, axis=0) - hull
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depth = ((hull * normals).sum(axis=1) - corners @ normals.T).min(axis=1)
    spacing = 0.1 * np.ptp(corners, axis=0).max()
    # Try the centre first. Many cuts of an arc-shaped part are equally good, and a cut in the
    # middle then gives the fewest cells.
    chosen = [0.5 * (corners.min(axis=0) + corners.max(axis=0))]
    for index in np.argsort(-depth, kind="stable"):
        if all(np.linalg.norm(corners[index] - other) > spacing for other in chosen[1:]):
            chosen.append(corners[index])
            if len(chosen) > _CORNERS:
                break
    return chosen


def _grown(seed: int, cells: list[CrossSection], outer: CrossSection) -> set[int]:
    """Grows a hull within `outer` from the cell `seed` and returns the indices of its cells.

    Each step adds the cell for which the new hull covers the least area outside both the old hull
    and the cell.
    """
    hull, members, candidates = cells[seed].hull(), {seed}, set(range(len(cells))) - {seed}
    while True:
        trials = []
        for i in sorted(candidates):
            joined = _hull([hull, cells[i]])
            trials.append((joined.area() - hull.area() - (cells[i] - hull).area(), i, joined))
        for _, i, joined in sorted(trials, key=lambda trial: trial[:2]):
            # The hull only grows, so a cell that does not fit at this step never will.
            candidates.discard(i)
            if _fits(joined, outer):
                hull = joined
                members.add(i)
                break
        else:
            return members


def _pushed(polygon: CrossSection, outline: CrossSection, outer: CrossSection) -> CrossSection:
    """Moves edges of a polygon outward where this makes it match the outline better."""
    corners = _corners(polygon.simplify(0.05))
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = (corners * normals).sum(axis=1)

    def score(candidate: CrossSection) -> float:
        """Returns the candidate's area inside the outline minus its area outside."""
        return float(2 * (candidate ^ outline).area() - candidate.area())

    best, best_score = polygon, score(polygon)
    for push in _PUSHES_MM:
        for k in np.argsort(-np.linalg.norm(edges, axis=1), kind="stable"):
            trial = offsets.copy()
            trial[k] += push
            hull = _hull([polygon, (_between(normals, trial) ^ outline)])
            if score(hull) > best_score and _fits(hull, outer):
                best, best_score, offsets = hull, score(hull), trial
    return best


def _between(normals: Array, offsets: Array) -> CrossSection:
    """Returns the region of the points p (2,) with normals @ p <= offsets."""
    result = CrossSection.square((_FAR, _FAR), True)
    for (x, y), offset in zip(normals, offsets, strict=True):
        half = CrossSection.square((_FAR, 2 * _FAR)).translate((offset, -_FAR))
        result -= half.rotate(float(np.degrees(np.arctan2(y, x))))
    return result


def _needed(polygons: list[CrossSection], inner: CrossSection) -> list[CrossSection]:
    """Drops polygons, the smallest first, as long as the others still cover `inner`."""
    kept = list(polygons)
    for polygon in sorted(polygons, key=CrossSection.area):
        rest = [other for other in kept if other is not polygon]
        if rest and (inner - CrossSection.batch_boolean(rest, OpType.Add)).area() <= _AREA:
            kept = rest
    return kept
