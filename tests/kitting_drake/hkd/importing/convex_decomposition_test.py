import numpy as np
import pytest
from manifold3d import CrossSection, Manifold, OpType

from kitting_drake.hkd.importing import convex_decomposition
from kitting_drake.hkd.importing.convex_decomposition import MOST_HULLS, decompose
from kitting_drake.hkd.tools.collision import furthest, projection
from systems.grasp import Grasp

GRASP = Grasp(x=-0.02, y=0.0, theta=0.0, width=0.02, surface_height=0.012)


def union(hulls: list[np.ndarray]) -> Manifold:
    return Manifold.batch_boolean([Manifold.hull_points(hull) for hull in hulls], OpType.Add)


def bent_handle() -> Manifold:
    """An arc, 20 mm wide and 12 mm high, with its middle at the origin, where the grasp is."""
    ring = CrossSection.circle(160.0, 400) - CrossSection.circle(140.0, 400)
    arc = ring ^ CrossSection.square((140.0, 100.0), True).translate((0.0, 150.0))
    return arc.translate((-20.0, -150.0)).extrude(12.0)


def stepped() -> Manifold:
    """A straight bar with one half three times as high as the other."""
    return Manifold.cube((80, 20, 10)).translate((-80, -10, 0)) + Manifold.cube(
        (80, 20, 30)
    ).translate((0, -10, 0))


@pytest.mark.parametrize("solid", [bent_handle(), stepped()])
def test_the_reported_outline_deviation_is_true(solid: Manifold):
    found = decompose(solid, GRASP)
    outline, seen = solid.project(), projection(found.hulls)
    deviation = max(furthest(seen, outline), furthest(outline, seen))
    assert found.outline_deviation_mm == pytest.approx(deviation, abs=0.05)
    assert deviation <= 0.35
    assert len(found.hulls) <= 8
    assert all(len(hull) <= 40 for hull in found.hulls)


def test_hulls_are_split_by_height():
    solid = stepped()
    together = union(decompose(solid, GRASP).hulls)
    assert (together - solid).volume() < 0.02 * solid.volume()
    assert (solid - together).volume() < 0.02 * solid.volume()


def test_the_bottom_is_flat_at_zero():
    solid = bent_handle()
    points = np.vstack(decompose(solid, GRASP).hulls)
    assert points[:, 2].min() == 0.0
    bottom = CrossSection.hull_points(points[points[:, 2] == 0.0][:, :2])
    assert furthest(solid.project().hull(), bottom) < 0.4


@pytest.mark.slow
def test_the_deviation_of_a_complex_outline_is_reported(monkeypatch: pytest.MonkeyPatch):
    # Try only the last entry of the list of tolerances.
    last = convex_decomposition.OUTLINE_TOLERANCES_MM[-1:]
    monkeypatch.setattr(convex_decomposition, "OUTLINE_TOLERANCES_MM", last)
    # A comb with gaps too wide to bridge.
    teeth = [
        Manifold.cube((4, 30, 10)).translate((11.5 * index - 71.0, -40, 0)) for index in range(13)
    ]
    comb = Manifold.batch_boolean([Manifold.cube((152, 20, 10), True), *teeth], OpType.Add)
    found = decompose(comb.translate((0, 0, 5)), GRASP)
    assert len(found.hulls) > MOST_HULLS
    assert found.outline_deviation_mm == pytest.approx(1.0, abs=0.5)
