import numpy as np
import pytest
from manifold3d import CrossSection

from kitting_drake.hkd.tracing.photo_views import outline_of_silhouette, silhouette_of_outline

CAMERA = np.array([-60.0, 20.0, 400.0])


def silhouette(outline: CrossSection, heights: np.ndarray) -> CrossSection:
    """A tool's silhouette: the union of the projections of its outline at the given heights."""
    seen = CrossSection()
    for height in heights:
        factor = CAMERA[2] / (CAMERA[2] - height)
        about = outline.translate((-CAMERA[0], -CAMERA[1])).scale((factor, factor))
        seen += about.translate((CAMERA[0], CAMERA[1]))
    return seen


@pytest.mark.parametrize(
    ("edges", "heights"),
    [("upright", np.linspace(0, 20, 200)), ("round", np.array([10.0]))],
)
def test_the_outline_is_found_again(edges: str, heights: np.ndarray):
    outline = CrossSection.square((80, 30)) - CrossSection.circle(8).translate((20, 15))
    seen = silhouette(outline, heights)
    found = outline_of_silhouette(seen, CAMERA, 20.0, edges)
    assert found.num_contour() == 2
    assert difference(found, outline) < 0.02 * outline.area()
    hidden = silhouette_of_outline(outline, CAMERA, 20.0, edges)
    assert difference(hidden, seen) < 0.02 * seen.area()


def difference(area: CrossSection, other: CrossSection) -> float:
    return (area - other).area() + (other - area).area()
