import re
from pathlib import Path

import numpy as np
import pytest
from manifold3d import CrossSection
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.kit import Kit, make_kit
from kitting_drake.hkd.tools.tool import Tool, load_tool, tool_names
from kitting_drake.tasks import ArrangedKitting, Kitting
from kitting_drake.tasks.kitting.tool_poses import TablePose, block_outline, draw_poses
from kitting_drake.tasks.task import TABLE
from systems.hand_geometry import FINGER_DEPTH, FINGER_LENGTH, MAX_OPENING, PALM_SIZE
from systems.signals import PixelGrid

GRID = PixelGrid()
FOUR = tuple(Kitting().tools)
SPACING = 0.008

Drawn = tuple[RigidTransform, list[RigidTransform]]


def load(names: tuple[str, ...] = FOUR) -> tuple[Kit, list[Tool]]:
    tools = [load_tool(name) for name in names]
    return make_kit(tools, Kitting().kit), tools


def draw(
    kit: Kit, tools: list[Tool], seed: int, grid: PixelGrid = GRID, yaw_range_deg: float = 180.0
) -> Drawn:
    rng = np.random.default_rng(seed)
    return draw_poses(kit, tools, grid=grid, spacing=SPACING, yaw_range_deg=yaw_range_deg, rng=rng)


def yaw_deg(X: RigidTransform) -> float:
    return float(np.rad2deg(RollPitchYaw(X.rotation()).yaw_angle()))


def placed(shape: CrossSection, X: RigidTransform) -> CrossSection:
    return shape.rotate(yaw_deg(X)).translate(tuple(X.translation()[:2]))


def hand(tool: Tool, size: tuple[float, float]) -> CrossSection:
    """A rectangle of the given size that stands for the hand at a grasp, in the tool's frame."""
    grasp = tool.grasp
    rectangle = CrossSection.square(size, True).rotate(float(np.rad2deg(grasp.theta)))
    return rectangle.translate((grasp.x, grasp.y))


def check_free(kit: Kit, tools: list[Tool], drawn: Drawn, where: str) -> None:
    """Checks that nothing overlaps or leaves the workspace, and that open hands have room."""
    X_WKit, X_WTools = drawn
    block = placed(block_outline(kit), X_WKit)
    outlines = [placed(t.footprint, X) for t, X in zip(tools, X_WTools, strict=True)]
    shapes = [block, *outlines]
    for i, shape in enumerate(shapes):
        x_min, y_min, x_max, y_max = shape.bounds()
        assert min(x_min - 0.25, y_min + 0.5, 0.75 - x_max, 0.5 - y_max) > -1e-9, where
        grown = shape.offset(SPACING - 1e-4)
        assert all((grown ^ other).area() < 1e-9 for other in shapes[i + 1 :]), where
    for i, (tool, X_WT) in enumerate(zip(tools, X_WTools, strict=True)):
        fingers = placed(hand(tool, (FINGER_LENGTH, MAX_OPENING + 2 * FINGER_DEPTH)), X_WT)
        others = [block, *outlines[:i], *outlines[i + 1 :]]
        assert all((fingers ^ other).area() < 1e-8 for other in others), where
        assert (placed(hand(tool, PALM_SIZE), X_WT) ^ block).area() < 1e-8, where


def test_drawn_poses_of_twenty_seeds_are_free():
    kit, tools = load()
    yaws: list[float] = []
    for seed in range(20):
        drawn = draw(kit, tools, seed)
        check_free(kit, tools, drawn, f"seed {seed}")
        yaws += [yaw_deg(X) for X in (drawn[0], *drawn[1])]
    assert min(yaws) < -120
    assert max(yaws) > 120


@pytest.mark.parametrize(
    "count", [1, 4, *(pytest.param(many, marks=pytest.mark.slow) for many in (7, 12))]
)
def test_drawn_poses_of_any_number_of_tools_are_free(count: int):
    kit, tools = load(tuple(tool_names()[:: len(tool_names()) // 12][:count]))
    drawn = draw(kit, tools, 0)
    assert len(drawn[1]) == count
    check_free(kit, tools, drawn, f"{count} tools")


def test_rotations_stay_in_their_range():
    X_WKit, X_WTools = draw(*load(), 1, yaw_range_deg=5.0)
    assert all(abs(yaw_deg(X)) <= 5 for X in (X_WKit, *X_WTools))


def test_drawn_poses_are_on_the_table_for_a_larger_workspace():
    kit, tools = load()
    for seed in range(5):
        X_WKit, X_WTools = draw(kit, tools, seed, grid=PixelGrid(rows=640))
        assert all(X.translation()[0] < TABLE[1][0] for X in (X_WKit, *X_WTools))


def test_an_error_without_free_space_names_the_fields_to_change():
    with pytest.raises(UserError, match=r"no free space.*heightmap\.rows.*task\.spacing"):
        draw(*load(), 0, grid=PixelGrid(rows=110, cols=110))


@pytest.mark.parametrize(
    ("kit_x", "tools", "words"),
    [
        (0.9, {"claw_hammer": TablePose(x=0.3, y=0.4)}, "task.kit_pose extends beyond"),
        (0.6, {"claw_hammer": TablePose(x=0.3, y=0.8)}, "task.tools.claw_hammer extends beyond"),
        (
            0.2,
            {"claw_hammer": TablePose(x=0.6, y=0.4)},
            "task.kit_pose: the cavity of claw_hammer",
        ),
        (
            0.6,
            {"claw_hammer": TablePose(x=0.2, y=0.3)},
            "task.tools.claw_hammer at (0.2, 0.3) m is not in the workspace",
        ),
        (
            0.6,
            {"claw_hammer": TablePose(x=0.6, y=0.1)},
            "task.kit_pose and task.tools.claw_hammer",
        ),
        (
            0.6,
            {
                "claw_hammer": TablePose(x=0.5, y=0.3),
                "flat_screwdriver": TablePose(x=0.5, y=0.31),
            },
            "task.tools.claw_hammer and task.tools.flat_screwdriver",
        ),
    ],
)
def test_an_invalid_arrangement_raises(kit_x: float, tools: dict[str, TablePose], words: str):
    task = ArrangedKitting(tools=tools, kit_pose=TablePose(x=kit_x, y=0.0))
    with pytest.raises(UserError, match=re.escape(words)):
        task.make_scene(grid=GRID, seed=0, base=Path())
