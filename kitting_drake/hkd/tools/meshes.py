"""Writes solids as Wavefront OBJ files in metres; equal solids give equal files."""

from pathlib import Path

import numpy as np
from manifold3d import Manifold


def vertices_and_faces(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices (n, 3) and the triangles (m, 3) of a solid's surface.

    The vertices are in the solid's units.
    """
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(int)


def corner_normals(vertices: np.ndarray, faces: np.ndarray, crease_angle_deg: float) -> np.ndarray:
    """Computes normals (m, 3, 3) of the faces' corners, smooth across edges below the crease angle.

    A corner's normal is the area-weighted mean of the normals of the faces at its vertex. Faces
    tilted from the corner's own face by the crease angle or more are left out. Large flat faces
    therefore stay flat beside narrow bevels.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-30)
    limit = np.cos(np.radians(crease_angle_deg))
    corners = faces.ravel()
    order = np.argsort(corners, kind="stable")
    normals = np.empty((len(corners), 3))
    for group in np.split(order, np.flatnonzero(np.diff(corners[order])) + 1):
        around = group // 3
        alike = unit[around] @ unit[around].T > limit
        normals[group] = alike @ weighted[around]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return normals.reshape(-1, 3, 3)


def write_smooth_obj(path: Path, solid: Manifold, crease_angle_deg: float) -> int:
    """Writes a solid given in mm, with smooth normals; returns its number of triangles."""
    vertices, faces = vertices_and_faces(solid)
    normals = corner_normals(vertices, faces, crease_angle_deg)
    # Add zero, which turns -0 into 0.
    texts = [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in np.round(normals.reshape(-1, 3), 4) + 0.0]
    index = {text: i + 1 for i, text in enumerate(dict.fromkeys(texts))}
    lines = [*_vertex_lines(vertices), *index]
    for face, names in zip(faces, np.reshape(texts, (-1, 3)), strict=True):
        corners = zip(face, names, strict=True)
        lines.append("f " + " ".join(f"{v + 1}//{index[n]}" for v, n in corners))
    path.write_text("\n".join(lines) + "\n")
    return len(faces)


def flat_obj(
    vertices: np.ndarray, faces: np.ndarray, *, digits: int, normal_digits: int | None = None
) -> str:
    """Returns the OBJ text of a mesh, with or without one normal per face.

    Args:
        vertices: the vertices (n, 3), in metres.
        faces: the triangles (m, 3).
        digits: the number of decimals of the vertices.
        normal_digits: the number of decimals of the normals; None writes no normals.
    """
    text = _rows(f"v %.{digits}f %.{digits}f %.{digits}f\n", vertices)
    if normal_digits is None:
        return text + _rows("f %d %d %d\n", faces + 1)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    n = normal_digits
    text += _rows(f"vn %.{n}f %.{n}f %.{n}f\n", normals)
    numbers = np.arange(1, len(faces) + 1)
    i, j, k = faces.T + 1
    return text + _rows(
        "f %d//%d %d//%d %d//%d\n", np.stack([i, numbers, j, numbers, k, numbers], axis=1)
    )


def _rows(line: str, values: np.ndarray) -> str:
    """Formats the rows of an array (n, m) in one operation, three times as fast as row by row."""
    return (line * len(values)) % tuple(values.ravel().tolist())


def write_convex_obj(path: Path, points: np.ndarray) -> None:
    """Writes the convex hull of points (n, 3) in mm as an OBJ file."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    # Qhull does not orient its facets: flip those whose winding contradicts their outward normal.
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    inward = np.sum(np.cross(b - a, c - a) * hull.equations[:, :3], axis=1) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    lines = [*_vertex_lines(points), *(f"f {i} {j} {k}" for i, j, k in faces + 1)]
    path.write_text("\n".join(lines) + "\n")


def _vertex_lines(vertices: np.ndarray) -> list[str]:
    return [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in np.round(1e-3 * vertices, 6) + 0.0]
