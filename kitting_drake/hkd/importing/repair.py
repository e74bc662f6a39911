"""Turns any mesh into one solid, the first step of `hkd import`.

A watertight mesh is used as it is. Any other mesh is split into connected components, and each
component is repaired separately. First its winding is repaired, then small holes and flat openings
are closed. If this does not suffice, pymeshfix repairs the component. The components are then
united, and sealed hollows are subtracted. If this loses visible parts, the solid is made from the
voxels inside the surface instead.
"""

import numpy as np
import pymeshfix
import trimesh
from manifold3d import Error, Manifold, Mesh64, OpType
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.closing import capped

# Meshes are scaled to this length for repair. The tolerances below refer to it.
NOMINAL_MM = 180.0

# Vertices in the same cell of a grid with this spacing are merged.
_MERGE_MM = 1e-3
# Bodies that are farther apart than `_GAP_MM` are separate objects. If the largest object has at
# least the share 1 - `_DIRT` of the volume, the others are removed; if not, the mesh is rejected.
_GAP_MM, _DIRT = 1.5, 0.02
# A repair may remove at most this share of the area of each projection, along x, y and z.
_LOST = 0.03
# The size of a pixel of the compared projections.
_PIXEL_MM = 0.5
# A note warns if more than the share `_TELLING` of the repaired surface is new. This surface is
# sampled at `_PROBES` points; a point counts as new if it is farther than `_AWAY_MM` from the given
# surface.
_TELLING, _AWAY_MM, _PROBES = 0.03, 1.5, 20_000
_MOST_COMPONENTS = 3000
_VOXEL_MM = 0.75
# The largest share of a hollow's volume that may lie outside the body around it.
_OUTSIDE = 0.01
# A mesh has no volume if it fills less than this share of its bounding box.
_HOLLOW = 0.002

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


def make_solid(vertices: Array, faces: Faces) -> tuple[Manifold, list[str]]:
    """Makes one solid from the triangles of a mesh.

    Args:
        vertices: the vertices (n, 3) in mm, scaled so that the longest side of their bounding box
            is `NOMINAL_MM`.
        faces: the triangles (m, 3).

    Returns:
        The solid, and notes for the user on its repairs.

    Raises:
        UserError: the mesh encloses no volume, or consists of several objects.
    """
    vertices, faces = _merged(vertices, faces)
    if len(faces) < 4:
        raise UserError("the mesh encloses no volume: repair it first")
    notes: list[str] = []
    components = trimesh.graph.connected_components(
        trimesh.graph.face_adjacency(faces), nodes=np.arange(len(faces)), min_len=1
    )
    outward, inward, mended, repaired = [], [], [], 0
    if len(components) <= _MOST_COMPONENTS:
        for component in sorted(components, key=len, reverse=True):
            sound = _as_manifold(vertices, faces[component])
            if sound is None:
                repaired += 1
                sound = _repaired(vertices, faces[component])
                if sound is not None:
                    mended.append(sound)
            elif _volume(vertices[faces[component]]) > 0:
                outward.append(sound)
            else:
                inward.append(sound)
    solids, hollows = _told_apart(outward, inward)
    solids += mended
    solid = Manifold.batch_boolean(solids, OpType.Add) if solids else Manifold()
    if repaired:
        notes.append(f"repaired {repaired} of {len(components)} surfaces")
    if len(solids) > 1:
        notes.append(f"united {len(solids)} bodies")
    if repaired or not solids:
        triangles = vertices[faces]
        if _loses(triangles, solid):
            solid, hollows = _wrapped(triangles), []
            notes = ["wrapped a surface with large gaps"]
        added = _added(triangles, solid)
        if added > _TELLING:
            notes.append(
                f"{100 * added:.0f} % of its surface was missing: check with `hkd sheet` that the "
                "file is complete"
            )
    if solid.is_empty() or solid.volume() < _HOLLOW * _box_volume(solid):
        raise UserError("the mesh encloses no volume: repair it first")
    solid = _one_thing(solid, notes)
    if hollows:
        notes.append(f"kept {len(hollows)} sealed {'hollow' if len(hollows) == 1 else 'hollows'}")
    for hollow in hollows:
        inside = [body for body in solids if body.volume() < hollow.volume()]
        solid -= Manifold.batch_boolean([hollow, *inside], OpType.Subtract)
    return solid, notes


def _told_apart(
    outward: list[Manifold], inward: list[Manifold]
) -> tuple[list[Manifold], list[Manifold]]:
    """Separates bodies from the sealed hollows inside them.

    The surface of a hollow is wound in the opposite direction to that of the body around it. A
    surface that is not inside another one bounds a body, whatever its winding.

    Args:
        outward: the solids inside surfaces with outward normals.
        inward: the solids inside surfaces with inward normals.

    Returns:
        The bodies and the hollows.
    """
    if inward and max((s.volume() for s in outward), default=0.0) < max(s.volume() for s in inward):
        outward, inward = inward, outward
    if not inward:
        return outward, []
    whole = Manifold.batch_boolean(outward, OpType.Add)
    hollows = [s for s in inward if (s - whole).volume() < _OUTSIDE * s.volume()]
    return [*outward, *(s for s in inward if s not in hollows)], hollows


def _volume(triangles: Array) -> float:
    """Returns the signed volume inside triangles (n, 3, 3); it is negative for inward normals."""
    a, b, c = np.moveaxis(triangles - triangles.mean(axis=(0, 1)), 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def _merged(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    grid = np.round(vertices / _MERGE_MM).astype(np.int64)
    _, first, index = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, unique = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return vertices[first], faces[np.sort(unique)]


def _as_manifold(vertices: Array, faces: Faces) -> Manifold | None:
    """Returns the solid inside a surface, or None if the surface does not bound one."""
    if len(faces) < 4 or not _is_closed(faces):
        return None
    used, index = np.unique(faces, return_inverse=True)
    faces = index.reshape(-1, 3)
    solid = Manifold(Mesh64(vertices[used], faces.astype(np.uint64)))
    if solid.status() != Error.NoError or solid.is_empty():
        return None
    if solid.volume() < 0:
        solid = Manifold(Mesh64(vertices[used], faces[:, ::-1].astype(np.uint64)))
    return solid if solid.volume() > 1e-3 else None


def _is_closed(faces: Faces) -> bool:
    """Whether each edge occurs once in each direction. Otherwise manifold3d may crash."""
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = edges[:, 0] * (faces.max() + 1) + edges[:, 1]
    opposite = edges[:, 1] * (faces.max() + 1) + edges[:, 0]
    keys.sort()
    opposite.sort()
    return bool(np.array_equal(keys, opposite) and (np.diff(keys) > 0).all())


def _repaired(vertices: Array, faces: Faces) -> Manifold | None:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.remove_unreferenced_vertices()
    trimesh.repair.fix_winding(mesh)
    if mesh.is_watertight or trimesh.repair.fill_holes(mesh):
        solid = _as_manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        if solid is not None:
            return solid
    whole = capped(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    if whole is not None:
        solid = _as_manifold(np.asarray(mesh.vertices), whole)
        if solid is not None:
            return solid
    fixer = pymeshfix.PyTMesh()
    fixer.set_quiet(True)
    try:
        fixer.load_array(
            np.ascontiguousarray(mesh.vertices, dtype=float),
            np.ascontiguousarray(mesh.faces, dtype=np.int32),
        )
        fixer.fill_small_boundaries(0, False)
        solid = _fixed(fixer)
        if solid is None:
            # `clean` is slow, so it comes last. It also removes self-intersections.
            fixer.clean(10, 3)
            solid = _fixed(fixer)
    except RuntimeError:
        return None
    return solid


def _fixed(fixer: pymeshfix.PyTMesh) -> Manifold | None:
    vertices, faces = fixer.return_arrays()
    return _as_manifold(np.asarray(vertices, dtype=float), np.asarray(faces, np.int64))


def _loses(triangles: Array, solid: Manifold) -> bool:
    """Whether a solid lacks or adds large visible parts, compared with triangles (n, 3, 3).

    The projections of the solid and of the triangles along x, y and z are compared.
    """
    if solid.is_empty():
        return True
    mesh = solid.to_mesh64()
    mine = np.asarray(mesh.vert_properties)[:, :3][np.asarray(mesh.tri_verts).astype(int)]
    low = triangles.min(axis=(0, 1)) - 2 * _PIXEL_MM
    pixels, my_pixels = (
        np.round((_sampled(surface, _PIXEL_MM) - low) / _PIXEL_MM).astype(int)
        for surface in (triangles, mine)
    )
    shape = np.maximum(pixels.max(axis=0), my_pixels.max(axis=0)) + 3
    around = ndimage.generate_binary_structure(2, 2)
    for axes in ([0, 1], [0, 2], [1, 2]):
        seen, kept = (np.zeros(shape[axes], dtype=bool) for _ in range(2))
        seen[tuple(pixels[:, axes].T)] = True
        kept[tuple(my_pixels[:, axes].T)] = True
        # Tolerate one pixel at the rim, because sampling may miss the rim.
        lost = (seen & ~ndimage.binary_dilation(kept, around)).sum()
        gained = (kept & ~ndimage.binary_dilation(seen, around)).sum()
        # A repair that fills holes adds area, so ignore small additions.
        if lost > _LOST * seen.sum() or gained > 5 * _LOST * seen.sum():
            return True
    return False


def _added(triangles: Array, solid: Manifold) -> float:
    """Returns the share of a solid's surface that is far from all triangles (n, 3, 3)."""
    if solid.is_empty():
        return 0.0
    mesh = solid.to_mesh64()
    surface = trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3],
        np.asarray(mesh.tri_verts).astype(int),
        process=False,
    )
    points, _ = trimesh.sample.sample_surface(surface, _PROBES, seed=0)
    there = cKDTree(_sampled(triangles, _AWAY_MM))
    distances, _ = there.query(points, distance_upper_bound=2 * _AWAY_MM)
    return float((distances > _AWAY_MM).mean())


def _sampled(triangles: Array, step: float) -> Array:
    """Returns points (n, 3) of a surface, dense enough to hit almost every square of side
    `step`."""
    corners = triangles.reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    count = int(min(4e6, 12 * mesh.area / step**2)) + 1
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.vstack([points, corners])


def _wrapped(triangles: Array) -> Manifold:
    """Returns the solid inside a surface with gaps of a few voxels, accurate to about half a
    voxel."""
    corners = triangles.reshape(-1, 3)
    margin = 5 * _VOXEL_MM
    low = corners.min(axis=0) - margin
    shape = np.ceil((corners.max(axis=0) + margin - low) / _VOXEL_MM).astype(int) + 1
    filled = np.zeros(shape, dtype=bool)
    skin = np.round((_sampled(triangles, _VOXEL_MM) - low) / _VOXEL_MM).astype(int)
    filled[tuple(skin.T)] = True
    ball = ndimage.generate_binary_structure(3, 1)
    filled = ndimage.binary_closing(filled, ball, iterations=3)
    surface = int(filled.sum())
    filled = ndimage.binary_fill_holes(filled)
    if filled.sum() < 1.05 * surface:
        return Manifold()
    distance = ndimage.distance_transform_edt(filled) - ndimage.distance_transform_edt(~filled)
    # Subtract half a voxel: the voxels on the surface extend that far beyond it.
    field = ndimage.gaussian_filter(distance, 0.7) - 0.5
    inside = np.argwhere(field > -3)
    first, last = inside.min(axis=0), inside.max(axis=0)
    # Read single numbers from a memoryview, which is faster than from an array.
    values = np.ascontiguousarray(field).reshape(-1).data
    last_x, last_y, last_z = (int(extent) - 2 for extent in shape)
    low_x, low_y, low_z = map(float, low)
    row, plane = int(shape[2]), int(shape[1] * shape[2])

    def depth(x: float, y: float, z: float) -> float:
        """Returns the depth of a point in the solid, in voxels, interpolated linearly."""
        i, j, k = (x - low_x) / _VOXEL_MM, (y - low_y) / _VOXEL_MM, (z - low_z) / _VOXEL_MM
        a, b, c = (
            min(max(int(i), 0), last_x),
            min(max(int(j), 0), last_y),
            min(max(int(k), 0), last_z),
        )
        i, j, k = i - a, j - b, k - c
        n = a * plane + b * row + c

        def edge(m: int) -> float:
            return values[m] * (1 - k) + values[m + 1] * k

        here = edge(n) * (1 - j) + edge(n + row) * j
        there = edge(n + plane) * (1 - j) + edge(n + plane + row) * j
        return here * (1 - i) + there * i

    bounds = [*(low + (first - 1) * _VOXEL_MM), *(low + (last + 1) * _VOXEL_MM)]
    return Manifold.level_set(depth, bounds, 1.5 * _VOXEL_MM).simplify(0.15)


def _box_volume(solid: Manifold) -> float:
    box = np.array(solid.bounding_box()).reshape(2, 3)
    return float(np.prod(box[1] - box[0]))


def _one_thing(solid: Manifold, notes: list[str]) -> Manifold:
    """Removes small loose pieces around the largest solid.

    Raises:
        UserError: the mesh consists of several separate objects.
    """
    bodies = sorted(solid.decompose(), key=lambda body: -body.volume())
    if len(bodies) <= 1:
        return solid
    whole = solid.volume()
    crumbs = [body for body in bodies if body.volume() < 1e-4 * whole]
    bodies = [body for body in bodies if body.volume() >= 1e-4 * whole][:50]
    groups: list[list[Manifold]] = []
    for body in bodies:
        near = [g for g in groups if any(body.min_gap(o, 2 * _GAP_MM) < _GAP_MM for o in g)]
        groups = [g for g in groups if g not in near] + [[body, *(o for g in near for o in g)]]
    volumes = [sum(body.volume() for body in group) for group in groups]
    main = int(np.argmax(volumes))
    if volumes[main] < (1 - _DIRT) * whole:
        raise UserError(
            f"the mesh holds {len(groups)} separate objects: import each from its own file"
        )
    if len(groups) > 1 or crumbs:
        notes.append("removed small loose pieces")
    return Manifold.batch_boolean(groups[main], OpType.Add)
