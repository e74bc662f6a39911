"""Collision hulls that follow a tool's outline closely, for cavities with little clearance.

Lengths are in mm. Convex cells cover the outline from above. Each hull encloses the part of the
solid over one cell, or a horizontal slice of this part. Apart from rounding, hulls stick out beyond
the outline only where cells bridge notches.
"""

from collections.abc import Sequence

import numpy as np
from manifold3d import CrossSection, Error, JoinType, Manifold, Mesh64, OpType, triangulate
from numpy.typing import NDArray

from kitting_drake.hkd.tools.collision import furthest, projection, thinned

Array = NDArray[np.float64]

INSIDE_MM = 0.04
"""How far the hulls' outline may lie inside the true outline, in mm."""
NOTCH_MM = 3.0
"""Half the width of the widest notches that hulls may bridge, in mm. Cavities bridge them too."""
_HEIGHT_MM = 0.2
"""The tolerance in mm for thinning a hull's vertices. The outline has a finer tolerance."""
_AREA = 2e-3
"""A region counts as inside another one if at most this area (mm^2) of it lies outside."""
# A piece is cut at a height if the cut makes its hull smaller by more than the share `_SHARE` and
# by more than `_VOLUME` (mm^3). `_LEVELS` is the number of heights to try, `_MOST_CUTS` the largest
# number of cuts.
_SHARE, _VOLUME, _LEVELS, _MOST_CUTS = 0.08, 8.0, 9, 2
_TIP = 1.0
"""A cell can be extended to a tip of the outline if the tip is within this distance of the cell's
bounds, in mm."""
_THINNEST_MM = 0.6
"""The least height of a cut piece, in mm."""


def fine_hulls(
    parts: Sequence[Array], notch: float = NOTCH_MM, inside: float = INSIDE_MM
) -> list[Array]:
    """Makes convex hulls, as points (n, 3) in mm, that fill a solid. The result is deterministic.

    Args:
        parts: the closed surfaces of the solid's parts, as triangles (n, 3, 3) in mm.
        notch: half the width, in mm, of the widest notches and holes that hulls may bridge.
        inside: how far, in mm, the hulls' outline may lie inside the true outline. It may lie
            outside by at most half as much.

    Raises:
        ValueError: a surface is not closed.
    """
    solid = Manifold.batch_boolean([_solid(part) for part in parts], OpType.Add)
    outline = CrossSection(solid.project().to_polygons())
    # Drake refuses facets with areas below about 1e-10 m^2; the grid is coarse enough to avoid
    # them.
    grid = inside / 2
    # Three steps each use up a third of `inside`: the outline is moved inward, simplified, and
    # loses vertices.
    third = inside / 3
    inner = outline.offset(-third, JoinType.Round, circular_segments=64).simplify(third)
    outer = without_notches(outline, notch)
    low, high = solid.bounding_box()[2], solid.bounding_box()[5]
    hulls = []
    cells = _with_tips(convex_cells(inner, outer), outline, outer, third)
    for cell in cells:
        prism = cell.extrude(high - low + 2.0).translate((0.0, 0.0, low - 1.0))
        for piece in _cut_heights(solid ^ prism, _MOST_CUTS):
            points = np.asarray(piece.hull().to_mesh64().vert_properties)[:, :3]
            if len(points) and np.ptp(points, axis=0).min() > 2 * grid:
                hulls.append(thinned(points, _HEIGHT_MM, third, grid=grid))
    return sorted(hulls, key=lambda h: tuple(np.round(h.mean(axis=0), 3)))


def plan_deviation(
    hulls: Sequence[Array], outline: CrossSection, notch: float = NOTCH_MM
) -> tuple[float, float]:
    """Measures how far the outline of hulls is outside and inside the true one.

    Args:
        hulls: points (n, 3) in mm.
        outline: the true outline from above, in mm.
        notch: half the width, in mm, of the widest notches and holes that hulls may bridge. The
            bridges do not count as outside.

    Returns:
        The largest distances outside and inside, in mm, with a precision of 0.001 mm.
    """
    covered = projection(hulls)
    return (
        furthest(covered, without_notches(outline, notch), 0.001, _AREA),
        furthest(outline, covered, 0.001, _AREA),
    )


def _solid(triangles: Array) -> Manifold:
    vertices, index = np.unique(
        np.round(triangles.reshape(-1, 3), 4) + 0.0, axis=0, return_inverse=True
    )
    faces = index.reshape(-1, 3)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    solid = Manifold(Mesh64(vertices, faces.astype(np.uint64)))
    if solid.status() != Error.NoError or solid.volume() <= 0:
        raise ValueError("its surface is not closed")
    return solid


def without_notches(outline: CrossSection, notch: float) -> CrossSection:
    """Fills an outline's notches and holes that are narrower than twice `notch`."""
    grown = outline.offset(notch, JoinType.Round, circular_segments=192)
    # Offsetting outward and back shaves off corners, so add the original outline.
    return grown.offset(-notch, JoinType.Round, circular_segments=192) + outline


def convex_cells(inner: CrossSection, outer: CrossSection) -> list[CrossSection]:
    """Covers the region `inner` with few convex polygons that stay within `outer` and may overlap.

    The region is triangulated. Starting from the largest uncovered triangle, neighbouring triangles
    are added as long as the hull of all of them is within `outer`. The new cell is the hull of
    those triangles that no earlier cell covers. This repeats until all triangles are covered.
    """
    loops = inner.to_polygons()
    corners = np.vstack(loops)
    faces = np.asarray(triangulate(loops))
    flat = corners[faces]
    u, v = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    areas = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    neighbours = _neighbours(faces)
    uncovered, cells = set(range(len(faces))), []
    while uncovered:
        seed = max(sorted(uncovered), key=lambda i: float(areas[i]))
        members = _grow(seed, flat, neighbours, areas, outer)
        covered = sorted(members & uncovered)
        cells.append(CrossSection.hull_points(flat[covered].reshape(-1, 2)))
        uncovered -= members
    return _needed(cells, inner)


def _neighbours(faces: NDArray[np.int_]) -> list[set[int]]:
    """Returns for each triangle the set of triangles that share an edge with it."""
    owners: dict[tuple[int, int], list[int]] = {}
    for index, face in enumerate(faces.tolist()):
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            owners.setdefault((min(a, b), max(a, b)), []).append(index)
    result: list[set[int]] = [set() for _ in faces]
    for pair in owners.values():
        for one in pair:
            result[one].update(set(pair) - {one})
    return result


def _grow(
    seed: int, flat: Array, neighbours: list[set[int]], areas: Array, outer: CrossSection
) -> set[int]:
    """Returns the indices of the triangles of the largest convex cell around a triangle."""
    members, refused = {seed}, set[int]()
    points = flat[seed]
    while True:
        front = set().union(*(neighbours[i] for i in members)) - members - refused
        if not front:
            return members
        index = max(sorted(front), key=lambda i: float(areas[i]))
        trial = np.vstack([points, flat[index]])
        hull = CrossSection.hull_points(trial)
        if (hull - outer).area() > _AREA:
            # The cell only grows, so a triangle that does not fit at this step never will.
            refused.add(index)
            continue
        members.add(index)
        points = np.vstack(hull.to_polygons()) if hull.num_vert() else trial


def _needed(cells: list[CrossSection], inner: CrossSection) -> list[CrossSection]:
    """Drops cells that are not needed to cover `inner`, the smallest first."""
    kept = list(cells)
    for cell in sorted(cells, key=lambda c: c.area()):
        rest = [other for other in kept if other is not cell]
        if rest and (inner - CrossSection.batch_boolean(rest, OpType.Add)).area() <= _AREA:
            kept = rest
    return kept


def _with_tips(
    cells: list[CrossSection], outline: CrossSection, outer: CrossSection, tolerance: float
) -> list[CrossSection]:
    """Extends cells to corners of the outline that are farther than a tolerance from all cells.

    Such corners exist at sharp tips, where an outline that is moved inward loses much length.
    """
    cells = list(cells)
    near = CrossSection.batch_boolean(cells, OpType.Add).offset(
        tolerance, JoinType.Round, circular_segments=64
    )
    for corner in np.vstack((outline - near).to_polygons() or [np.empty((0, 2))]):
        trials = []
        for index, cell in enumerate(cells):
            x_min, y_min, x_max, y_max = cell.bounds()
            if np.all(corner > [x_min - _TIP, y_min - _TIP]) and np.all(
                corner < [x_max + _TIP, y_max + _TIP]
            ):
                hull = CrossSection.hull_points(np.vstack([*cell.to_polygons(), corner]))
                if (hull - outer).area() <= _AREA:
                    trials.append((hull.area() - cell.area(), index, hull))
        if trials:
            _, index, hull = min(trials, key=lambda trial: trial[:2])
            cells[index] = hull
    return cells


def _cut_heights(piece: Manifold, cuts: int) -> list[Manifold]:
    """Cuts a piece at the heights where cutting makes its hull smaller, for instance below a bolt's
    head."""
    low, high = piece.bounding_box()[2], piece.bounding_box()[5]
    whole = piece.hull().volume()
    if not cuts or whole - piece.volume() < max(_SHARE * whole, _VOLUME):
        return [piece]
    z = np.unique(np.round(np.asarray(piece.to_mesh64().vert_properties)[:, 2], 2))
    z = z[(z > low + _THINNEST_MM) & (z < high - _THINNEST_MM)]
    if len(z) > _LEVELS:
        z = np.unique(np.quantile(z, np.linspace(0, 1, _LEVELS), method="nearest"))
    best, least = [piece], whole - max(_SHARE * whole, _VOLUME)
    for level in z.tolist():
        halves = list(piece.split_by_plane((0.0, 0.0, 1.0), level))
        volume = sum(half.hull().volume() for half in halves)
        if volume < least:
            best, least = halves, volume
    if len(best) == 1:
        return best
    return [part for half in best for part in _cut_heights(half, cuts - 1)]
