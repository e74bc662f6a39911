import numpy as np
import pytest
import trimesh
from scipy.spatial import QhullError

from kitting_drake.hkd.tools.stable_pose import stable_poses


def test_a_box_rests_on_each_of_its_sides():
    box = trimesh.creation.box((180, 20, 10))
    poses = stable_poses(np.asarray(box.vertices), np.zeros(3))
    found = {tuple(np.round(pose.normal).astype(int)): pose for pose in poses}
    assert len(poses) == len(found) == 6
    down = found[0, 0, -1]
    assert (down.height, down.margin) == pytest.approx((5, 10))
    assert (found[1, 0, 0].height, found[1, 0, 0].margin) == pytest.approx((90, 5))


def test_a_box_with_an_off_centre_mass_has_fewer_poses():
    box = trimesh.creation.box((180, 20, 10))
    # On four of the six sides the box would tip over; on the other two it rests.
    poses = stable_poses(np.asarray(box.vertices), np.array([0.0, 9.0, 6.0]))
    assert {tuple(np.round(pose.normal).astype(int)) for pose in poses} == {(0, 0, 1), (0, 0, -1)}
    assert all(pose.margin == pytest.approx(1) for pose in poses)


def test_the_rotation_brings_the_support_down():
    rng = np.random.default_rng(0)
    body = trimesh.convex.convex_hull(rng.normal(size=(30, 3)))
    points, com = np.asarray(body.vertices), body.center_mass
    poses = stable_poses(points, com)
    assert poses
    for pose in poses:
        R = pose.rotation(np.array([1.0, 0.0, 0.0]))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) == pytest.approx(1)
        turned = points @ R.T
        bottom = turned[:, 2].min()
        # The body stands on three corners, with its centre of mass at the reported height.
        assert (turned[:, 2] < bottom + 1e-6).sum() >= 3
        assert (R @ com)[2] - bottom == pytest.approx(pose.height)
        assert pose.margin > 0
        # The forward direction stays in the xz plane.
        forward = R @ (1, 0, 0)
        assert forward[1] == pytest.approx(0, abs=1e-12) and forward[0] > 0


def test_the_poses_match_trimesh():
    body = trimesh.convex.convex_hull(np.random.default_rng(1).normal(size=(25, 3)))
    expected, _ = trimesh.poses.compute_stable_poses(body)
    poses = stable_poses(np.asarray(body.vertices), body.center_mass)
    assert len(poses) == len(expected)
    downs, normals = -expected[:, 2, :3], np.array([pose.normal for pose in poses])
    nearest = np.linalg.norm(downs[:, None] - normals, axis=2).min(axis=1)
    np.testing.assert_allclose(nearest, 0, atol=1e-6)


def test_a_flat_body_is_rejected():
    with pytest.raises(QhullError):
        stable_poses(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float), np.zeros(3))
