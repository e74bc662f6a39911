"""MuJoCo models (MJCF) of tools and kits, converted from their SDFormat models.

MuJoCo replaces every collision mesh by its convex hull. A tool's collision meshes are convex
already. A kit's block is cut into upright convex prisms. They are exact except around the rims,
where the bevel is replaced by a step of half the bevel's width and all of its depth.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold, Mesh, triangulate
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError

_DRAKE = "{http://drake.mit.edu}"
_TORSION, _ROLLING = 0.002, 0.0001
"""Torsional and rolling friction in m, which Drake does not model. MuJoCo's defaults are 0.005 and
0.0001."""
_LEVEL = 1e-5
"""The difference below which two heights of a block count as equal, in m."""
_TOLERANCE = 5e-5
"""The simplification tolerance of outlines, in m."""
_SLIVER = 1e-9
"""The area below which triangles are dropped, in m^2."""


def tool_mjcf(sdf: Path) -> str:
    """Returns the MJCF of a tool: one free body with the model's name, in the tool frame T.

    Args:
        sdf: the SDFormat model, of one link. The result refers to the same mesh files.

    Raises:
        UserError: the file is missing or is not a tool's model.
    """
    try:
        model = _child(ElementTree.parse(sdf).getroot(), "model")
        return _tool(_name(model), _child(model, "link"))
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise UserError(f"{sdf} is not the model of a tool: {error}") from error


def _tool(name: str, link: ElementTree.Element) -> str:
    centre = " ".join(_text(link, "inertial/pose").split()[:3])
    keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    inertia = " ".join(_text(link, f"inertial/inertia/{key}") for key in keys)
    mass = _text(link, "inertial/mass")
    assets, geoms = [], []
    for kind in ("visual", "collision"):
        for number, element in enumerate(link.findall(kind)):
            mesh = f"{name}_{kind}_{number}"
            scale = element.findtext("geometry/mesh/scale") or "1 1 1"
            file = quoteattr(_text(element, "geometry/mesh/uri"))
            assets.append(f'<mesh name="{mesh}" file={file} scale="{scale}"/>')
            if kind == "visual":
                colour = _text(element, "material/diffuse")
                geoms.append(_geom(mesh, f'rgba="{colour}" contype="0" conaffinity="0" group="2"'))
            else:
                friction = _text(element, f"{_DRAKE}proximity_properties/{_DRAKE}mu_dynamic")
                geoms.append(_geom(mesh, f'{_friction(float(friction))} group="3"'))
    body = (
        f'<body name="{name}">\n      <freejoint/>\n'
        f'      <inertial pos="{centre}" mass="{mass}" fullinertia="{inertia}"/>\n      '
        + "\n      ".join(geoms)
        + "\n    </body>"
    )
    return _document(name, assets, body)


def kit_mjcf(sdf: Path) -> str:
    """Returns the MJCF of a kit: one fixed body `kit`, in the kit frame K.

    Args:
        sdf: the SDFormat model; `kit.obj` and the visual meshes must be in the same folder.

    Raises:
        UserError: the model or its block is missing, or the file is not a kit's model.
    """
    try:
        link = _child(ElementTree.parse(sdf).getroot(), "model/link")
        mesh = trimesh.load_mesh(sdf.parent / "kit.obj")
        friction = float(_text(link, f"collision/{_DRAKE}proximity_properties/{_DRAKE}mu_dynamic"))
        assets, geoms = [], []
        for element in link.findall("visual"):
            name, colour = f"kit_{_name(element)}", _text(element, "material/diffuse")
            file = quoteattr(_text(element, "geometry/mesh/uri"))
            assets.append(f'<mesh name="{name}" file={file}/>')
            geoms.append(_geom(name, f'rgba="{colour}" contype="0" conaffinity="0" group="2"'))
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise UserError(f"{sdf} is not the model of a kit: {error}") from error
    for number, prism in enumerate(block_prisms(mesh.vertices, mesh.faces)):
        points = " ".join(f"{value:.6g}" for value in prism.ravel())
        assets.append(f'<mesh name="kit_part_{number}" vertex="{points}"/>')
        geoms.append(_geom(f"kit_part_{number}", f'{_friction(friction)} group="3"'))
    body = '<body name="kit">\n      ' + "\n      ".join(geoms) + "\n    </body>"
    return _document("kit", assets, body)


def block_prisms(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> list[NDArray[np.float64]]:
    """Splits a block with upright walls into upright convex prisms, which may overlap.

    Args:
        vertices: the vertices (n, 3) of a watertight mesh, in m.
        faces: the triangles (m, 3) of the mesh.

    Returns:
        The corners (k, 3) of each prism, in m.
    """
    solid = Manifold(Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))
    levels = [float(vertices[:, 2].min())]
    for z in np.unique(vertices[:, 2]):
        if z - levels[-1] > _LEVEL:
            levels.append(float(z))
    layers = [
        solid.slice((low + high) / 2).simplify(_TOLERANCE)
        for low, high in itertools.pairwise(levels)
    ]
    prisms: list[NDArray[np.float64]] = []
    # Go through the layers from the top down. Each layer adds a region; prisms extend it to the
    # bottom.
    above = CrossSection()
    for layer, top in zip(reversed(layers), reversed(levels[1:]), strict=True):
        prisms += [_prism(part, levels[0], top) for part in _convex_parts(layer - above)]
        above = above + layer
    return prisms


def _convex_parts(region: CrossSection) -> list[NDArray[np.float64]]:
    """Returns the corners (3, 2) of triangles that cover a region."""
    loops = [np.asarray(loop) for loop in region.to_polygons()]
    if not loops:
        return []
    corners = np.concatenate(loops)
    triangles = corners[np.asarray(triangulate(loops))]
    edge_1, edge_2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = edge_1[:, 0] * edge_2[:, 1] - edge_1[:, 1] * edge_2[:, 0]
    return list(triangles[np.abs(area) > 2 * _SLIVER])


def _prism(polygon: NDArray[np.float64], bottom: float, top: float) -> NDArray[np.float64]:
    return np.concatenate(
        [np.column_stack([polygon, np.full(len(polygon), z)]) for z in (bottom, top)]
    )


def _child(element: ElementTree.Element, path: str) -> ElementTree.Element:
    """Returns the element at a path; raises ValueError if it is missing."""
    child = element.find(path)
    if child is None:
        raise ValueError(f"{path} is missing")
    return child


def _name(element: ElementTree.Element) -> str:
    """Returns the attribute `name` of an element; raises ValueError if it is missing."""
    name = element.get("name")
    if not name:
        raise ValueError(f"a {element.tag} has no name")
    return name


def _text(element: ElementTree.Element, path: str) -> str:
    text = element.findtext(path)
    if not text:
        raise ValueError(f"{path} is missing")
    return text


def _friction(sliding: float) -> str:
    return f'condim="4" friction="{sliding:g} {_TORSION:g} {_ROLLING:g}"'


def _geom(mesh: str, properties: str) -> str:
    return f'<geom type="mesh" mesh="{mesh}" {properties}/>'


def _document(name: str, assets: Sequence[str], body: str) -> str:
    listed = "\n    ".join(assets)
    return (
        f'<mujoco model="{name}">\n  <compiler angle="radian"/>\n'
        f"  <asset>\n    {listed}\n  </asset>\n"
        f"  <worldbody>\n    {body}\n  </worldbody>\n</mujoco>\n"
    )
