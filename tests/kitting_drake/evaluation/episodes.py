"""Synthetic episodes, in the format of real ones."""

from pathlib import Path
from typing import Any

from kitting_drake.episode import EpisodeResult
from kitting_drake.episode.episode import ObjectResult
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.schema import Scenario
from kitting_drake.tasks.task import MISPLACED, ActionRecord, PeakForce
from systems.signals import PlanarPose
from systems.success import AddS

CHOSEN = ChosenScenario(Scenario(), Path("mine.yaml"), "mine", None)
ADD_S = AddS(0.0035)
CATEGORIES = ("cup", "bolt", "block", "ring")


def make_object(
    name: str,
    error_mm: float | None,
    *,
    category: str | None = None,
    height_error_mm: float = 0.0,
    angle_error_deg: float = 1.0,
) -> ObjectResult:
    """The result of an object, a success if `error_mm` (its ADD-S) is below 3.5.

    If `error_mm` is None, no goal was left for the object.
    """
    success = error_mm is not None and error_mm < 3.5
    is_strict = abs(height_error_mm) <= 2 and abs(angle_error_deg) <= 20
    return ObjectResult(
        name=name,
        category=category or name,
        add_s_mm=error_mm,
        success=success,
        strict_success=success and is_strict,
        position_error_mm=error_mm,
        angle_error_deg=None if error_mm is None else -angle_error_deg,
        height_error_mm=None if error_mm is None else height_error_mm,
        cause=None if success else MISPLACED,
    )


def make_result(seed: int, objects: list[ObjectResult], **fields: Any) -> EpisodeResult:
    """An episode of equally weighted objects, each with one action."""
    lost = bool(fields.get("failure") or fields.get("timed_out"))
    counted = max(sum(item.add_s_mm is not None for item in objects), 1)
    fields = {
        "success_rate": 0.0 if lost else sum(item.success for item in objects) / counted,
        "strict_success_rate": 0.0
        if lost
        else sum(item.strict_success for item in objects) / counted,
        "sim_seconds": 30.0,
        "wall_seconds": 10.0,
        "failure": None,
        "timed_out": False,
        "moving_at_end": [],
        "stop_reason": "failure" if fields.get("failure") else "done",
    } | fields
    return EpisodeResult(
        scenario="mine",
        policy="oracle",
        seed=seed,
        objects=objects,
        actions=len(objects),
        missed_grasps=0,
        dropped_objects=0,
        stopped_actions=0,
        actions_taken=[_make_action(item) for item in objects],
        point_contact_pairs=0,
        interrupted=False,
        **fields,
    )


def make_episode(seed: int, errors_mm: list[float], **fields: Any) -> dict[str, Any]:
    """An episode as JSON values. Its objects have the given errors, and differ in category."""
    names = CATEGORIES[: len(errors_mm)]
    objects = [make_object(name, error) for name, error in zip(names, errors_mm, strict=True)]
    return make_result(seed, objects, **fields).as_dict()


def make_lost_episode(seed: int) -> dict[str, Any]:
    """An episode whose process died."""
    return make_result(seed, [], failure="its process died").as_dict()


def _make_action(item: ObjectResult) -> ActionRecord:
    error = item.add_s_mm
    return ActionRecord(
        object=item.name,
        category=item.category,
        outcome="placed",
        pick=PlanarPose(),
        place=PlanarPose(),
        pick_position_error_mm=1.0,
        pick_angle_error_deg=2.0,
        place_position_error_mm=None if error is None else 2 * error,
        place_angle_error_deg=None if error is None else 3 * error,
        peak_force_n=PeakForce(12.0, 3.0, "LOWER"),
    )
