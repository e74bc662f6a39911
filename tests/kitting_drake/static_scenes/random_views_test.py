import numpy as np

from kitting_drake.scenario.cameras import LookAt, camera_pose, check_camera
from kitting_drake.static_scenes.random_views import draw_views


def test_random_cameras_look_at_the_workspace_from_above():
    """They look down within 60 degrees of the vertical, at a point near the workspace's middle."""
    counts, slants = [], []
    for seed in range(200):
        views = draw_views(np.random.default_rng(seed))
        counts.append(len(views))
        for view in views.values():
            assert isinstance(view, LookAt)
            check_camera(view)
            X = camera_pose(view)
            axis = X.rotation().matrix()[:, 2]
            slants.append(np.degrees(np.arccos(-axis[2])))
            hit = X.translation() - axis * X.translation()[2] / axis[2]
            assert abs(hit[0] - 0.5) < 0.081 and abs(hit[1]) < 0.151
            assert 0.3 < X.translation()[2] < 1.11
    assert set(counts) == {1, 2, 3}
    assert 0 < min(slants) < 10 and 50 < max(slants) < 60.01


def test_the_same_generator_draws_the_same_cameras():
    first, second = (draw_views(np.random.default_rng(5)) for _ in range(2))
    assert first == second
