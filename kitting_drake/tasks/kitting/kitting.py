"""The kitting tasks: tools, kits, their poses and goals."""

import dataclasses
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.grasps.all_grasps import all_grasps
from kitting_drake.hkd.kits.kit import Kit, make_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.scaling import scaled_tool
from kitting_drake.hkd.tools.tool import Tool, load_tool
from kitting_drake.hkd.tools.toolsets import SPLITS, toolsets
from kitting_drake.policies.data.learning import Learning
from kitting_drake.tasks.boxes import box_object
from kitting_drake.tasks.kitting import diagnosis
from kitting_drake.tasks.kitting.starts import APART, check_start, cluttered_scene, draw_start
from kitting_drake.tasks.kitting.tool_poses import (
    TablePose,
    check_arrangement,
    draw_boxes,
    draw_poses,
)
from kitting_drake.tasks.task import ActionRecord, Fixture, Scene, SceneObject, TaskConfig
from systems.bounds import bounded
from systems.hand_geometry import MAX_OPENING
from systems.placement import AddS, Goal, Placement
from systems.signals import PixelGrid

_SURFACE_POINTS = 2000
_MOST_TOOLS = 12
_ANNOTATE = "save another grasp by `hkd annotate`"

SEEN = "kitting-seen-toolset"
UNSEEN = "kitting-unseen-toolsets"
"""The paper's task with unseen toolsets (section V-B.1)."""

_TITLES = {"train": "kitting-train-toolsets", "test": UNSEEN, "fresh": "kitting-fresh-toolsets"}
"""Titles of the tasks that draw toolsets, by split, if all other parameters are default."""


@dataclass
class _KittingTask(TaskConfig):
    """The parameters and scoring shared by all kitting tasks."""

    # The kit block and its cavities.
    kit: KitParameters = field(default_factory=KitParameters)

    # Actions per tool; the paper's tasks allow one.
    tries: int = bounded(1, 1, 10)

    # ADD-S below this is a success (section IV-C of the paper), in m.
    success_threshold: float = bounded(0.0035, 1e-6, 1.0)

    causes = diagnosis.CAUSES
    objects_are_independent = True

    @property
    def learning(self) -> Learning:
        return Learning(later_picks_possible=True, curvature=True, reflection=True)

    def find_cause(
        self,
        scene: Scene,
        index: int,
        X_WB: Sequence[RigidTransform],
        placement: Placement,
        records: Sequence[ActionRecord],
    ) -> str:
        return diagnosis.find_cause(scene, index, X_WB[index], placement, records)

    def _kit_of(self, tools: Sequence[Tool]) -> Kit:
        try:
            return make_kit(tools, self.kit)
        except UserError as error:
            raise type(error)(f"task.kit: {error}") from error


@dataclass
class _DrawnKitting(_KittingTask):
    """Kitting tasks that draw the poses of tools and kit from the seed."""

    # Least distance between tools and kit, in m.
    spacing: float = bounded(0.008, 0.0, 0.2)

    # Tools and kit are rotated by random angles in plus or minus this, in degrees.
    yaw_range_deg: float = bounded(180.0, 0.0, 180.0)

    # Whether the oracle takes the tools in random order; else as listed.
    random_order: bool = True

    # Number of boxes without a cavity, as clutter; fewer if there is no room.
    distractors: int = bounded(0, 0, 12)

    # How the tools lie at the start: apart, touching (side by side, 0 to 3 mm apart), crossed (one
    # across another), leaning (half of them on the kit block's sides), or heap (fallen from about
    # 150 mm). All but apart come to rest by physics.
    start: str = APART

    # Whether the tools start in a shallow tray.
    tray: bool = False

    # as_drawn: all tools rest on the face that lies down in their cavities. any: in a heap, tools
    # may come to rest on another face.
    faces: str = "as_drawn"

    def _draw_scene(self, tools: list[Tool], grid: PixelGrid, seed: int) -> Scene:
        kit = self._kit_of(tools)
        if self.start != APART or self.tray:
            return self._draw_settled(kit, tools, grid, seed)
        rng = np.random.default_rng(seed)
        X_WKit, X_WTools = draw_poses(
            kit,
            tools,
            grid=grid,
            spacing=self.spacing,
            yaw_range_deg=self.yaw_range_deg,
            rng=rng,
        )
        order = rng.permutation(len(tools)) if self.random_order else np.arange(len(tools))
        boxes = draw_boxes(
            self.distractors,
            kit,
            X_WKit,
            tools,
            X_WTools,
            grid=grid,
            rng=np.random.default_rng([seed, 3]),
        )
        distractors = [
            box_object(f"distractor_{number}", "distractor", box.size, box.colour, box.X_WB)
            for number, box in enumerate(boxes, start=1)
        ]
        scene = kitting_scene(kit, X_WKit, X_WTools, order, self.success_threshold)
        return dataclasses.replace(
            scene,
            objects=(*scene.objects, *distractors),
            max_actions=self.tries * len(tools),
        )

    def _draw_settled(self, kit: Kit, tools: list[Tool], grid: PixelGrid, seed: int) -> Scene:
        rng = np.random.default_rng([seed, 4])
        grasps = [all_grasps(tool) for tool in tools]
        start = draw_start(
            kit,
            tools,
            [tool.sdf for tool in tools],
            grasps,
            kind=self.start,
            tray=self.tray,
            faces=self.faces,
            grid=grid,
            spacing=self.spacing,
            yaw_range_deg=self.yaw_range_deg,
            rng=rng,
        )
        order = rng.permutation(len(tools)) if self.random_order else np.arange(len(tools))
        scene = kitting_scene(kit, start.X_WKit, start.X_WTools, order, self.success_threshold)
        return cluttered_scene(
            scene, kit, [grasps[i] for i in order], start, grid, self.tries * len(tools)
        )


@dataclass
class Kitting(_DrawnKitting):
    """A kit and its tools in random poses: kitting-seen-toolset."""

    # 1 to 12 tools, repetitions allowed: names under models/tools, or paths of tool folders.
    tools: list[str] = field(
        default_factory=lambda: [
            "claw_hammer",
            "slip_joint_pliers",
            "combination_wrench",
            "flat_screwdriver",
        ]
    )

    @property
    def title(self) -> str:
        return SEEN if self == Kitting() else "kitting"

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        tools = _load_tools(self.tools, base)
        _check_grasps(tools, _ANNOTATE)
        return self._draw_scene(tools, grid, seed)

    def input_files(self, base: Path) -> list[Path]:
        return _tool_files(self.tools, base)

    def validate(self) -> None:
        _check_count(len(self.tools))
        check_start(self.start, self.tray, self.faces, self.distractors)


@dataclass
class ToolsetKitting(_DrawnKitting):
    """Random tools from a pool, and their kit, in random poses: kitting-unseen-toolsets."""

    # The pool: train or test (section IV-B.1 of the paper), or fresh, which is disjoint from both.
    split: str = "test"

    # Alternatively, a custom pool of names or paths of tool folders; one of each category is drawn.
    pool: list[str] = field(default_factory=list)

    # Whether to draw tool lengths from the range tool_length, in m (section IV-B.2). If not, tools
    # have the lengths of the dataset.
    random_lengths: bool = True
    tool_length: list[float] = bounded([0.15, 0.20], 0.05, 0.30)

    @property
    def title(self) -> str:
        unchanged = self == ToolsetKitting(split=self.split)
        return _TITLES.get(self.split, "kitting") if unchanged else "kitting"

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        choices = self._toolsets(base)
        # Separate streams: the poses depend neither on the number of toolsets nor on lengths.
        names = choices[np.random.default_rng([seed, 1]).integers(len(choices))]
        tools = _load_tools(names, base)
        if self.random_lengths:
            least, greatest = self.tool_length
            rng = np.random.default_rng([seed, 2])
            lengths = rng.uniform(least, greatest, len(tools))
            tools = [
                scaled_tool(tool, float(length))
                for tool, length in zip(tools, lengths, strict=True)
            ]
            advice = "set random_lengths: false, or another tool_length"
        else:
            advice = _ANNOTATE
        _check_grasps(tools, advice)
        return self._draw_scene(tools, grid, seed)

    def _toolsets(self, base: Path) -> list[tuple[str, ...]]:
        if not self.pool:
            return toolsets(self.split)
        kinds: dict[str, list[str]] = {}
        for name, tool in zip(self.pool, _load_tools(self.pool, base, "task.pool"), strict=True):
            kinds.setdefault(tool.category, []).append(name)
        return list(itertools.product(*kinds.values()))

    def input_files(self, base: Path) -> list[Path]:
        return _tool_files(self.pool, base)

    def validate(self) -> None:
        if self.split not in SPLITS:
            raise ValueError(f"task.split must be one of {', '.join(SPLITS)}, not '{self.split}'")
        if self.tool_length[0] > self.tool_length[1]:
            raise ValueError("task.tool_length must be [least, greatest]")
        check_start(self.start, self.tray, self.faces, self.distractors)


@dataclass
class ArrangedKitting(_KittingTask):
    """Tools and kit in given poses. The oracle takes the tools in the given order."""

    # Tools by name or path, with their poses on the table.
    tools: dict[str, TablePose] = field(
        default_factory=lambda: {"claw_hammer": TablePose(x=0.35, y=0.3, yaw_deg=90.0)}
    )

    # The kit's pose.
    kit_pose: TablePose = field(default_factory=lambda: TablePose(x=0.5, y=-0.1))

    @property
    def title(self) -> str:
        return "arranged"

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        tools = _load_tools(self.tools, base)
        _check_grasps(tools, _ANNOTATE)
        kit = self._kit_of(tools)
        poses = list(self.tools.values())
        check_arrangement(
            kit,
            self.kit_pose,
            dict(zip(self.tools, zip(tools, poses, strict=True), strict=True)),
        )
        scene = kitting_scene(
            kit,
            self.kit_pose.transform(),
            [pose.transform() for pose in poses],
            np.arange(len(tools)),
            self.success_threshold,
        )
        self._check_workspace(scene, grid)
        return dataclasses.replace(scene, max_actions=self.tries * len(tools))

    @staticmethod
    def _check_workspace(scene: Scene, grid: PixelGrid) -> None:
        """Raises UserError if a pick or place is outside the workspace, where o_t is unknown."""
        things = {f"task.tools.{item.name}": item.X_WB for item in scene.objects}
        for goal in scene.goals:
            name = scene.objects[goal.objects[0]].name
            things[f"task.kit_pose: the cavity of {name}"] = goal.poses[0]
        for name, X_WThing in things.items():
            if not grid.contains(X_WThing.translation()[:2]):
                raise UserError(
                    f"{name} is not in the workspace: choose x from {grid.x_min:g} to "
                    f"{grid.x_max:g} m and y from {grid.y_min:g} to {grid.y_max:g} m, or enlarge "
                    "heightmap"
                )

    def input_files(self, base: Path) -> list[Path]:
        return _tool_files(self.tools, base)

    def validate(self) -> None:
        _check_count(len(self.tools))


def kitting_scene(
    kit: Kit,
    X_WKit: RigidTransform,
    X_WTools: Sequence[RigidTransform],
    order: Sequence[int] | np.ndarray,
    threshold: float,
) -> Scene:
    """Makes the scene of a kit and its tools, with a goal for each cavity.

    Identical tools may fill each other's cavities.

    Args:
        kit: the kit and its tools.
        X_WKit: its pose.
        X_WTools: the initial pose of each tool.
        order: the expert's order, as indices into the kit's tools.
        threshold: the threshold of ADD-S, in metres.
    """
    tools = [kit.tools[index] for index in order]
    names = _unique_names(tools)
    rim = float(X_WKit.translation()[2]) + kit.size[2]
    goals = []
    for name, tool, index in zip(names, tools, order, strict=True):
        pose = kit.goal(int(index))
        X_KGoal = RigidTransform(RollPitchYaw(0, 0, pose.yaw), [pose.x, pose.y, pose.z])
        alike = tuple(i for i, other in enumerate(tools) if _are_alike(tool, other))
        goals.append(
            Goal(
                name=f"cavity of {name}",
                objects=alike,
                poses=(X_WKit @ X_KGoal,),
                reward=1 / len(tools),
                rim_height=rim,
            )
        )
    return Scene(
        objects=tuple(
            SceneObject(
                name=name,
                category=tool.category,
                model=tool.sdf,
                X_WB=X_WTools[index],
                p_BPoints=tool.surface_points(_SURFACE_POINTS),
                grasps=(tool.grasp,),
                symmetry=tool.symmetry,
            )
            for name, tool, index in zip(names, tools, order, strict=True)
        ),
        fixtures=(Fixture("kit", kit.sdf, X_WKit),),
        goals=tuple(goals),
        success=AddS(threshold),
        max_actions=len(tools),
    )


def _are_alike(tool: Tool, other: Tool) -> bool:
    return tool.directory == other.directory and tool.length == other.length


def _unique_names(tools: Sequence[Tool]) -> list[str]:
    names: list[str] = []
    for tool in tools:
        name, number = tool.name, 2
        # Other bodies in the scene have these names.
        while name in names or re.fullmatch(r"kit|distractor_\d+", name):
            name, number = f"{tool.name}_{number}", number + 1
        names.append(name)
    return names


def _check_grasps(tools: Sequence[Tool], advice: str) -> None:
    """Raises UserError, with advice, if a tool's grasp is wider than the open jaws."""
    for tool in tools:
        if tool.grasp.width >= MAX_OPENING:
            raise UserError(
                f"task: at a length of {1e3 * tool.length:.0f} mm the tool '{tool.name}' is "
                f"{1e3 * tool.grasp.width:.0f} mm wide where it is held, but the jaws open to "
                f"{1e3 * MAX_OPENING:.0f} mm only: {advice}"
            )


def _load_tools(
    names: Sequence[str] | dict[str, TablePose], base: Path, field: str = "task.tools"
) -> list[Tool]:
    loaded = {name: _load_tool(name, base, field) for name in dict.fromkeys(names)}
    return [loaded[name] for name in names]


def _load_tool(name: str, base: Path, field: str) -> Tool:
    try:
        return load_tool(name, base)
    except UserError as error:
        raise type(error)(f"{field}: {error}") from error


def _tool_files(names: Sequence[str] | dict[str, TablePose], base: Path) -> list[Path]:
    folders = [tool.directory for tool in _load_tools(names, base)]
    return [path for folder in folders for path in sorted(folder.iterdir()) if path.is_file()]


def _check_count(count: int) -> None:
    if not count:
        raise ValueError("task.tools is empty: name at least one tool")
    if count > _MOST_TOOLS:
        raise ValueError(f"task.tools has {count} tools: a kit holds up to {_MOST_TOOLS}")
