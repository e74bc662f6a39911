import numpy as np
import pytest
from manifold3d import CrossSection, JoinType, OpType

from kitting_drake.hkd.importing.convex_cover import convex_cover


def ring_sector(radius: float, width: float, degrees: float) -> CrossSection:
    angles = np.radians(np.linspace(0, degrees, 200))
    arc = np.column_stack([np.cos(angles), np.sin(angles)])
    loop = np.vstack([(radius + width / 2) * arc, (radius - width / 2) * arc[::-1]])
    return CrossSection([loop])


def angle_iron() -> CrossSection:
    return CrossSection.square((100, 20)) + CrossSection.square((20, 80))


def grown(profile: CrossSection, distance: float) -> CrossSection:
    return profile.offset(distance, JoinType.Round, circular_segments=48)


@pytest.mark.parametrize(
    ("outline", "most"),
    [
        (CrossSection.circle(30.0, 48), 1),
        (angle_iron(), 2),
        (angle_iron().rotate(33.0), 3),
        # A straight edge within 0.25 mm of the arc, on either side, spans at most 12 degrees.
        (ring_sector(100.0, 10.0, 90.0), 11),
        (CrossSection.square((40, 40)) + CrossSection.square((10, 10)).translate((60, 0)), 2),
    ],
)
def test_few_polygons_cover_the_inner_region_within_the_outer_one(outline: CrossSection, most: int):
    inner, outer = grown(outline, -0.25), grown(outline, 0.25)
    polygons = convex_cover(inner, outer, outline)
    assert len(polygons) <= most
    together = CrossSection.batch_boolean(polygons, OpType.Add)
    assert (inner - together).area() < 0.1
    assert (together - outer).area() < 0.1
    assert all(polygon.area() > 0.999 * polygon.hull().area() for polygon in polygons)


def test_the_polygons_follow_the_outline():
    outline = angle_iron()
    inner = grown(outline, -0.25)
    polygons = convex_cover(inner, grown(outline, 0.25), outline)
    together = CrossSection.batch_boolean(polygons, OpType.Add)
    assert (outline - together).area() < 0.02 * (outline - inner).area()


def test_the_same_outline_gives_the_same_polygons():
    outline = angle_iron().rotate(33.0)
    first, second = (
        convex_cover(grown(outline, -0.25), grown(outline, 0.25), outline) for _ in range(2)
    )
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(np.vstack(one.to_polygons()), np.vstack(other.to_polygons()))
