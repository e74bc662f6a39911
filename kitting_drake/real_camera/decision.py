"""From frames to an action in the robot's base frame, with its heights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import Calibration
from kitting_drake.real_camera.deciders import BenchPolicy, Choice
from kitting_drake.real_camera.frames import Frame
from kitting_drake.real_camera.views import observe, seen_share
from systems.motion_heights import MotionHeights, motion_heights
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PickPlaceAction, PlanarPose, SurfaceHeights, wrap_to_pi
from systems.surface_heights import read_surface_heights

_SEEN_TO_STOP = 0.7
"""With a smaller share of pixels seen, a stop is an error: an object may be hidden."""


@dataclass(frozen=True)
class BenchDecision:
    """An action with its heights and confidence."""

    observation: Observation
    """o_t."""
    seen: float
    """The seen share of its pixels in view of the cameras, from 0 to 1."""
    choice: Choice
    surfaces: SurfaceHeights
    heights: MotionHeights
    """Surfaces and heights are meaningless for a stop."""
    parameters: PickPlaceParameters

    @property
    def action(self) -> PickPlaceAction:
        """Pick and place in the base frame."""
        return self.choice.action

    @property
    def place_height(self) -> float:
        """The height of the fingertips when the object stands at its place, in metres: as far above
        the floor there, seen in o_t, as they were above its support at the pick."""
        hanging = max(self.heights.grasp - self.surfaces.support, 0.0)
        return max(self.surfaces.place_floor + hanging, self._lowest)

    @property
    def _lowest(self) -> float:
        return self.surfaces.table + self.parameters.floor_clearance

    def as_dict(self) -> dict[str, Any]:
        """The content of `action.json`, in metres and radians in the base frame; docs/bench.md."""
        action, heights = self.action, self.heights
        result: dict[str, Any] = {
            "stop": action.stop,
            "confidence": self.choice.confidence,
            "confidence_parts": self.choice.parts,
            "seen": round(self.seen, 3),
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
        return self.choice.draw()


def decide(
    frames: Mapping[str, Frame],
    calibration: Calibration,
    policy: BenchPolicy,
    failed_picks: Sequence[PlanarPose] = (),
    *,
    parameters: PickPlaceParameters | None = None,
) -> BenchDecision:
    """One decision, with the same heightmap and policies as the simulated cell.

    Args:
        frames: of each camera by its name.
        calibration: of the cameras.
        policy: `load_policy()` or `ShapeMatching()`; make it once.
        failed_picks: where grasps failed before, in the base frame; it avoids them.
        parameters: of the motion, for its heights; None for the cell's.

    Raises:
        UserError: frames, calibration and policy do not fit together, or the policy would stop
            although too little is seen.
    """
    policy.check_grid(calibration.grid)
    observation = observe(frames, calibration)
    choice = policy.choose(observation, failed_picks)
    seen = seen_share(observation, calibration)
    if choice.action.stop and seen < _SEEN_TO_STOP:
        raise UserError(
            f"only {100 * seen:.0f} % of what is in view is seen, too little to say that nothing "
            "is left to do: find the cause with --check"
        )
    parameters = PickPlaceParameters() if parameters is None else parameters
    surfaces = SurfaceHeights()
    if not choice.action.stop:
        surfaces = read_surface_heights(observation, choice.action.pick, choice.action.place)
    heights = motion_heights(surfaces, parameters)
    return BenchDecision(observation, seen, choice, surfaces, heights, parameters)
