"""`check_agreement` refuses cameras of which one sees through what another one sees."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kitting_drake.real_camera import Calibration, Frame, ShapeMatching, decide
from kitting_drake.real_camera.checking.agreement import check_agreement, seen_through
from kitting_drake.real_camera.checking.kit_block import Block
from kitting_drake.scenario.cameras import LookAt
from kitting_drake.scenario.schema import Scenario
from tests.kitting_drake.real_camera.frames import calibration_of, cast

Frames = dict[str, Frame]
PLACES = {"left": [1.02, 0.38, 0.8], "right": [1.02, -0.38, 0.8], "back": [0.1, 0.2, 0.9]}
CAMERAS = {name: LookAt(position=x, target=[0.5, 0.0, 0.0]) for name, x in PLACES.items()}
THREE = dataclasses.replace(calibration_of(Scenario(cameras=CAMERAS)), verified=True)
TWO = dataclasses.replace(THREE, cameras=THREE.cameras[:2])
BLOCK = Block((0.28, 0.2, 0.05), (0.45, -0.1, 0.4))


def frames_of(calibration: Calibration) -> Frames:
    """Frames of a block with 1 mm of noise."""
    random = np.random.default_rng(0)
    return {
        name: with_depth(frame, frame.depth + 0.001 * random.standard_normal(frame.depth.shape))
        for name, frame in cast(calibration, BLOCK).items()
    }


def with_depth(frame: Frame, depth: np.ndarray) -> Frame:
    return Frame(frame.color, np.ascontiguousarray(depth, np.float32))


def mirrored(frame: Frame) -> Frame:
    return with_depth(frame, frame.depth[:, ::-1])


def moved(calibration: Calibration, x: float = 0.0, yaw: float = 0.0) -> Calibration:
    """The calibration with a wrong pose of the first camera: it is moved along x and rotated about
    the workspace's middle by a yaw in degrees."""
    camera = calibration.cameras[0]
    X = camera.X_BC.copy()
    R = Rotation.from_rotvec([0, 0, np.radians(yaw)]).as_matrix()
    middle = np.array([0.5, 0.0, 0.0])
    X[:3, :3], X[:3, 3] = R @ X[:3, :3], R @ (X[:3, 3] - middle) + middle + [x, 0, 0]
    first = dataclasses.replace(camera, X_BC=X)
    return dataclasses.replace(calibration, cameras=(first, *calibration.cameras[1:]))


@pytest.mark.parametrize(
    ("calibration", "change", "said"),
    [
        (moved(TWO, x=0.03), lambda it: it, "one of their poses is wrong in x, y or yaw"),
        (moved(THREE, x=0.03), lambda it: it, "the pose of left is wrong in x, y or yaw"),
        (moved(TWO, yaw=10), lambda it: it, "wrong in x, y or yaw"),
        (
            TWO,
            lambda it: {name: mirrored(frame) for name, frame in it.items()},
            "if all images were mirrored",
        ),
        (TWO, lambda it: it | {"left": mirrored(it["left"])}, "if the image of left were mirrored"),
        (
            TWO,
            lambda it: {"left": it["right"], "right": it["left"]},
            "the images of left and right were swapped",
        ),
    ],
)
def test_cameras_that_contradict_each_other_are_no_action(
    calibration: Calibration, change: Callable[[Frames], Frames], said: str
):
    frames = change(frames_of(THREE))
    decision = decide(frames, calibration, ShapeMatching())
    assert decision.result == "calibration" and decision.action.stop
    assert said in decision.reason and "\n" not in decision.reason


@pytest.mark.parametrize("seed", range(4))
def test_moderate_errors_are_no_reason(seed: int):
    """Poses that are wrong by up to 1.2 mm and 0.12 degrees each."""
    random = np.random.default_rng(seed)
    cameras = []
    for camera in THREE.cameras:
        axis, aside = random.standard_normal((2, 3))
        X = camera.X_BC.copy()
        turn = np.radians(0.12) * axis / np.linalg.norm(axis)
        X[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ X[:3, :3]
        X[:3, 3] += 0.0012 * aside / np.linalg.norm(aside)
        cameras.append(dataclasses.replace(camera, X_BC=X))
    assert (
        check_agreement(frames_of(THREE), dataclasses.replace(THREE, cameras=tuple(cameras))) == []
    )


def test_little_doubt_is_a_warning():
    [warning] = check_agreement(frames_of(TWO), moved(TWO, x=0.0095))
    assert "contradict each other" in warning and "check their poses" in warning


def test_what_one_camera_does_not_see_is_no_contradiction():
    """The right camera's depths are missing, or it sees something in front of the block."""
    frames = frames_of(TWO)
    right = frames["right"].depth
    for depth in (np.zeros_like(right), 0.5 * right):
        shares = seen_through(frames | {"right": with_depth(frames["right"], depth)}, TWO)
        assert shares.get(("left", "right"), 0.0) == 0.0


def test_a_single_camera_and_a_bare_table_cannot_disagree():
    one = dataclasses.replace(TWO, cameras=TWO.cameras[:1])
    assert seen_through(frames_of(TWO), one) == {}
    assert check_agreement(cast(TWO), moved(TWO, x=0.1)) == []


def test_lenses_with_oblong_pixels_are_refused():
    one = dataclasses.replace(TWO, cameras=TWO.cameras[:1], verified=False)
    [camera], frames = one.cameras, frames_of(TWO)
    lens = camera.intrinsics

    def seen_by(**changes: object) -> Calibration:
        other = dataclasses.replace(lens, **changes)
        return dataclasses.replace(one, cameras=(dataclasses.replace(camera, intrinsics=other),))

    fx, fy = lens.focal
    decision = decide(frames, seen_by(focal=(0.6 * fx, fy)), ShapeMatching())
    assert decision.result == "calibration" and "pixels are square" in decision.reason
    aside = seen_by(centre=(lens.centre[0] + 60, lens.centre[1]))
    assert any("cx" in item for item in decide(frames, aside, ShapeMatching()).warnings)
