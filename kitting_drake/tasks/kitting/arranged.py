"""The kitting task in which the poses of tools and kit are given."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kitting_drake.common.errors import UserError
from kitting_drake.tasks.kitting.kit_scene import PosedKit, kitting_scene
from kitting_drake.tasks.kitting.kit_stands import KitPose, stand_of
from kitting_drake.tasks.kitting.kitting import KittingTask
from kitting_drake.tasks.kitting.tool_loading import (
    ANNOTATE,
    check_count,
    check_grasps,
    load_tools,
    tool_files,
)
from kitting_drake.tasks.kitting.tool_poses import TablePose, check_arrangement
from kitting_drake.tasks.task import Scene
from systems.signals import PixelGrid


@dataclass
class ArrangedKitting(KittingTask):
    """Tools and kit in given poses. The oracle takes the tools in the given order."""

    # The tools, by name or path, with their poses on the table.
    tools: dict[str, TablePose] = field(
        default_factory=lambda: {"claw_hammer": TablePose(x=0.35, y=0.3, yaw_deg=90.0)}
    )

    # The kit's pose.
    kit_pose: KitPose = field(default_factory=lambda: KitPose(x=0.5, y=-0.1))

    @property
    def title(self) -> str:
        return "arranged"

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        tools = self.fitted(load_tools(self.tools, base))
        check_grasps(tools, ANNOTATE)
        kit = self.kit_of(tools)
        poses = list(self.tools.values())
        check_arrangement(
            kit,
            self.kit_pose,
            dict(zip(self.tools, zip(tools, poses, strict=True), strict=True)),
        )
        stand, X_WLevel = stand_of(self.kit_pose), self.kit_pose.transform()
        posed = PosedKit(
            kit,
            stand.lifted(kit, X_WLevel),
            tuple(range(len(tools))),
            stand.fixture("riser", kit, X_WLevel),
        )
        scene = kitting_scene(
            [posed],
            tools,
            [pose.transform() for pose in poses],
            np.arange(len(tools)),
            self.success_threshold,
        )
        self._check_workspace(scene, grid)
        return dataclasses.replace(scene, max_actions=self.tries * len(tools))

    @staticmethod
    def _check_workspace(scene: Scene, grid: PixelGrid) -> None:
        """Raises UserError if a pick or place is outside the workspace, beyond which policies
        see nothing."""
        things = {f"task.tools.{item.name}": item.X_WB for item in scene.objects}
        for goal in scene.goals:
            name = scene.objects[goal.objects[0]].name
            things[f"task.kit_pose: the cavity of {name}"] = goal.poses[0]
        for name, X_WThing in things.items():
            x, y, _ = X_WThing.translation().tolist()
            if not grid.contains((x, y)):
                raise UserError(
                    f"{name} at ({x:.3g}, {y:.3g}) m is not in the workspace: choose x from "
                    f"{grid.x_min:g} to {grid.x_max:g} m and y from {grid.y_min:g} to "
                    f"{grid.y_max:g} m, or enlarge heightmap"
                )

    def input_files(self, base: Path) -> list[Path]:
        return tool_files(self.tools, base)

    def validate(self) -> None:
        check_count(len(self.tools))
