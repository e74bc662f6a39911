"""The kitting tasks, which put hand tools into the cavities of kits."""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.generation.part_models import is_part_kind, sized_part
from kitting_drake.hkd.grasps.all_grasps import all_grasps
from kitting_drake.hkd.kits.kit import Kit, make_kit
from kitting_drake.hkd.kits.layout import MOST_TOOLS
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.fine_tool import fine_tool
from kitting_drake.hkd.tools.scaling import scaled_tool, weighted_tool
from kitting_drake.hkd.tools.tool import Tool
from kitting_drake.hkd.tools.toolsets import SPLITS, toolsets
from kitting_drake.policies.data.learning import Learning
from kitting_drake.tasks.boxes import box_object
from kitting_drake.tasks.kitting import diagnosis
from kitting_drake.tasks.kitting.kit_scene import PosedKit, kitting_scene
from kitting_drake.tasks.kitting.kit_stands import (
    MOST_RISER,
    MOST_TILT_DEG,
    draw_stand,
)
from kitting_drake.tasks.kitting.starts import APART, check_start, cluttered_scene, draw_start
from kitting_drake.tasks.kitting.tool_loading import (
    ANNOTATE,
    check_count,
    check_grasps,
    load_tools,
    tool_files,
)
from kitting_drake.tasks.kitting.tool_poses import draw_boxes, draw_kit_poses
from kitting_drake.tasks.task import ActionRecord, Scene, TaskConfig
from systems.bounds import bounded
from systems.contact_guard import HEAVIEST
from systems.hand_geometry import MAX_OPENING
from systems.placement import Placement
from systems.signals import PixelGrid

_MOST_KITS = 4
_JAW_MARGIN = 0.012
"""The open jaws must be wider than a scaled tool by at least this, in metres."""

SEEN = "kitting-seen-toolset"
UNSEEN = "kitting-unseen-toolsets"
"""Title of the paper's task with unseen toolsets (section V-B.1)."""

_TITLES = {"train": "kitting-train-toolsets", "test": UNSEEN, "fresh": "kitting-fresh-toolsets"}
"""For each split, the title of the task that draws toolsets from it, if all other parameters have
their defaults."""


@dataclass
class KittingTask(TaskConfig):
    """The parameters and scoring shared by all kitting tasks."""

    # The kit block and its cavities.
    kit: KitParameters = field(default_factory=KitParameters)

    # Number of actions allowed per tool; the paper's tasks allow one.
    tries: int = bounded(1, 1, 10)

    # A tool is placed if its ADD-S is below this, in m (section IV-C of the paper).
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

    def fitted(self, tools: Sequence[Tool]) -> list[Tool]:
        """Returns the tools with the collision geometry that the kit's clearance requires.

        Raises:
            UserError: a tool's surface is not closed.
        """
        if not self.kit.is_tight:
            return list(tools)
        return [fine_tool(tool, self.kit.closing_radius) for tool in tools]

    def kit_of(self, tools: Sequence[Tool]) -> Kit:
        """Makes the kit of some tools. Raises UserError if they do not fit into one."""
        try:
            return make_kit(tools, self.kit.with_fine_walls())
        except UserError as error:
            raise type(error)(f"task.kit: {error}") from error


@dataclass
class _DrawnKitting(KittingTask):
    """Kitting tasks that draw the poses of tools and kit from the seed."""

    # Least distance between any two of the tools and kits, in m.
    spacing: float = bounded(0.008, 0.0, 0.2)

    # Tools and kit are rotated by random angles of at most this to either side, in degrees.
    yaw_range_deg: float = bounded(180.0, 0.0, 180.0)

    # Whether the oracle takes the tools in random order. If not, it takes them in the listed order.
    random_order: bool = True

    # Number of boxes without a cavity that lie on the table as clutter. There are fewer if there is
    # no room.
    distractors: int = bounded(0, 0, 12)

    # Range from which each tool's mass is drawn, in kg. With [0, 0] tools have their own masses.
    tool_mass: list[float] = bounded([0.0, 0.0], 0.0, 3.0)

    # Number of kits. The tools are distributed among them at random, as evenly as possible.
    kits: int = bounded(1, 1, _MOST_KITS)

    # Range from which the height of the riser under each kit is drawn, in m.
    riser: list[float] = bounded([0.0, 0.0], 0.0, MOST_RISER)

    # Range from which the tilt of each kit is drawn, in degrees. The direction of the tilt is
    # random.
    tilt_deg: list[float] = bounded([0.0, 0.0], 0.0, MOST_TILT_DEG)

    # How the tools lie at the start: apart, touching (side by side, 0 to 3 mm apart), crossed (one
    # across another), leaning (half of them, at most four, against the kit block's sides), or heap
    # (fallen from about 150 mm). Except for apart, a simulation lets the tools come to rest.
    start: str = APART

    # Whether the tools start in a shallow tray.
    tray: bool = False

    # The face on which tools may lie. as_drawn: all tools lie on the face that is at the bottom in
    # their cavities. any: in a heap, tools may come to rest on another face.
    faces: str = "as_drawn"

    @property
    def not_perturbed(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of perturbations that do not apply. `distractors` applies only with `start: apart`
        and `tray: false`."""
        return () if self.start == APART and not self.tray else ("distractors",)

    def _draw_scene(
        self, tools: list[Tool], grid: PixelGrid, seed: int, models: Sequence[Tool] = ()
    ) -> Scene:
        """Draws the scene of tools and their kits. The cavities are made for `models`, one for each
        tool; if `models` is empty, for the tools themselves."""
        tools = self.fitted(self._weighted(tools, seed))
        if self.start != APART or self.tray:
            return self._draw_settled(self.kit_of(tools), tools, grid, seed)
        # Draw the tools and the stand of each kit from separate random streams, so that these draws
        # do not change the poses.
        shares = self._shares(len(tools), np.random.default_rng([seed, 6]))
        kits = [self.kit_of([(models or tools)[index] for index in share]) for share in shares]
        stand_rng = np.random.default_rng([seed, 7])
        stands = [draw_stand(self.riser, self.tilt_deg, stand_rng) for _ in kits]
        rng = np.random.default_rng(seed)
        X_WLevels, X_WTools = draw_kit_poses(
            kits,
            tools,
            grid=grid,
            spacing=self.spacing,
            yaw_range_deg=self.yaw_range_deg,
            rng=rng,
            margins=[stand.margin(kit) for stand, kit in zip(stands, kits, strict=True)],
        )
        order = rng.permutation(len(tools)) if self.random_order else np.arange(len(tools))
        boxes = draw_boxes(
            self.distractors,
            list(zip(kits, X_WLevels, strict=True)),
            tools,
            X_WTools,
            grid=grid,
            rng=np.random.default_rng([seed, 3]),
        )
        distractors = [
            box_object(f"distractor_{number}", "distractor", box.size, box.colour, box.X_WB)
            for number, box in enumerate(boxes, start=1)
        ]
        posed = [
            PosedKit(
                kit,
                stand.lifted(kit, X_WLevel),
                share,
                stand.fixture("riser" if number == 1 else f"riser_{number}", kit, X_WLevel),
            )
            for number, (kit, stand, X_WLevel, share) in enumerate(
                zip(kits, stands, X_WLevels, shares, strict=True), start=1
            )
        ]
        scene = kitting_scene(posed, tools, X_WTools, order, self.success_threshold)
        return dataclasses.replace(
            scene,
            objects=(*scene.objects, *distractors),
            max_actions=self.tries * len(tools),
        )

    def _weighted(self, tools: list[Tool], seed: int) -> list[Tool]:
        """Returns the tools with random masses from `tool_mass`, equal for identical tools."""
        least, greatest = self.tool_mass
        if not greatest:
            return tools
        masses = np.random.default_rng([seed, 9]).uniform(least, greatest, len(tools)).tolist()
        drawn = {
            (tool.directory, tool.length): mass for tool, mass in zip(tools, masses, strict=True)
        }
        return [weighted_tool(tool, drawn[tool.directory, tool.length]) for tool in tools]

    def _shares(self, count: int, rng: np.random.Generator) -> list[tuple[int, ...]]:
        """For each kit, the indices of its tools."""
        if count < self.kits:
            raise UserError(
                f"task.kits is {self.kits}, but there are only {count} tools: give fewer kits"
            )
        if count > MOST_TOOLS * self.kits:
            raise UserError(
                f"task.kits is {self.kits}, but {count} tools need more kits, because a kit holds "
                f"up to {MOST_TOOLS}"
            )
        if self.kits == 1:
            return [tuple(range(count))]
        mixed = rng.permutation(count).tolist()
        return [tuple(sorted(mixed[number :: self.kits])) for number in range(self.kits)]

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
        posed = PosedKit(kit, start.X_WKit, tuple(range(len(tools))))
        scene = kitting_scene([posed], tools, start.X_WTools, order, self.success_threshold)
        return cluttered_scene(
            scene, kit, [grasps[i] for i in order], start, grid, self.tries * len(tools)
        )

    def validate(self) -> None:
        for name in ("riser", "tilt_deg", "tool_mass"):
            least, greatest = getattr(self, name)
            if least > greatest:
                raise ValueError(
                    f"task.{name} must be [least, greatest], not [{least:g}, {greatest:g}]"
                )
        least, greatest = self.tool_mass
        if (least == 0) != (greatest == 0):
            raise ValueError(
                "task.tool_mass must be [least, greatest], both positive, or [0, 0], not "
                f"[{least:g}, {greatest:g}]"
            )
        check_start(self.start, self.tray, self.faces, self.distractors)
        if (self.start != APART or self.tray) and (
            self.kits > 1 or any(self.riser + self.tilt_deg)
        ):
            raise ValueError(
                "task.kits, task.riser and task.tilt_deg need 'start: apart' and 'tray: false', "
                f"but task.start is '{self.start}' and task.tray is {str(self.tray).lower()}"
            )


@dataclass
class Kitting(_DrawnKitting):
    """A kit and its tools in random poses. With default parameters it is the paper's task
    kitting-seen-toolset."""

    # The tools, 1 to 12 for each kit, with repetitions if you like: names of folders in
    # models/tools, paths of other tool folders, or simple parts such as ring_40x20x10
    # (docs/sizes.md).
    tools: list[str] = field(
        default_factory=lambda: [
            "claw_hammer",
            "slip_joint_pliers",
            "combination_wrench",
            "flat_screwdriver",
        ]
    )

    # The tools for which the cavities are made, one for each of `tools`: for example, the same
    # tools as traced from photos. If empty, the cavities are made for `tools` themselves.
    cavities: list[str] = field(default_factory=list)

    @property
    def title(self) -> str:
        return SEEN if self == Kitting() else "kitting"

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        tools = load_tools(self.tools, base)
        models = load_tools(self.cavities, base, "task.cavities")
        check_grasps(tools, ANNOTATE)
        return self._draw_scene(tools, grid, seed, models)

    def input_files(self, base: Path) -> list[Path]:
        return [*tool_files(self.tools, base), *tool_files(self.cavities, base)]

    def validate(self) -> None:
        super().validate()
        check_count(len(self.tools), self.kits)
        if self.cavities and len(self.cavities) != len(self.tools):
            raise ValueError(
                f"task.cavities names {len(self.cavities)} tools, but must name "
                f"{len(self.tools)}, one for each of task.tools"
            )
        if self.cavities and (self.start != APART or self.tray):
            raise ValueError(
                "task.cavities needs 'start: apart' and 'tray: false', but task.start is "
                f"'{self.start}' and task.tray is {str(self.tray).lower()}"
            )


@dataclass
class ToolsetKitting(_DrawnKitting):
    """Random tools from a pool, and their kit, in random poses. With default parameters it is the
    paper's task kitting-unseen-toolsets."""

    # The pool of tools: train or test (section IV-B.1 of the paper), or fresh, which shares no
    # tools with them.
    split: str = "test"

    # A custom pool that replaces the split: names or paths of tool folders, or kinds of simple
    # parts such as ring (docs/sizes.md). One tool of each category is drawn.
    pool: list[str] = field(default_factory=list)

    # Number of tools to draw from the whole pool or split, regardless of their categories. With 0,
    # one tool of each category is drawn. No tool occurs twice unless the pool is too small.
    count: int = bounded(0, 0, MOST_TOOLS * _MOST_KITS)

    # Whether to scale tools to random lengths from the range tool_length, in m (section IV-B.2 of
    # the paper). If not, tools keep their own lengths. If a tool would become too wide for the
    # jaws, too high for the kit or heavier than 3 kg, it gets the largest allowed length. Simple
    # parts also get random proportions.
    random_lengths: bool = True
    tool_length: list[float] = bounded([0.15, 0.20], 0.015, 0.35)

    @property
    def title(self) -> str:
        unchanged = self == ToolsetKitting(split=self.split)
        return _TITLES.get(self.split, "kitting") if unchanged else "kitting"

    def make_scene(self, *, grid: PixelGrid, seed: int, base: Path) -> Scene:
        names = self._draw_names(seed, base)
        if self.random_lengths:
            tools = self._drawn_lengths(names, seed, base)
            advice = "set random_lengths: false, or another tool_length"
        else:
            tools, advice = load_tools(names, base), ANNOTATE
        check_grasps(tools, advice)
        return self._draw_scene(tools, grid, seed)

    def _draw_names(self, seed: int, base: Path) -> list[str]:
        # Use separate random streams for tools, lengths and poses, so that a change of one draw
        # does not change the others.
        rng = np.random.default_rng([seed, 1])
        if not self.count:
            choices = self._toolsets(base)
            return list(choices[rng.integers(len(choices))])
        pool = self.pool or sorted({name for names in toolsets(self.split) for name in names})
        rounds = -(-self.count // len(pool))
        return [pool[i] for _ in range(rounds) for i in rng.permutation(len(pool))][: self.count]

    def _drawn_lengths(self, names: list[str], seed: int, base: Path) -> list[Tool]:
        """Loads the tools and gives them random lengths. Simple parts also get random
        proportions."""
        least, greatest = self.tool_length
        lengths = np.random.default_rng([seed, 2]).uniform(least, greatest, len(names))
        shapes = np.random.default_rng([seed, 8]).uniform(size=(len(names), 2))
        whole = load_tools([name for name in names if not is_part_kind(name)], base)
        loaded = iter(whole)
        tools = []
        for name, length, (u, v) in zip(names, lengths.tolist(), shapes.tolist(), strict=True):
            if is_part_kind(name):
                tools.append(sized_part(name, length, (u, v)))
                continue
            tool = next(loaded)
            longest = _longest(tool, self.kit)
            tools.append(scaled_tool(tool, longest if least <= longest < length else length))
        return tools

    def _toolsets(self, base: Path) -> list[tuple[str, ...]]:
        if not self.pool:
            return toolsets(self.split)
        kinds: dict[str, list[str]] = {}
        for name, tool in zip(self.pool, load_tools(self.pool, base, "task.pool"), strict=True):
            kinds.setdefault(tool.category, []).append(name)
        return list(itertools.product(*kinds.values()))

    def input_files(self, base: Path) -> list[Path]:
        return tool_files(self.pool, base)

    def validate(self) -> None:
        super().validate()
        if self.split not in SPLITS:
            raise ValueError(f"task.split must be one of {', '.join(SPLITS)}, not '{self.split}'")
        least, greatest = self.tool_length
        if least > greatest:
            raise ValueError(
                f"task.tool_length must be [least, greatest], not [{least:g}, {greatest:g}]"
            )
        check_start(self.start, self.tray, self.faces, self.distractors)


def _longest(tool: Tool, kit: KitParameters) -> float:
    """The largest length, in metres, at which a scaled tool fits the jaws and the kit's height, and
    weighs at most `HEAVIEST` kg."""
    factor = min(
        (MAX_OPENING - _JAW_MARGIN) / tool.grasp.width,
        (kit.height - kit.minimum_wall) / tool.height,
        (HEAVIEST / tool.mass) ** (1 / 3),
    )
    return 0.999 * factor * tool.length
