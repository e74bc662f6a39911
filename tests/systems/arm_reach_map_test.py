"""The reach map agrees with numerical inverse kinematics, and with known figures of the cell."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from systems.arm_kinematics import ArmBase, joint_frames
from systems.arm_limits import ARM_LIMITS, FR3
from systems.arm_reach_map import MARGIN, YAWS, ReachMap
from systems.hand_geometry import FINGERTIP_DISTANCE

LEVELS = np.array([0.02, 0.15, 0.28])


def is_reached(base: ArmBase, x: float, y: float, z: float, yaw: float, model: str) -> bool:
    """Whether a solver finds joint positions for a pose of the hand, from several starts."""
    limits = ARM_LIMITS[model]
    lower, upper = np.array(limits.lower) + MARGIN, np.array(limits.upper) - MARGIN
    px, py, pz, turn = base.to_base([x, y, z, yaw]).tolist()
    # The hand is mounted at -45 degrees to the flange, whose z axis points down.
    cos, sin = math.cos(turn - math.pi / 4), math.sin(turn - math.pi / 4)
    rotation = np.array([[cos, sin, 0], [sin, -cos, 0], [0, 0, -1]])
    goal = np.array([px, py, pz + FINGERTIP_DISTANCE])

    def residual(q):
        rotations, origins = joint_frames(q)
        return np.concatenate([(rotations[7] - rotation).ravel() / 3, origins[7] - goal])

    rng = np.random.default_rng(0)
    azimuth = math.atan2(py, px)
    for start in [[azimuth, 0.3, 0, -1.9, 0, 2.2, azimuth - turn + math.pi / 4], *[None] * 4]:
        guess = rng.uniform(lower, upper) if start is None else np.array(start)
        guess[6] = math.remainder(guess[6], math.tau)
        found = least_squares(
            residual, guess.clip(lower, upper), bounds=(lower, upper), max_nfev=80
        )
        if np.abs(found.fun).max() < 1e-4:
            return True
    return False


def disagreements(count: int, model: str, seed: int) -> int:
    """The number of random poses about which the map and the solver disagree.

    Poses within 5 mm of the edge of the reach are left out.
    """
    rng = np.random.default_rng(seed)
    reach = ReachMap(ARM_LIMITS[model], LEVELS)
    wrong = 0
    for _ in range(count):
        base = ArmBase(rng.uniform(-0.2, 0.2), rng.uniform(-0.3, 0.3), 0.0, rng.uniform(-3, 3))
        level = int(rng.integers(len(LEVELS)))
        x, y = rng.uniform([0.25, -0.5], [0.75, 0.5])
        steps = 0.005 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        around = reach.shares(base, [x, y] + steps)[:, level]
        if np.ptp(around) > 0 or 0 < around[0] < 1:
            continue
        yaw = float(rng.integers(YAWS)) * math.pi / YAWS
        solved = any(
            is_reached(base, x, y, LEVELS[level], yaw + turn, model) for turn in (0, math.pi)
        )
        wrong += solved != bool(around[0])
    return wrong


def test_the_cells_workspace():
    """The expected shares were measured once, on a grid of 50 mm up to the workspace's edges."""
    x, y = np.linspace(0.25, 0.75, 11), np.linspace(-0.5, 0.5, 21)
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    reach = ReachMap(FR3, np.linspace(0.02, 0.28, 6))
    for at, share in ((0.0, 0.919), (0.1, 0.983), (0.15, 0.975)):
        assert reach.shares(ArmBase(at), points).mean() == pytest.approx(share, abs=0.005)
    moved = ArmBase(0.1 - 3.0, 2.0)
    np.testing.assert_allclose(
        reach.shares(moved, points + [-3.0, 2.0]), reach.shares(ArmBase(0.1), points)
    )


@pytest.mark.parametrize("count", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_a_solver_agrees(count: int):
    assert disagreements(count, "fr3", 0) == 0


@pytest.mark.slow
@pytest.mark.parametrize("model", ARM_LIMITS)
def test_a_solver_agrees_on_a_thousand_poses(model: str):
    assert disagreements(1000, model, 1) == 0
