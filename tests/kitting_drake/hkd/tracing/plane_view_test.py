import math

import numpy as np
import pytest

from kitting_drake.hkd.tracing.plane_view import focal_of_height, view_of


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
@pytest.mark.parametrize("start", [2000.0, 3200.0])
def test_a_camera_height_gives_the_focal_length_of_an_oblique_view(tilt_deg: float, start: float):
    focal, center, tilt = 2500.0, np.array([1999.5, 1499.5]), math.radians(tilt_deg)
    away = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    right = np.array([0.0, 1.0, 0.0])
    R = np.stack([right, np.cross(-away, right), -away])
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    camera = 400.0 / math.cos(tilt) * away
    homography = K @ np.column_stack([R[:, :2], -R @ camera])
    found = focal_of_height(homography, 400.0, start, center)
    assert found == pytest.approx(focal, abs=0.5)
    assert view_of(homography, found, center).camera == pytest.approx(camera, abs=0.1)
