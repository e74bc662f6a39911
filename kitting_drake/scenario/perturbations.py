"""Named sets of imperfections for the flag `--perturb`. Each sets fields of the scenario.

A scenario's YAML can give the same fields. All random draws depend on the episode's seed alone.
"""

import dataclasses as dc
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.scenario.schema import Scenario

LEVELS = ("mild", "moderate", "severe")

_DRAWN = {"_tag": "!Drawn"}
_OVERLAYS: dict[str, tuple[dict[str, Any], ...]] = {
    "colour": (
        {"appearance": {"paints": {"*": {**_DRAWN, "spread": 0.15}}}},
        {"appearance": {"paints": {"*": _DRAWN}}},
        # All surfaces of the fixtures share one colour, so that cavities do not stand out.
        {"appearance": {"paints": {"*": _DRAWN, "fixtures/*": {**_DRAWN, "shared": True}}}},
    ),
    "light": (
        {"appearance": {"drawn_lights": 0.3}},
        {"appearance": {"drawn_lights": 0.6}},
        {"appearance": {"drawn_lights": 0.9}},
    ),
    "depth_noise": tuple(
        {
            "sensor_noise": {
                "depth_std": 0.001 * scale,
                "depth_step": 0.0005 * scale,
                "flying_share": 0.1 * scale,
            }
        }
        for scale in (1, 2, 4)
    ),
    "depth_holes": (
        {"sensor_noise": {"hole_share": 0.01, "steepest_deg": 85.0}},
        {"sensor_noise": {"hole_share": 0.03, "steepest_deg": 80.0}},
        {"sensor_noise": {"hole_share": 0.08, "steepest_deg": 70.0}},
    ),
    "calibration": tuple(
        {
            "sensor_noise": {
                "rig_position_error": 0.001 * scale,
                "rig_angle_error_deg": 0.1 * scale,
                "camera_position_error": 0.0004 * scale,
                "camera_angle_error_deg": 0.04 * scale,
            }
        }
        for scale in (1, 3, 6)
    ),
    "friction": tuple({"variation": {"friction": share}} for share in (0.15, 0.3, 0.5)),
    "mass": tuple({"variation": {"mass": share}} for share in (0.15, 0.3, 0.5)),
    "distractors": tuple({"task": {"distractors": count}} for count in (2, 4, 8)),
}
_WORSE_IF_LESS = ("steepest_deg",)
"""Fields whose lower values are less perfect. For all others, higher values are."""

NAMES = (*_OVERLAYS, "all")


def perturbation(text: str, scenario: Scenario) -> dict[str, Any]:
    """The scenario fields that a value of `--perturb` sets, to merge over the scenario's own.

    They are a nested mapping as from YAML; tags are under the key `_tag`.

    Args:
        text: `NAME[:LEVEL],...`. The default level is `moderate`. `all` means all perturbations
            that apply to the scenario's task.
        scenario: the scenario to perturb. Its values stay where they are less perfect.

    Raises:
        UserError: a name or level is unknown, a name is given twice, or a perturbation does not
            apply to the scenario's task.
    """
    levels: dict[str, str] = {}
    for item in text.split(","):
        name, colon, level = item.strip().partition(":")
        level = level if colon else "moderate"
        if name not in NAMES:
            raise UserError(f"--perturb: unknown name '{name}': use one of {', '.join(NAMES)}")
        if level not in LEVELS:
            raise UserError(f"--perturb: {name} has no level '{level}': use {', '.join(LEVELS)}")
        if name in levels:
            raise UserError(f"--perturb: {name} is given twice")
        levels[name] = level
    everything = levels.pop("all", None)
    if everything is not None:
        chosen = {name: everything for name in _OVERLAYS if _applies(name, scenario)}
        levels = chosen | levels
    overlay: dict[str, Any] = {}
    for name, level in levels.items():
        if not _applies(name, scenario):
            task = type(scenario.task).__name__
            raise UserError(f"--perturb: {name} does not apply to the task !{task}")
        _merge(overlay, _OVERLAYS[name][LEVELS.index(level)])
    _keep_worse(overlay, scenario)
    return overlay


def _applies(name: str, scenario: Scenario) -> bool:
    """Whether the task has the fields of a perturbation and permits it."""
    if name in scenario.task.not_perturbed:
        return False
    fields = {item.name for item in dc.fields(scenario.task)}
    return "task" not in _OVERLAYS[name][0] or name in fields


def _keep_worse(overlay: dict[str, Any], found: object) -> None:
    """Keeps the scenario's number wherever it is less perfect than the overlay's."""
    for name, value in overlay.items():
        given = getattr(found, name)
        if isinstance(value, dict) and dc.is_dataclass(given):
            _keep_worse(value, given)
        elif isinstance(value, int | float) and given is not None:
            overlay[name] = min(value, given) if name in _WORSE_IF_LESS else max(value, given)


def _merge(into: dict[str, Any], given: dict[str, Any]) -> None:
    for key, value in given.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = dict(value) if isinstance(value, dict) else value
