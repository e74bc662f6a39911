import numpy as np
import pytest
from manifold3d import Manifold
from numpy.typing import NDArray

from kitting_drake.hkd.tools import symmetry
from kitting_drake.hkd.tools.meshes import vertices_and_faces
from kitting_drake.hkd.tools.symmetry import measure_rotation, symmetry_order
from kitting_drake.hkd.tools.tool import load_tool


def bar() -> Manifold:
    return Manifold.cube((180, 20, 10), True).translate((0, 0, 5))


def block(length: float, width: float, height: float) -> Manifold:
    return Manifold.cube((length, width, height), True).translate((0, 0, height / 2))


def prism(sides: int, size: float) -> Manifold:
    return Manifold.cylinder(20, size / 2, circular_segments=sides)


def triangles(solid: Manifold) -> NDArray[np.float64]:
    vertices, faces = vertices_and_faces(solid)
    return 1e-3 * vertices[faces]


@pytest.mark.parametrize(
    ("solid", "order"),
    [
        # The symmetry's centre is not at the origin.
        (bar().translate((3, -1, 0)), 2),
        # Point-symmetric but not mirror-symmetric.
        (
            bar()
            + block(20, 30, 10).translate((80, 5, 0))
            + block(20, 30, 10).translate((-80, -5, 0)),
            2,
        ),
        (
            bar()
            + block(20, 30, 10).translate((80, 5, 0))
            + block(20, 30, 10).translate((-80, 5, 0)),
            1,
        ),
        # A notch of half a millimetre does not break the symmetry; one of 5 mm does.
        (bar() - block(1, 4, 30).translate((90, 0, 0)), 2),
        (bar() - block(10, 4, 30).translate((90, 0, 0)), 1),
        pytest.param(prism(6, 60), 6, marks=pytest.mark.slow),
        pytest.param(prism(4, 60), 4, marks=pytest.mark.slow),
        pytest.param(prism(3, 60), 3, marks=pytest.mark.slow),
        (prism(128, 60), 24),
        # The same outline, but with a hollow at one end.
        (bar() - block(70, 18, 10).translate((50, 0, 5)), 1),
    ],
)
def test_symmetry_order(solid: Manifold, order: int, monkeypatch: pytest.MonkeyPatch):
    # Simple shapes need fewer points than tools.
    monkeypatch.setattr(symmetry, "_DENSE_SAMPLES", 20_000)
    assert symmetry_order(triangles(solid)) == order


def test_measure_rotation():
    longer = bar() + block(10, 20, 10).translate((85, 5, 0))
    reversal = measure_rotation(triangles(longer), complete=True)
    # One end has a step of 5 mm; the best rotation spreads the deviation over both ends.
    assert reversal.outline_deviation_mm == pytest.approx(2.5, abs=0.1)
    assert 0.1 < reversal.surface_distance_mm < 0.5
    assert not reversal.is_symmetric


@pytest.mark.parametrize(
    "name",
    [
        "s_wrench",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("double_box_end_wrench", "offset_screwdriver", "claw_hammer")
        ),
    ],
)
def test_tools_with_different_ends_are_not_reversible(name: str):
    tool = load_tool(name)
    assert tool.symmetry == symmetry_order(tool.triangles) == 1
