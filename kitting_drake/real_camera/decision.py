"""Turns camera frames into an action in the robot's base frame, and the heights of its motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from kitting_drake.policies.choices import Choice
from kitting_drake.real_camera.calibrations.calibration import Calibration
from kitting_drake.real_camera.checking.agreement import check_agreement
from kitting_drake.real_camera.checking.table_check import check_table
from kitting_drake.real_camera.checking.views import (
    CalibrationError,
    check_frames,
    check_lenses,
    check_views,
    observe,
    seen_share,
)
from kitting_drake.real_camera.deciders import BenchPolicy
from kitting_drake.real_camera.frames import Frame
from kitting_drake.real_camera.robots.bench_robot import BenchRobot
from systems.arm_trajectory import ArmTrajectory
from systems.motion_heights import MotionHeights, motion_heights
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import (
    STOP_REASONS,
    Observation,
    PickPlaceAction,
    PlanarPose,
    SurfaceHeights,
    wrap_to_pi,
)
from systems.surface_heights import read_surface_heights

_SEEN_TO_STOP = 0.7
"""A policy may report that nothing is left to do only if at least this share of the pixels in view
has a measured height. With less, an object may be hidden, and the result is `not seen`."""


@dataclass(frozen=True)
class BenchDecision:
    """An action with its heights and confidence, or a refusal."""

    result: str
    """`pick and place`, `press`, `done`, `no kit seen`, `nothing fits`, `not sure`, `not seen` or
    `calibration`."""
    reason: str
    """A sentence that explains the result."""
    observation: Observation
    """The observation o_t."""
    seen: float
    """The share, from 0 to 1, of o_t's pixels in view that have a measured height."""
    choice: Choice
    surfaces: SurfaceHeights
    heights: MotionHeights
    """The heights of the motion; for a stop they are meaningless."""
    parameters: PickPlaceParameters
    warnings: list[str] = field(default_factory=list)
    """Doubts about the calibration, a sentence each."""
    trajectory: ArmTrajectory | None = None
    """The joint trajectory of the action; None for a stop or without a robot."""

    @property
    def action(self) -> PickPlaceAction:
        """The pick and place or the press, in the base frame; for all other results, a stop."""
        return self.choice.action

    @property
    def in_view(self) -> float:
        """The share of the workspace that the cameras look at, from 0 to 1."""
        return float(self.observation.in_view.mean())

    @property
    def place_height(self) -> float:
        """The height of the fingertips when the object stands at its place, in metres.

        The fingertips are as far above the floor of the place as they were above the object's
        support at the pick. The floor's height is read from o_t.
        """
        hanging = max(self.heights.grasp - self.surfaces.support, 0.0)
        return max(self.surfaces.place_floor + hanging, self._lowest)

    @property
    def _lowest(self) -> float:
        return self.surfaces.table + self.parameters.floor_clearance

    def as_dict(self) -> dict[str, Any]:
        """Returns the content of `action.json`, in metres and radians in the base frame
        (docs/bench.md)."""
        action, heights = self.action, self.heights
        result: dict[str, Any] = {
            "result": self.result,
            "reason": self.reason,
            "stop": action.stop,
            "confidence": self.choice.confidence,
            "confidence_parts": self.choice.parts,
            "in_view": round(self.in_view, 3),
            "seen": round(self.seen, 3),
            "warnings": self.warnings,
        }
        if action.stop:
            return result
        result["press"] = action.press
        result["pick"] = {
            "x": action.pick.x,
            "y": action.pick.y,
            "z": self.surfaces.pick_top if action.press else heights.grasp,
            "yaw": wrap_to_pi(action.pick.theta),
            "jaw_opening": 0.0 if action.press else self.parameters.open_width,
            "hover_z": heights.pick_hover,
        }
        result["travel"] = {"empty_z": heights.clear, "holding_z": heights.travel}
        if not action.press:
            result["place"] = {
                "x": action.place.x,
                "y": action.place.y,
                "z": self.place_height,
                "yaw": wrap_to_pi(action.place.theta),
                "hover_z": heights.place_hover,
                "lowest_z": self._lowest,
                "rim_z": self.surfaces.place_rim,
            }
        return result

    def draw(self) -> bytes:
        """Draws the decision as a PNG."""
        # Import matplotlib lazily.
        from kitting_drake.evaluation.decision_figure import draw_action, draw_decision

        title = f"{self.result}: {self.reason}" if self.reason else self.result
        if self.choice.decision is not None:
            return draw_decision(self.observation, self.choice.decision, title=title)
        action = self.choice.refused or self.choice.action
        return draw_action(self.observation, action, title=title)


def decide(
    frames: Mapping[str, Frame],
    calibration: Calibration,
    policy: BenchPolicy,
    failed_picks: Sequence[PlanarPose] = (),
    *,
    parameters: PickPlaceParameters | None = None,
    robot: BenchRobot | None = None,
) -> BenchDecision:
    """Decides on one action, with the same heightmap and policies as the simulated cell.

    The decision is to act only if the cameras see the table where it should be and agree about what
    is on it, pick and place are visible enough, and the action is likely to succeed. With a robot,
    the action must also be in reach: if the first one is not, actions for other objects are tried.

    Args:
        frames: each camera's frame by its name.
        calibration: the cameras' calibration.
        policy: `load_policy()` or `ShapeMatching()`; create it once.
        failed_picks: the poses of failed grasps in the base frame, which the policy avoids.
        parameters: the parameters of the motion, which determine its heights; None for the
            simulated cell's defaults.
        robot: the arm for which to plan a joint trajectory; None to plan none and not to check the
            reach.

    Raises:
        UserError: frames, calibration and policy do not fit together, or the robot cannot reach its
            home.
    """
    policy.check_grid(calibration.grid)
    parameters = PickPlaceParameters() if parameters is None else parameters
    checked = check_frames(frames, calibration)
    observation = observe(checked, calibration)
    seen = seen_share(observation)
    try:
        check_views(checked, calibration)
        warnings = check_lenses(calibration)
        warnings += check_table(checked, calibration) + check_agreement(checked, calibration)
    except CalibrationError as error:
        return _stopped("calibration", str(error), observation, seen, parameters)
    out_of_reach: tuple[Choice, str] | None = None
    for choice in policy.choices(observation, failed_picks):
        action = choice.action
        if action.stop:
            return _refused(choice, observation, seen, parameters, warnings)
        surfaces = read_surface_heights(observation, action.pick, action.place)
        trajectory = None if robot is None else robot.plan(action, surfaces, parameters)
        if not isinstance(trajectory, str):
            return BenchDecision(
                "press" if action.press else "pick and place",
                choice.reason,
                observation,
                seen,
                choice,
                surfaces,
                motion_heights(surfaces, parameters),
                parameters,
                warnings,
                trajectory,
            )
        out_of_reach = out_of_reach or (choice, trajectory)
    assert out_of_reach is not None  # A policy makes at least one choice.
    choice, said = out_of_reach
    stopped = choice.stopped(said)
    return _stopped("not sure", said, observation, seen, parameters, stopped, warnings)


def _refused(
    choice: Choice,
    observation: Observation,
    seen: float,
    parameters: PickPlaceParameters,
    warnings: Sequence[str],
) -> BenchDecision:
    """Returns the decision for a choice to stop."""
    result = choice.action.reason or "done"
    said = choice.reason or STOP_REASONS.get(choice.action.reason, "nothing is left to do")
    if result != "not seen" and seen < _SEEN_TO_STOP:
        result = "not seen"
        said = (
            f"only {100 * seen:.0f} % of the pixels in view are measured: an object may be hidden"
        )
    return _stopped(result, said, observation, seen, parameters, choice, warnings)


def _stopped(
    result: str,
    reason: str,
    observation: Observation,
    seen: float,
    parameters: PickPlaceParameters,
    choice: Choice | None = None,
    warnings: Sequence[str] = (),
) -> BenchDecision:
    surfaces = SurfaceHeights()
    heights = motion_heights(surfaces, parameters)
    if choice is None:
        choice = Choice(PickPlaceAction(stop=True), None)
    return BenchDecision(
        result, reason, observation, seen, choice, surfaces, heights, parameters, list(warnings)
    )
