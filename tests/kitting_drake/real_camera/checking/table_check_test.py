"""`check_table` refuses frames whose table is not where the calibration says."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kitting_drake.real_camera import Calibration, Frame, ShapeMatching, decide
from kitting_drake.real_camera.checking.kit_block import Block
from kitting_drake.real_camera.checking.table_check import (
    UNVERIFIED,
    CalibrationError,
    check_table,
)
from kitting_drake.scenario.cameras import LookAt
from kitting_drake.scenario.schema import Scenario
from tests.kitting_drake.real_camera.frames import calibration_of, cast

Frames = dict[str, Frame]
SLANTED = calibration_of(
    Scenario(cameras={"front": LookAt(position=[1.0, 0.3, 0.75], target=[0.5, 0.0, 0.0])})
)
BLOCK = Block((0.28, 0.26, 0.05), (0.45, -0.1, 0.4))


@pytest.fixture(scope="module")
def frames() -> Frames:
    """A camera's frame of a kit on a table, with 1 mm of noise."""
    [(name, frame)] = cast(SLANTED, BLOCK).items()
    noise = 0.001 * np.random.default_rng(0).standard_normal(frame.depth.shape)
    return {name: Frame(frame.color, (frame.depth + noise).astype(np.float32))}


def posed(X_BC: np.ndarray) -> Calibration:
    camera = dataclasses.replace(SLANTED.cameras[0], X_BC=X_BC)
    return dataclasses.replace(SLANTED, cameras=(camera,))


def turned(degrees: float, axis: list[float]) -> Calibration:
    X = SLANTED.cameras[0].X_BC.copy()
    X[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix() @ X[:3, :3]
    return posed(X)


def raised(height: float) -> Calibration:
    grid = SLANTED.grid
    grid = dataclasses.replace(grid, z_min=grid.z_min + height, z_max=grid.z_max + height)
    return dataclasses.replace(SLANTED, grid=grid)


def lens(factor: float) -> Calibration:
    camera = SLANTED.cameras[0]
    focal = (factor * camera.intrinsics.focal[0], factor * camera.intrinsics.focal[1])
    camera = dataclasses.replace(
        camera, intrinsics=dataclasses.replace(camera.intrinsics, focal=focal)
    )
    return dataclasses.replace(SLANTED, cameras=(camera,))


def changed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Frames], Frames]:
    def of_frames(frames: Frames) -> Frames:
        return {
            name: Frame(frame.color, np.ascontiguousarray(change(frame.depth), np.float32))
            for name, frame in frames.items()
        }

    return of_frames


RAYS = SLANTED.cameras[0].rays
AS_RANGE = np.sqrt(1 + RAYS.u**2 + RAYS.v**2)
X_BC = SLANTED.cameras[0].X_BC


@pytest.mark.parametrize(
    ("calibration", "change", "said"),
    [
        *[(raised(h), None, f"table_height: {-0.0:.3f}"[:14]) for h in (-0.1, -0.02, 0.02, 0.1)],
        (raised(0.05), None, "table_height: "),
        *[(turned(2, axis), None, "degrees") for axis in ([1, 0, 0], [0, 1, 0])],
        *[(turned(20, axis), None, "degrees") for axis in ([1, 0, 0], [0, 1, 0])],
        (posed(np.linalg.inv(X_BC)), None, "base in the camera"),
        (SLANTED, changed(lambda depth: depth[::-1, ::-1]), "rotated by 180 degrees"),
        (SLANTED, changed(lambda depth: depth[::-1]), "image"),
        (lens(2.0), None, "fx 450 and fy 450 would agree"),
        (lens(0.5), None, "fx 450 and fy 450 would agree"),
        (SLANTED, changed(lambda depth: 2 * depth), "depth_scale: 0.0005 would agree"),
        (SLANTED, changed(lambda depth: 1000 * depth), "millimetres"),
        (SLANTED, changed(lambda depth: depth * AS_RANGE), "distances from the camera"),
    ],
)
def test_a_wrong_calibration_is_no_action(
    frames: Frames,
    calibration: Calibration,
    change: Callable[[Frames], Frames] | None,
    said: str,
):
    decision = decide(frames if change is None else change(frames), calibration, ShapeMatching())
    assert decision.result == "calibration" and decision.action.stop
    assert said in decision.reason and "\n" not in decision.reason
    assert set(decision.as_dict()) >= {"result", "reason", "seen", "in_view"}
    assert "pick" not in decision.as_dict()


def test_the_named_height_agrees(frames: Frames):
    with pytest.raises(CalibrationError, match=r"table_height: -?0\.00[01]"):
        check_table(frames, raised(0.05))


@pytest.mark.parametrize("seed", range(4))
def test_moderate_errors_are_no_reason(frames: Frames, seed: int):
    random = np.random.default_rng(seed)
    axis, aside = random.standard_normal((2, 3))
    X = turned(0.24, (axis / np.linalg.norm(axis)).tolist()).cameras[0].X_BC
    X[:3, 3] += 0.0028 * aside / np.linalg.norm(aside)
    assert check_table(frames, posed(X)) == [UNVERIFIED]


def test_doubts_are_warnings(frames: Frames):
    [_, warning] = check_table(frames, raised(0.007))
    assert "7 mm lower" in warning and "--check" in warning


def test_large_objects_before_the_table_are_no_reason():
    """A large block hides much of the table, but the calibration is right."""
    frames = cast(SLANTED, Block((0.45, 0.8, 0.12), (0.5, 0.0, 0.0)))
    assert check_table(frames, dataclasses.replace(SLANTED, verified=True)) == []


def test_a_lower_and_larger_plane_is_the_table():
    """The calibration's table is at the height of a block's top; the real table is below."""
    frames = cast(SLANTED, BLOCK)
    with pytest.raises(CalibrationError, match="50 mm lower"):
        check_table(frames, raised(0.05))
