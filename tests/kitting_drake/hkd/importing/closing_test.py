from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from kitting_drake.hkd.importing.repair import make_solid


def bar() -> trimesh.Trimesh:
    return trimesh.creation.box((180, 30, 12)).subdivide_to_size(6.0)


def ring() -> trimesh.Trimesh:
    """A ring: its underside lies between an outer and an inner rim."""
    return trimesh.creation.annulus(60, 90, 12).subdivide_to_size(12.0)


def two_feet() -> trimesh.Trimesh:
    """A bridge. The undersides of its two feet have separate rims in one plane."""
    legs = [trimesh.creation.box((20, 30, 20), np.eye(4)) for _ in range(2)]
    for leg, x in zip(legs, (-80, 80), strict=True):
        leg.apply_translation((x, 0, -10))
    top = trimesh.creation.box((180, 30, 12))
    top.apply_translation((0, 0, 6))
    return trimesh.boolean.union([top, *legs]).subdivide_to_size(6.0)


@pytest.mark.parametrize(
    ("shape", "wavy_mm", "inverted"),
    [
        pytest.param(bar, 0.8, False, marks=pytest.mark.slow),
        (ring, 0.0, True),
        pytest.param(ring, 0.8, False, marks=pytest.mark.slow),
        pytest.param(two_feet, 0.0, False, marks=pytest.mark.slow),
    ],
)
def test_an_open_underside_is_closed_flat(
    shape: Callable[[], trimesh.Trimesh], wavy_mm: float, inverted: bool
):
    whole = shape()
    mesh = whole.copy()
    low = mesh.vertices[:, 2].min()
    mesh.update_faces(mesh.triangles[:, :, 2].max(axis=1) > low + 1e-6)
    rim = mesh.vertices[:, 2] < low + 1e-6
    vertices = np.array(mesh.vertices)
    vertices[rim, 2] += wavy_mm * np.sin(vertices[rim, 0] / 7)
    solid, notes = make_solid(vertices, mesh.faces[:, ::-1] if inverted else mesh.faces)
    assert solid.volume() == pytest.approx(whole.volume, rel=0.005 if wavy_mm else 1e-6)
    assert solid.genus() == (1 if shape is ring else 0)
    assert notes[0] == "repaired 1 of 1 surfaces"
    assert any("was missing" in note for note in notes)
