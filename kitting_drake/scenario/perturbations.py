"""Named sets of imperfections for the flag `--perturb`. Each set gives values to fields of the
scenario.

The same fields can be set in a scenario's YAML. All random draws depend only on the episode's seed.
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
        # Give all surfaces of the fixtures the same colour, so that cavities are not marked by
        # their colour.
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
"""In these fields, a lower value perturbs more. In all other fields, a higher value does."""

NAMES = (*_OVERLAYS, "all")


def perturbation(text: str, scenario: Scenario) -> dict[str, Any]:
    """Returns the fields that a value of `--perturb` sets, to be merged over the scenario's own.

    The result is a nested mapping as YAML gives it, with tags under the key `_tag`.

    Args:
        text: `NAME[:LEVEL],...`. The default level is `moderate`. `all` means all perturbations
            that apply to the scenario's task.
        scenario: the scenario to perturb. Its own values are kept where they perturb more.

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
    """Whether the scenario's task allows a perturbation and has the field for it."""
    if name in scenario.task.not_perturbed:
        return False
    fields = {item.name for item in dc.fields(scenario.task)}
    return "task" not in _OVERLAYS[name][0] or name in fields


def _keep_worse(overlay: dict[str, Any], found: object) -> None:
    """Replaces numbers in `overlay` by the scenario's own numbers where those perturb more."""
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
