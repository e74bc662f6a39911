"""Made-up episodes, for tests of what is made of them."""

from collections.abc import Callable
from typing import Any

import pytest

from kitting_drake.hkd.tool import CATEGORIES


@pytest.fixture(scope="session")
def made_up_episode() -> Callable[..., dict[str, Any]]:
    """Makes a line of `episodes.jsonl` out of an error for each category in turn."""

    def make(seed: int, errors_mm: list[float], failure: str | None = None) -> dict[str, Any]:
        errors = dict(zip(CATEGORIES, errors_mm, strict=False))
        objects = [
            {
                "name": f"my_{category}",
                "category": category,
                "success": error < 3.5,
                "add_s_mm": error,
                "position_error_mm": error,
                "angle_error_deg": -error,
                "height_error_mm": 0.0,
                "cause": None if error < 3.5 else "jammed",
            }
            for category, error in errors.items()
        ]
        actions = [
            {
                "object": f"my_{category}",
                "category": category,
                "outcome": "placed",
                "pick_position_error_mm": 1.0,
                "pick_angle_error_deg": 2.0,
                "place_position_error_mm": 2 * error,
                "place_angle_error_deg": 3 * error,
            }
            for category, error in errors.items()
        ]
        succeeded = sum(error < 3.5 for error in errors_mm)
        return {
            "seed": seed,
            "objects": objects,
            "actions_taken": actions,
            "success_rate": 0.0 if failure else succeeded / len(errors_mm),
            "missed_grasps": 0,
            "dropped_objects": 0,
            "sim_seconds": 30.0,
            "wall_seconds": 10.0,
            "point_contact_pairs": 0,
            "failure": failure,
        }

    return make
