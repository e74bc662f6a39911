"""Reads scenarios from YAML. Errors name the file and the field."""

import dataclasses as dc
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_load_typed
from pydrake.multibody.plant import MultibodyPlantConfig

from kitting_drake.common.errors import UserError
from kitting_drake.scenario.cameras import check_camera
from kitting_drake.scenario.own_task import is_own_task, load_own_task
from kitting_drake.scenario.perturbations import perturbation
from kitting_drake.scenario.schema import Scenario
from kitting_drake.scenario.yaml_input.yaml_check import check_yaml
from kitting_drake.scenario.yaml_input.yaml_text import dumped, parse
from kitting_drake.tasks import PythonTask, Task
from systems.bounds import check_bounds
from systems.hand_geometry import JOINT_LIMITS

_APPROXIMATIONS = ("lagged", "similar", "sap")

_PLAINLY_BELOW = 0.02
"""A negative heightmap.z_min must be at least this far below the table, in m. A smaller distance
cannot be told from a calibration error of the cameras (see `systems.surface_heights`)."""


def load_scenario(
    path: Path, name: str | None = None, text: str | None = None, perturb: str | None = None
) -> Scenario:
    """Reads a scenario.

    Args:
        path: a YAML file that maps names to scenarios.
        name: the name of the scenario; None for the first.
        text: YAML to merge over the scenario. Mappings are merged field by field; other values are
            replaced. A mapping without a tag keeps the type of the value over which it is merged. A
            camera that is set to null is removed.
        perturb: perturbations (see `scenario.perturbations`), merged before `text`.

    Raises:
        UserError: the file cannot be read, or a field is invalid.
    """
    root = _read(path)
    names = _names(root)
    fields = {item.name for item in dc.fields(Scenario)}
    if names and not set(names) - fields:
        raise UserError(
            f"{path}: '{names[0]}' is a field, not a scenario: put the fields under a name"
        )
    if name is None:
        if not names:
            raise UserError(f"{path} holds no scenario")
        name = names[0]
    if name not in root:
        raise UserError(f"{path} has no scenario '{name}': use one of {', '.join(names)}")
    base = path.resolve().parent
    scenario = _load(root[name], Scenario(), f"{path}: {name}", base)
    if perturb is not None:
        overlay = perturbation(perturb, scenario)
        # The last matching paint wins. A merge appends new patterns, but would leave an existing
        # pattern at its position. So remove existing patterns first.
        kept = {
            name: paint
            for name, paint in scenario.appearance.paints.items()
            if name not in overlay.get("appearance", {}).get("paints", {})
        }
        scenario = dc.replace(scenario, appearance=dc.replace(scenario.appearance, paints=kept))
        raw, defaults = _onto(overlay, scenario)
        scenario = _load(raw, defaults, "--perturb", base, merged=True)
    if text is not None:
        raw, defaults = _onto(parse(text, "--scenario_text"), scenario)
        scenario = _load(raw, defaults, "--scenario_text", base, merged=True)
    return scenario


def scenario_names(path: Path) -> list[str]:
    """The names of the scenarios in a YAML file.

    Raises:
        UserError: the file cannot be read.
    """
    return _names(_read(path))


def _read(path: Path) -> dict[str, Any]:
    try:
        content = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise UserError(f"cannot read the scenario {path}: {reason}") from error
    return parse(content, str(path))


def _names(root: dict[str, Any]) -> list[str]:
    # Names with these beginnings hold YAML anchors by convention. They are not scenarios.
    return [name for name in root if not name.startswith(("x-", "."))]


def _onto(raw: dict, defaults: Scenario) -> tuple[dict, Scenario]:
    """Returns the YAML and the defaults, prepared for merging.

    Drake reads an untagged mapping as the first type of a union. This function therefore adds the
    tag of the default's type. If the YAML selects another type of task, the defaults get the
    default task of that type. Mappings in the YAML then replace this task's mappings. Cameras that
    are null in the YAML are removed from both.

    Raises:
        UserError: a camera that is null does not exist.
    """
    tagged = dict(raw)
    for name in ("task", "policy", "robot"):
        if name in raw:
            tagged[name] = _of_variant(raw[name], getattr(defaults, name))
    task = tagged.get("task")
    if isinstance(task, dict):
        defaults = dc.replace(defaults, task=_without_mappings(task, defaults.task))
    cameras = raw.get("cameras")
    if isinstance(cameras, dict):
        kept = {name: camera for name, camera in cameras.items() if camera is not None}
        removed = cameras.keys() - kept.keys()
        if unknown := removed - defaults.cameras.keys():
            known = ", ".join(defaults.cameras)
            raise UserError(
                f"--scenario_text: there is no camera '{min(unknown)}' to remove: "
                + (f"use one of {known}" if known else "the scenario has none")
            )
        left = {name: item for name, item in defaults.cameras.items() if name not in removed}
        defaults = dc.replace(defaults, cameras=left)
        tagged["cameras"] = _of_variants(kept, left)
    appearance = raw.get("appearance")
    if isinstance(appearance, dict) and "paints" in appearance:
        paints = _of_variants(appearance["paints"], defaults.appearance.paints)
        tagged["appearance"] = {**appearance, "paints": paints}
    return tagged, defaults


def _without_mappings(given: dict, current: Task) -> Task:
    """Returns the task onto which `given` is merged.

    This is `current`, unless `given` has another type. Then it is the default task of that type.
    Mappings in the default task are emptied if `given` has them too, so that `given` replaces them.
    """
    for variant in typing.get_args(Task):
        if variant is PythonTask:
            continue
        if given["_tag"] == f"!{variant.__name__}" and not isinstance(current, variant):
            fresh = variant()
            emptied: dict[str, Any] = {
                item.name: {}
                for item in dc.fields(variant)
                if item.name in given and isinstance(getattr(fresh, item.name), dict)
            }
            return dc.replace(fresh, **emptied)
    return current


def _of_variant(given: object, current: object) -> object:
    """If `given` is a mapping without a tag, adds the tag of the type of `current`."""
    return {"_tag": f"!{type(current).__name__}", **given} if isinstance(given, dict) else given


def _of_variants(given: object, current: Mapping[str, object]) -> object:
    """Applies `_of_variant` to each value of `given` that has a counterpart of the same name in
    `current`."""
    if not isinstance(given, dict):
        return given
    return {
        name: _of_variant(value, current[name]) if name in current else value
        for name, value in given.items()
    }


def _load(
    raw: Any, defaults: Scenario, where: str, base: Path, *, merged: bool = False
) -> Scenario:
    """Loads a scenario from a mapping; absent fields keep their values in `defaults`.

    Args:
        raw: the mapping, as `parse` returns it.
        defaults: the values of absent fields.
        where: name of the mapping in error messages.
        base: the folder of the scenario's file.
        merged: whether mappings from names, such as cameras or tools, are merged with the default
            ones instead of replacing them.
    """
    try:
        raw = {} if raw is None else raw
        if isinstance(raw, dict) and is_own_task(raw.get("task"), defaults.task):
            own = load_own_task(raw["task"], defaults.task, base)
            defaults = dc.replace(defaults, task=own)
            raw = {key: value for key, value in raw.items() if key != "task"}
        check_yaml(Scenario, raw, "")
        scenario = defaults
        if raw:
            scenario = yaml_load_typed(
                schema=Scenario,
                data=dumped(raw),
                defaults=defaults,
                retain_map_defaults=merged,
            )
        check_bounds(scenario)
        _check_meaning(scenario)
    except (ValueError, RuntimeError) as error:
        text = str(error).splitlines()[0]
        raise UserError(f"{where}: {text}") from error
    return scenario


def _check_plant(plant: MultibodyPlantConfig) -> None:
    """Checks that the station can simulate a plant with this configuration."""
    approximation = plant.discrete_contact_approximation
    if approximation not in _APPROXIMATIONS:
        raise ValueError(
            f"plant.discrete_contact_approximation must be {' or '.join(_APPROXIMATIONS)}, "
            f"not '{approximation}'"
        )
    if not 1e-5 <= plant.time_step <= 0.02:
        raise ValueError(f"plant.time_step must be from 1e-05 to 0.02, not {plant.time_step:g}")
    if not plant.use_sampled_output_ports:
        raise ValueError(
            "plant.use_sampled_output_ports must be true: the robot feels forces by it"
        )
    steps = (1 / 64) / plant.time_step
    if abs(steps - round(steps)) > 1e-9 or steps < 1:
        raise ValueError(
            f"plant.time_step must divide 1/64 s, the planner's period, but is {plant.time_step:g}"
        )


def _check_meaning(scenario: Scenario) -> None:
    """Checks the constraints that types and ranges cannot express."""
    _check_plant(scenario.plant)
    if scenario.heightmap.z_min > 0:
        raise ValueError(
            f"heightmap.z_min is {scenario.heightmap.z_min:g}, but the heightmap must include the "
            "table, which is at 0: use 0 or less"
        )
    if -_PLAINLY_BELOW < scenario.heightmap.z_min < 0:
        raise ValueError(
            f"heightmap.z_min is {scenario.heightmap.z_min:g}, but heights so close below the "
            f"table may be calibration errors: use 0, or -{_PLAINLY_BELOW:g} or less"
        )
    if scenario.heightmap.z_max <= scenario.heightmap.z_min:
        raise ValueError(
            f"heightmap.z_max is {scenario.heightmap.z_max:g}, but must be above heightmap.z_min, "
            f"which is {scenario.heightmap.z_min:g}"
        )
    scenario.robot.validate(scenario.heightmap.grid())
    scenario.task.validate()
    scenario.appearance.validate()
    for key, camera in scenario.cameras.items():
        try:
            check_camera(camera)
        except ValueError as error:
            raise ValueError(f"cameras.{key} {error}") from error
    planner = scenario.planner
    for index, (axis, (low, high)) in enumerate(JOINT_LIMITS.items()):
        if not low <= planner.home[index] <= high:
            raise ValueError(
                f"planner.home[{index}] is {planner.home[index]:g}, but the hand's {axis} must be "
                f"between {low:g} and {high:g}"
            )
    lowest = scenario.heightmap.z_max + planner.travel_clearance
    if planner.home[2] < lowest:
        raise ValueError(
            f"planner.home[2] is {planner.home[2]:g}, where the hand could hit objects: use at "
            f"least {lowest:g} (heightmap.z_max + planner.travel_clearance)"
        )
    if planner.grasp_depth > planner.max_grasp_depth:
        raise ValueError(
            f"planner.grasp_depth is {planner.grasp_depth:g}, but must be at most "
            f"planner.max_grasp_depth, which is {planner.max_grasp_depth:g}"
        )
    limit = scenario.controller.finger_force_limit
    for name in ("grasp_force", "firm_grasp_force"):
        force = getattr(planner, name)
        if force > limit:
            raise ValueError(
                f"planner.{name} is {force:g} N, but must be at most {limit:g} N "
                "(controller.finger_force_limit)"
            )
    scenario.policy.validate()
    if scenario.policy.needs_observation and not scenario.cameras:
        raise ValueError("cameras is empty: this policy needs at least one camera")
