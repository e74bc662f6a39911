"""Puts the pieces of a split block together again."""

import itertools
import json
from pathlib import Path

import numpy as np
import trimesh
from manifold3d import JoinType, Manifold, Mesh64, OpType

from kitting_drake.hkd.fabrication.splitting.opening import united
from kitting_drake.hkd.fabrication.splitting.pieces import Split


def assert_rebuilds(whole: Manifold, parts: list[Manifold], found: Split) -> None:
    """Checks that the joined pieces equal the whole block, except in the joints.

    Their volumes agree, and their sections agree to 0.05 mm.
    """
    zone = united(j.outline.offset(found.play + 0.05, JoinType.Miter) for j in found.joints)
    height = whole.bounding_box()[5]
    joints = Manifold.extrude(zone, height + 2).translate((0, 0, -1))
    joined = Manifold.batch_boolean(parts, OpType.Add)
    difference = ((whole - joined) - joints).volume() + ((joined - whole) - joints).volume()
    assert difference < 1e-5 * whole.volume()
    for one, other in itertools.combinations(parts, 2):
        assert (one ^ other).volume() < 0.5
    for z in np.arange(0.53, height, 3.7):
        section = united(part.slice(z) for part in parts)
        wrong = ((whole.slice(z) - section) + (section - whole.slice(z))) - zone
        assert wrong.offset(-0.025, JoinType.Miter).area() < 1e-9


def assembled(folder: Path) -> list[Manifold]:
    """The pieces of a kit's block, read from their STL files and moved to their places."""
    parts = []
    for number, piece in enumerate(json.loads((folder / "kit.json").read_text())["pieces"], 1):
        assert piece["file"] == f"piece_{number}.stl"
        mesh = trimesh.load_mesh(folder / piece["file"])
        assert mesh.is_watertight
        np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], piece["size"]], atol=1e-3)
        solid = Manifold(Mesh64(np.array(mesh.vertices), mesh.faces.astype(np.uint64)))
        parts.append(solid.translate(tuple(piece["position"])))
    return parts
