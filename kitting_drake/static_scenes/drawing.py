"""Draws static training scenes: random tools and kits, rendered without running episodes.

For each batch, random tools are drawn (`hkd.generation.random_tools`). Each kit is laid out for
some of these tools and rendered in several scenes, which differ in poses, seated tools, clutter and
camera noise. Physics is used only to let crossed, leaning and heaped tools come to rest. The labels
follow from the geometry: all grasps at which the jaws have room, and the pose at which a tool is
seated.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from manifold3d import CrossSection
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.common.rendering import require_rendering
from kitting_drake.hkd.generation.catalogue import load_catalogue
from kitting_drake.hkd.generation.random_tools import RandomTool, draw_tool
from kitting_drake.hkd.kits.block import build_block
from kitting_drake.hkd.kits.kit import Kit
from kitting_drake.hkd.kits.layout import kit_cavities, layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.policies.data.static_scenes import StaticScene
from kitting_drake.scenario.cameras import Camera
from kitting_drake.scenario.schema import Scenario
from kitting_drake.static_scenes.random_views import draw_views
from kitting_drake.static_scenes.scene_images import (
    Body,
    block_text,
    render,
    solid_text,
    tool_text,
)
from kitting_drake.tasks.footprints import OPEN_FINGERS
from kitting_drake.tasks.kitting.convex_bodies import convex_body
from kitting_drake.tasks.kitting.kit_stands import draw_stand
from kitting_drake.tasks.kitting.start_groups import projected
from kitting_drake.tasks.kitting.starts import draw_start, draw_unsettled
from kitting_drake.tasks.kitting.tool_poses import (
    block_outline,
    draw_boxes,
    draw_poses,
    outline_at,
    rectangle_at,
)
from systems.sensor_noise import SensorNoiseParameters
from systems.signals import Observation, PixelGrid

_TOOLS_A_BATCH = 12
_TOOLSETS_A_BATCH = 10
_SCENES_A_TOOLSET = 4
"""The largest number of scenes of one set of tools. After a scene without room for its tools, the
remaining scenes of the set are left out."""

_COUNTS = np.array([2, 4, 8, 24, 8, 6, 4, 2, 2, 1, 1, 1], float)
"""The relative frequencies of kits with 1, 2, ... 12 tools. Four tools are most frequent."""
_MOST_LOOSE = 8
"""The largest number of loose tools in a scene. All other tools are seated, because the workspace
is too small for more loose ones."""
_CLUTTERED = 0.5
"""The share of scenes with clutter, that is, objects without a cavity."""
_MOST_STRANGERS = 2
"""The largest number of tools in the clutter."""
_MOST_BOXES = 6
"""The largest number of boxes in the clutter."""
_STARTS = {"apart": 0.6, "touching": 0.28, "crossed": 0.04, "leaning": 0.04, "heap": 0.04}
"""The arrangements of loose tools, each with its share of the scenes."""
_RAISED = 0.15
"""The share of scenes whose kit stands on a riser."""
_TILTED = 0.15
"""The share of scenes whose kit is tilted."""
_RISERS = (0.01, 0.06)
"""The range of the risers' heights, in metres."""
_MOST_TILT_DEG = 5.0
"""The largest tilt of a kit, in degrees."""
_FLAT = np.cos(np.radians(2.0))
"""A tool lies flat only if the cosine of its tilt is larger than this."""
_ON_TABLE = 0.001
"""A tool lies flat only if its origin is less than this above or below the table, in metres."""
_DEFAULT_VIEWS = 0.4
"""The share of scenes that are seen by the default cameras of scenarios."""
_WALL = 0.003
"""The least thickness of a block below its deepest cavity, in metres."""
_IN_CAVITY = 0.0008
"""The standard deviation of a seated tool's position in its cavity, in metres."""


@dataclass(frozen=True)
class Obstacle:
    """The kit, a box or another tool, which may be in the way when a loose tool is picked."""

    outline: CrossSection
    """The outline in the world, seen from above, in metres."""
    tool: RandomTool | None = None
    """The tool; None for the kit and for a box."""
    X_WT: RigidTransform | None = None
    """The pose of the tool; None without one."""


@dataclass(frozen=True)
class LooseTool:
    """A loose tool on the table, and the pose at which it is seated."""

    tool: RandomTool
    X_WT: RigidTransform
    X_WGoal: RigidTransform
    around: tuple[Obstacle, ...]
    """The kit and all other objects on the table."""


@dataclass(frozen=True)
class DrawnScene:
    """A scene with its true poses, before it is rendered."""

    bodies: tuple[Body, ...]
    loose: tuple[LooseTool, ...]
    cameras: dict[str, Camera]
    noise: SensorNoiseParameters
    noise_seed: int

    def render(self, grid: PixelGrid) -> Observation:
        """Renders the observation o_t with heights only."""
        return render(self.bodies, grid, self.noise, self.noise_seed, self.cameras)

    def static_scene(self) -> StaticScene | None:
        """Renders the scene and adds the labels for training.

        Only actions whose pick and place are in view become labels. Returns None if tools are loose
        but there is no label, because a network can learn nothing from such a scene.
        """
        observation = self.render(PixelGrid())
        rows = [row for number, loose in enumerate(self.loose) for row in _actions(number, loose)]
        actions = np.array(rows).reshape(-1, 8)
        seen = _in_view(observation, actions[:, 2:4]) & _in_view(observation, actions[:, 5:7])
        actions = actions[seen]
        if self.loose and not len(actions):
            return None
        return StaticScene.of(observation, actions)


def draw_batch(seed: int) -> Iterator[StaticScene]:
    """Draws the static scenes of a seed; see `draw_scenes`."""
    for drawn in draw_scenes(seed):
        scene = drawn.static_scene()
        if scene is not None:
            yield scene


def draw_scenes(seed: int, *, default_views: float = _DEFAULT_VIEWS) -> Iterator[DrawnScene]:
    """Draws the scenes of a seed.

    Args:
        seed: the seed of all draws. Different seeds share neither tools nor kits.
        default_views: the share of scenes that are seen by the default cameras. The others are seen
            by one to three cameras at random poses (`draw_views`).

    Raises:
        MachineError: this machine cannot render.
    """
    require_rendering()
    rng = np.random.default_rng([seed, 0])
    catalogue = load_catalogue(MODELS / "tools" / "catalogue.yaml")
    entries = [entry for entry in catalogue if entry.split == "train"]
    tools = [draw_tool(entries, rng, f"tool_{index}") for index in range(_TOOLS_A_BATCH)]
    for number in range(_TOOLSETS_A_BATCH):
        count = 1 + int(rng.choice(len(_COUNTS), p=_COUNTS / _COUNTS.sum()))
        chosen = [tools[i] for i in rng.choice(len(tools), count, replace=False)]
        if rng.random() < 0.5:
            # Give all tools the same category, so that the kit's layout nests them. Four tools of
            # different categories would get the fixed slots of a toolset.
            chosen = [replace(tool, category="drawn") for tool in chosen]
        try:
            kit = _draw_kit(chosen, rng)
            others = [tool for tool in tools if all(tool.name != own.name for own in chosen)]
            for scene in range(_SCENES_A_TOOLSET):
                # Use a separate random stream, so that the noise is independent of the scene.
                own = np.random.SeedSequence([seed, 1, number, scene])
                noise_seed = int(own.generate_state(1)[0])
                drawn = _draw_scene(kit, chosen, others, rng, noise_seed)
                # Use a separate random stream, so that the views do not change the scenes.
                views = np.random.default_rng([seed, 2, number, scene])
                if views.random() >= default_views:
                    drawn = replace(drawn, cameras=draw_views(views))
                yield drawn
        except UserError:
            # There is no room for these tools, so leave out their remaining scenes.
            continue


@dataclass(frozen=True)
class _DrawnKit:
    kit: Kit
    text: str
    """The kit's block as a mesh in Wavefront text."""


def _draw_kit(tools: Sequence[RandomTool], rng: np.random.Generator) -> _DrawnKit:
    highest = max(tool.height for tool in tools)
    parameters = KitParameters(
        height=max(highest + _WALL, float(rng.uniform(0.03, 0.06))),
        clearance=float(rng.uniform(0.0015, 0.003)),
        closing_radius=float(rng.uniform(0.004, 0.009)),
        minimum_wall=0.002,
    )
    layout = layout_kit(tools, parameters)
    block = build_block(kit_cavities(tools, layout.parameters, layout.poses), layout.parameters)
    return _DrawnKit(Kit(Path("kit.sdf"), tuple(tools), layout), solid_text(block))


def _draw_scene(
    drawn: _DrawnKit,
    tools: Sequence[RandomTool],
    others: Sequence[RandomTool],
    rng: np.random.Generator,
    noise_seed: int,
) -> DrawnScene:
    """Draws a scene of a kit and its tools. Some scenes also have clutter: other tools, and
    boxes."""
    grid = PixelGrid()
    kit = drawn.kit
    loose = _draw_loose(len(tools), rng)
    strangers: list[RandomTool] = []
    box_count = 0
    if rng.random() < _CLUTTERED:
        room = max(0, min(_MOST_LOOSE - len(loose), len(others)))
        count = min(int(rng.integers(0, _MOST_STRANGERS + 1)), room)
        strangers = [others[i] for i in rng.choice(len(others), count, replace=False)]
        box_count = int(rng.integers(0, _MOST_BOXES + 1))
    lying = [*(tools[index] for index in loose), *strangers]
    X_WLevel, X_WTools = _draw_poses(kit, lying, grid, rng)
    stand = draw_stand(
        list(_RISERS) if rng.random() < _RAISED else [0.0, 0.0],
        [0.0, _MOST_TILT_DEG if rng.random() < _TILTED else 0.0],
        rng,
    )
    X_WKit = stand.lifted(kit, X_WLevel)
    boxes = draw_boxes(box_count, [(kit, X_WLevel)], lying, X_WTools, grid=grid, rng=rng)
    X_WGoals = [X_WKit @ _pose_in_kit(kit, index) for index in range(len(tools))]
    bodies = [(drawn.text, X_WKit)]
    if stand.riser:
        bodies.append((block_text((*kit.size[:2], stand.riser)), X_WLevel))
    bodies += [(tool_text(tool), X) for tool, X in zip(lying, X_WTools, strict=True)]
    for index in sorted(set(range(len(tools))) - set(loose)):
        dx, dy = np.clip(rng.normal(0, _IN_CAVITY, 2), -0.0015, 0.0015)
        bodies.append((tool_text(tools[index]), RigidTransform([dx, dy, 0.0]) @ X_WGoals[index]))
    bodies += [(block_text(box.size), box.X_WB) for box in boxes]
    noise = _draw_noise(rng)

    standing = [Obstacle(outline_at(block_outline(kit), X_WKit))]
    standing += [
        Obstacle(_outline(tool, X), tool, X) for tool, X in zip(lying, X_WTools, strict=True)
    ]
    standing += [
        Obstacle(outline_at(CrossSection.square(box.size[:2], True), box.X_WB)) for box in boxes
    ]
    found = []
    for place, index in enumerate(loose):
        around = tuple(item for k, item in enumerate(standing) if k != place + 1)
        found.append(LooseTool(tools[index], X_WTools[place], X_WGoals[index], around))
    cameras = dict(Scenario().cameras)
    return DrawnScene(tuple(bodies), tuple(found), cameras, noise, noise_seed)


def _pose_in_kit(kit: Kit, index: int) -> RigidTransform:
    """Returns the pose of a seated tool in the kit's frame."""
    pose = kit.goal(index)
    return RigidTransform(RollPitchYaw(0, 0, pose.yaw), [pose.x, pose.y, pose.z])


def _draw_poses(
    kit: Kit, tools: Sequence[RandomTool], grid: PixelGrid, rng: np.random.Generator
) -> tuple[RigidTransform, Sequence[RigidTransform]]:
    """Draws the kit's pose and the loose tools' poses in the world. Tools may touch or lie on each
    other.

    Raises:
        UserError: there is no room.
    """
    spacing = float(rng.uniform(0.004, 0.02))
    kind = str(rng.choice(list(_STARTS), p=list(_STARTS.values())))
    if len(tools) < 2 and kind in ("touching", "crossed"):
        kind = "apart"
    if kind == "apart":
        return draw_poses(kit, tools, grid=grid, spacing=spacing, yaw_range_deg=180.0, rng=rng)
    if kind == "touching":
        start = draw_unsettled(kit, tools, kind=kind, grid=grid, spacing=spacing, rng=rng)
    else:
        start = draw_start(
            kit,
            tools,
            [convex_body(tool) for tool in tools],
            [[item.grasp for item in tool.grasps] for tool in tools],
            kind=kind,
            tray=False,
            faces="any",
            grid=grid,
            spacing=spacing,
            yaw_range_deg=180.0,
            rng=rng,
            kit_model=False,
        )
    return start.X_WKit, start.X_WTools


def _lies_flat(X_WT: RigidTransform) -> bool:
    upright = X_WT.rotation().matrix()[2, 2] > _FLAT
    return bool(upright and abs(X_WT.translation()[2]) < _ON_TABLE)


def _outline(tool: RandomTool, X_WT: RigidTransform) -> CrossSection:
    """Returns the outline of a tool seen from above, in metres. If the tool does not lie flat, its
    convex hull is used."""
    if _lies_flat(X_WT):
        return outline_at(tool.footprint, X_WT)
    return projected(tool.triangles.reshape(-1, 3), X_WT)


def _draw_loose(count: int, rng: np.random.Generator) -> list[int]:
    """Draws the indices of the loose tools among `count` tools. The other tools are seated."""
    order = rng.permutation(count)
    seated = int(rng.integers(0, count + 1))
    if rng.random() < 0.5:
        seated //= 2
    return sorted(order[max(seated, count - _MOST_LOOSE) :].tolist())


def _actions(number: int, loose: LooseTool) -> list[tuple[float, ...]]:
    """Returns the rows of `StaticScene.actions` for one loose tool."""
    rows: list[tuple[float, ...]] = []
    X_WT, X_WGoal = loose.X_WT, loose.X_WGoal
    if not _lies_flat(X_WT):
        # The tool must be laid flat before it can be placed, so it gets no actions.
        return rows
    yaw = RollPitchYaw(X_WT.rotation()).yaw_angle()
    rotation = RollPitchYaw(X_WGoal.rotation()).yaw_angle() - yaw
    for grasp in loose.tool.grasps:
        pick = X_WT @ np.array([grasp.x, grasp.y, 0.0])
        theta = yaw + grasp.theta
        fingers = rectangle_at(OPEN_FINGERS, pick[0], pick[1], theta)
        if any((fingers ^ other.outline).area() > 1e-9 for other in loose.around):
            continue
        place = X_WGoal @ np.array([grasp.x, grasp.y, 0.0])
        rows.append(
            (number, grasp.cost, pick[0], pick[1], theta, place[0], place[1], theta + rotation)
        )
    return rows


def _in_view(observation: Observation, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns a mask (n,) of the points (n, 2) in the world, in metres, that a camera has in
    view."""
    shape = observation.in_view.shape
    pixels = np.rint([observation.grid.to_pixel(point) for point in points]).reshape(-1, 2)
    inside = ((pixels >= 0) & (pixels < shape)).all(axis=1)
    row, column = np.clip(pixels, 0, np.array(shape) - 1).astype(int).T
    return inside & observation.in_view[row, column]


def _draw_noise(rng: np.random.Generator) -> SensorNoiseParameters:
    """Draws parameters of the camera noise: from no noise to the noise of a poor, badly calibrated
    camera."""
    if rng.random() < 0.25:
        return SensorNoiseParameters()
    severity = rng.uniform(0.0, 1.0, 8)
    return SensorNoiseParameters(
        depth_std=float(0.0035 * severity[0]),
        correlation=float(0.5 + 3 * severity[1]),
        depth_step=float(0.002 * severity[2]),
        flying_share=float(0.5 * severity[3]),
        hole_share=float(0.06 * severity[4]),
        steepest_deg=float(rng.uniform(70.0, 90.0)),
        camera_position_error=float(0.002 * severity[5]),
        camera_angle_error_deg=float(0.15 * severity[5]),
        rig_position_error=float(0.004 * severity[6]),
        rig_angle_error_deg=float(0.4 * severity[7]),
    )
