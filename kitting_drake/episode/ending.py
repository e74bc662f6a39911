"""Finds the objects left over at the end of an episode, and judges the reason for stopping.

The judgement uses true poses, which policies cannot see.
"""

import math
from dataclasses import dataclass

from pydrake.systems.framework import Context

from kitting_drake.station import KittingStation
from systems.placement import GONE

_NOTHING_TO_DO = ("done", "nothing fits")
"""The reasons that policies give if they stop because no more objects can be placed."""
_UNJUDGED = ("", "interrupted")


@dataclass(frozen=True)
class Position:
    """A position on the table, in the world, in metres."""

    x: float
    y: float


@dataclass(frozen=True)
class Remainder:
    """The objects and goals left over: the value of `left_over` in `results.json`."""

    objects: tuple[Position, ...] = ()
    """Positions of the objects that are not placed."""
    cavities: tuple[Position, ...] = ()
    """Positions of the goals that are not filled."""
    source: str = "state"
    """The origin of the lists. `policy`: the policy reported them when it stopped. `state`: they
    are the unfilled goals, and the objects that could fill a goal, in the true state."""

    @property
    def text(self) -> str:
        """A description in words; empty if nothing is left over."""
        parts = [
            f"{len(points)} {name if len(points) == 1 else plural} at "
            + ", ".join(f"({point.x:.2f}, {point.y:.2f})" for point in points)
            for name, plural, points in (
                ("object", "objects", self.objects),
                ("cavity", "cavities", self.cavities),
            )
            if points
        ]
        return " and ".join(parts)


def find_left_over(station: KittingStation, root_context: Context) -> Remainder:
    """Finds the objects and goals that are left over.

    If the policy reported them when it stopped, its report is returned. Otherwise they are computed
    from the true state.
    """
    action = station.accepted_action(root_context)
    if action.stop and action.left_over is not None:
        seen = action.left_over
        lists = (seen.objects, seen.cavities)
        left, open_ = (tuple(Position(float(x), float(y)) for x, y in points) for points in lists)
        return Remainder(left, open_, "policy")
    goals, objects = station.scene.goals, station.objects
    loose, free = _loose_and_free(station, root_context)
    poses = station.object_poses(root_context)
    counted = set(station.scene.goal_objects)
    points = [poses[i] @ objects[i].p_BMiddle for i in loose if i in counted]
    places = [goals[i].poses[0] @ objects[goals[i].objects[0]].p_BMiddle for i in free]
    return Remainder(
        tuple(Position(*map(float, point[:2])) for point in points),
        tuple(Position(*map(float, place[:2])) for place in places),
    )


def is_right(reason: str, station: KittingStation, root_context: Context) -> bool | None:
    """Whether the reason for stopping is right, judged by the true state.

    Something is left to do if an unfilled goal accepts an object that lies in the cell and fills no
    goal.

    - `done`: right if nothing is left to do.
    - `nothing fits`: right if an object or a goal is left, but no object fits an unfilled goal.
    - All others (`gave up`, `not sure`, `not seen`, `no kit seen`, `actions spent`, `time`,
      `failure`): right if something is left to do. `actions spent` is also right if the last
      action filled the last goal, because the policy is not asked again.

    Whether a goal is filled is decided by the task's measure of success for `done` and `nothing
    fits`, and by strict success for the others. So an object that protrudes, which the task's
    measure may tolerate, is a right reason to give up.

    Args:
        reason: a value of `stop_reason`.
        station: the station of the episode.
        root_context: the root context of the outermost Diagram, at the end.

    Returns:
        Whether the reason is right; None for `interrupted`, and before the end.
    """
    if reason in _UNJUDGED:
        return None
    loose, free = _loose_and_free(station, root_context, strict=reason not in _NOTHING_TO_DO)
    goals = station.scene.goals
    is_left = any(index in goals[goal].objects for goal in free for index in loose)
    if reason == "actions spent" and not free:
        history = station.history(root_context)
        return bool(history) and history[-1].outcome in ("placed", "pressed")
    if reason not in _NOTHING_TO_DO:
        return is_left
    return not is_left and (reason == "done" or bool(loose or free))


def _loose_and_free(
    station: KittingStation, root_context: Context, *, strict: bool = False
) -> tuple[list[int], list[int]]:
    """The indices of the objects in the cell that fill no goal, and of the goals that are not
    filled.

    Args:
        station: the station of the episode.
        root_context: the root context of the outermost Diagram.
        strict: whether only strict successes fill a goal.
    """
    placements = station.placements(root_context)
    kept = station.kept_goals(root_context)
    succeeds = [item.strict_success if strict else item.success for item in placements]
    filled = {item.goal for item, good in zip(placements, succeeds, strict=True) if good} | kept
    loose = []
    for index, X_WB in enumerate(station.object_poses(root_context)):
        distance = math.hypot(*X_WB.translation())
        # The comparison is also false if the distance is NaN.
        if not succeeds[index] and distance < GONE:
            loose.append(index)
    return loose, [index for index in range(len(station.scene.goals)) if index not in filled]
