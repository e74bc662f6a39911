"""assembling-kits: put flat shapes into the cavities of a kit."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from manifold3d import CrossSection, JoinType
from pydrake.math import RigidTransform

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.block import ARC_SEGMENTS, Cavity
from kitting_drake.hkd.kits.kit import make_kit
from kitting_drake.hkd.kits.layout import CavityPose, cavity_outline, moved_outline
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.shapes.shape_outlines import ROUND
from kitting_drake.hkd.shapes.shape_tools import (
    RAVENS_SCALE,
    imported_shape,
    shape_files,
    shape_tool,
    shapes_of,
)
from kitting_drake.hkd.tools.tool import Tool
from kitting_drake.policies.data.learning import Learning
from kitting_drake.tasks.footprints import draw_in_turn
from kitting_drake.tasks.kitting import diagnosis
from kitting_drake.tasks.kitting.kit_scene import PosedKit, kitting_scene
from kitting_drake.tasks.kitting.tool_poses import draw_poses
from kitting_drake.tasks.ravens.ravens_task import PoseTask
from kitting_drake.tasks.task import ActionRecord, Scene
from systems.bounds import bounded
from systems.placement import Placement
from systems.signals import PixelGrid
from systems.success import AddS, PoseWithin

PLACES = ((-0.09, 0.045), (0.0, 0.045), (0.09, 0.045), (-0.045, -0.045), (0.045, -0.045))
"""(x, y) of the cavities in the kit frame, in metres."""

_SPLITS = ("train", "test")
_MOST_ACTIONS = 10
_TRIES, _RESTARTS = 100, 50
_MANISKILL = PoseWithin(0.02, math.radians(4.0), 0.003)
"""The success predicate of ManiSkill's task of the same name."""
_ADD_S = AddS()


def _kit() -> KitParameters:
    return KitParameters(length=0.28, width=0.2, height=0.03, closing_radius=0.004)


@dataclass
class AssemblingKits(PoseTask):
    """Five flat shapes are put into the cavities of a kit. In Ravens, the cavities are only flat
    dark shapes on the kit.

    Each episode draws the shapes, their places in the kit, and all poses. Success is measured as in
    Ravens. The results also contain ADD-S, and the success by the measure of ManiSkill's task of
    the same name.
    """

    # Which of the project's shapes are used: train (14 shapes) or test (6 shapes).
    split: str = "train"

    # A folder of meshes that replace the project's shapes, such as the meshes of Ravens. They must
    # be flat shapes with z up.
    shapes: str = ""

    # Scale of the meshes in `shapes` along x, y and z, in metres per unit of the mesh. The default
    # suits the meshes of Ravens.
    scale: list[float] = bounded(list(RAVENS_SCALE), 1e-6, 1000.0)

    # The kit block and its cavities.
    kit: KitParameters = field(default_factory=_kit)

    # Least distance on the table between two shapes, and between a shape and the kit, in m.
    spacing: float = bounded(0.008, 0.0, 0.2)

    causes = diagnosis.CAUSES
    objects_are_independent = True

    @property
    def title(self) -> str:
        if self == AssemblingKits(split="test"):
            return "assembling-kits, test shapes"
        return super().title

    @property
    def learning(self) -> Learning:
        return Learning(
            later_picks_possible=True, curvature=True, reflection=True, many_answers=True
        )

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        tools = self._draw_shapes(seed, base)
        places = self._draw_places(tools, np.random.default_rng([seed, 2]))
        try:
            kit = make_kit(tools, self.kit, places)
        except UserError as error:
            raise type(error)(f"task.kit: {error}") from error
        rng = np.random.default_rng(seed)
        X_WKit, X_WShapes = draw_poses(
            kit, tools, grid=grid, spacing=self.spacing, yaw_range_deg=180.0, rng=rng
        )
        order = rng.permutation(len(tools))
        posed = PosedKit(kit, X_WKit, tuple(range(len(tools))))
        scene = kitting_scene([posed], tools, X_WShapes, order, _ADD_S.threshold)
        return self._scored(scene, [tools[index] for index in order])

    def _scored(self, scene: Scene, tools: Sequence[Tool]) -> Scene:
        """Adds the task's measures to a scene, and groups the results by shape.

        Args:
            scene: a scene of a kit.
            tools: for each object of the scene, its shape.
        """
        return dataclasses.replace(
            scene,
            objects=tuple(
                dataclasses.replace(item, category=tool.name)
                for item, tool in zip(scene.objects, tools, strict=True)
            ),
            goals=tuple(
                dataclasses.replace(goal, any_heading=tool.symmetry == ROUND)
                for goal, tool in zip(scene.goals, tools, strict=True)
            ),
            success=self.success,
            max_actions=_MOST_ACTIONS,
            measures={"ravens": PoseWithin(), "maniskill": _MANISKILL, "add_s": _ADD_S},
        )

    def _draw_shapes(self, seed: int, base: Path) -> list[Tool]:
        rng = np.random.default_rng([seed, 1])
        if not self.shapes:
            own = shapes_of(self.split)
            chosen = rng.choice(len(own), len(PLACES), replace=False)
            return [shape_tool(own[index]) for index in chosen]
        files = self._files(base)
        drawn = rng.choice(len(files), len(PLACES), replace=len(files) < len(PLACES))
        try:
            return [imported_shape(files[index], self.scale) for index in drawn]
        except UserError as error:
            raise type(error)(f"task.shapes: {error}") from error

    def _files(self, base: Path) -> list[Path]:
        try:
            return shape_files(base / self.shapes)
        except UserError as error:
            raise type(error)(f"task.shapes: {error}") from error

    def _draw_places(self, tools: Sequence[Tool], rng: np.random.Generator) -> list[CavityPose]:
        """Returns the poses of the cavities, with random headings that leave walls between them.

        Raises:
            UserError: a shape is too large for its place.
        """
        height, wall = self.kit.height, self.kit.minimum_wall
        room = CrossSection.square((self.kit.length - wall, self.kit.width - wall), True)
        rims = [_grown_rim(tool, self.kit) for tool in tools]

        def draw(
            index: int, placed: list[tuple[CavityPose, CrossSection]]
        ) -> tuple[CavityPose, CrossSection] | None:
            x, y = PLACES[index]
            for _ in range(_TRIES):
                yaw = float(rng.uniform(-math.pi, math.pi))
                pose = CavityPose(x, y, height - tools[index].height, yaw)
                rim = moved_outline(rims[index], pose)
                free = all((rim ^ other).area() <= 1e-9 for _, other in placed)
                if free and (rim - room).area() <= 1e-9:
                    return pose, rim
            return None

        for tool in tools:
            if height - tool.height < wall - 1e-9:
                raise UserError(
                    f"task.kit.height: '{tool.name}' is {1e3 * tool.height:.1f} mm high, so a "
                    f"block of {1e3 * height:.1f} mm is too low: give at least "
                    f"{tool.height + wall:.4g} m"
                )
        drawn = draw_in_turn(range(len(tools)), draw, restarts=_RESTARTS)
        if drawn is None:
            sizes = ", ".join(
                f"'{t.name}' ({1e3 * t.length:.0f} x {1e3 * t.width:.0f} mm)" for t in tools
            )
            raise UserError(
                f"task.shapes: {sizes} are too large for the places of the kit: give a smaller "
                "task.scale"
            )
        return [pose for pose, _ in drawn]

    def find_cause(
        self,
        scene: Scene,
        index: int,
        X_WB: Sequence[RigidTransform],
        placement: Placement,
        records: Sequence[ActionRecord],
    ) -> str:
        return diagnosis.find_cause(scene, index, X_WB[index], placement, records)

    def input_files(self, base: Path) -> list[Path]:
        return self._files(base) if self.shapes else []

    def validate(self) -> None:
        if self.split not in _SPLITS:
            raise ValueError(f"task.split must be one of {', '.join(_SPLITS)}, not '{self.split}'")
        if len(self.scale) != 3:
            raise ValueError(f"task.scale must have three factors [x, y, z], not {len(self.scale)}")


def _grown_rim(tool: Tool, parameters: KitParameters) -> CrossSection:
    """The rim of a shape's cavity, enlarged by half of the least thickness of a wall, in the
    shape's frame."""
    outline = cavity_outline(tool.footprint, parameters)
    rim = Cavity(outline, 0.0, parameters.height, parameters.lead_in).rim
    return rim.offset(parameters.minimum_wall / 2, JoinType.Round, circular_segments=ARC_SEGMENTS)
