"""Reads scenarios from YAML; a mistake is told by its file and field."""

import dataclasses as dc
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_load_typed

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
"""A grid that begins so far below the table, in m, is not taken for one that is off (see
`systems.surface_heights`)."""


def load_scenario(
    path: Path, name: str | None = None, text: str | None = None, perturb: str | None = None
) -> Scenario:
    """Reads a scenario.

    Args:
        path: the YAML file: a mapping from names to scenarios.
        name: which one; the first when None.
        text: YAML merged over it: mappings field by field, all else replaced; a tag that is not
            given is that of what is merged over. A camera that is null is removed.
        perturb: perturbations (see `scenario.perturbations`), merged over it before `text`.

    Raises:
        UserError: the file cannot be used; names the file and the field.
    """
    try:
        content = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise UserError(f"cannot read the scenario {path}: {reason}") from error
    root = parse(content, str(path))
    # By YAML's custom such names hold parts that others refer to.
    names = [name for name in root if not name.startswith(("x-", "."))]
    fields = {item.name for item in dc.fields(Scenario)}
    if names and not set(names) - fields:
        raise UserError(
            f"{path}: '{names[0]}' is a field, not a scenario: put the fields under a name of yours"
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
        # Of paints the later one wins, and a name that is given again would keep its place.
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


def _onto(raw: dict, defaults: Scenario) -> tuple[dict, Scenario]:
    """Makes ready what is merged over a scenario.

    Drake reads a mapping without a tag as the first variant of its union; here it is of the variant
    that it is merged over. And where a tag brings another variant, nothing of its default mappings
    is to remain beside what is given.
    """
    tagged = dict(raw)
    for name in ("task", "policy"):
        if name in raw:
            tagged[name] = _of_variant(raw[name], getattr(defaults, name))
    task = tagged.get("task")
    if isinstance(task, dict):
        defaults = dc.replace(defaults, task=_without_mappings(task, defaults.task))
    cameras = raw.get("cameras")
    if isinstance(cameras, dict):
        kept = {name: camera for name, camera in cameras.items() if camera is not None}
        removed = cameras.keys() - kept.keys()
        left = {name: item for name, item in defaults.cameras.items() if name not in removed}
        defaults = dc.replace(defaults, cameras=left)
        tagged["cameras"] = _of_variants(kept, left)
    appearance = raw.get("appearance")
    if isinstance(appearance, dict) and "paints" in appearance:
        paints = _of_variants(appearance["paints"], defaults.appearance.paints)
        tagged["appearance"] = {**appearance, "paints": paints}
    return tagged, defaults


def _without_mappings(given: dict, current: Task) -> Task:
    """The task to merge `given` over: of another variant than `current`, its defaults, but for the
    mappings that are given."""
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
    """A mapping with the tag of a variant, if it has none of its own."""
    return {"_tag": f"!{type(current).__name__}", **given} if isinstance(given, dict) else given


def _of_variants(given: object, current: Mapping[str, object]) -> object:
    """The same for each of a mapping's values that there is already."""
    if not isinstance(given, dict):
        return given
    return {
        name: _of_variant(value, current[name]) if name in current else value
        for name, value in given.items()
    }


def _load(
    raw: Any, defaults: Scenario, where: str, base: Path, *, merged: bool = False
) -> Scenario:
    """Loads a mapping over defaults.

    Args:
        raw: the mapping, as `parse` returns it.
        defaults: what it does not give.
        where: what to call it in errors.
        base: the folder of the scenario's file.
        merged: whether mappings of names (cameras, tools) are added to the default ones; else they
            replace them.
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


def _check_meaning(scenario: Scenario) -> None:
    """Checks what neither types nor ranges say."""
    approximation = scenario.plant.discrete_contact_approximation
    if approximation not in _APPROXIMATIONS:
        raise ValueError(
            f"plant.discrete_contact_approximation must be {' or '.join(_APPROXIMATIONS)}, "
            f"not '{approximation}'"
        )
    if not 1e-5 <= scenario.plant.time_step <= 0.02:
        raise ValueError(
            f"plant.time_step must be from 1e-05 to 0.02, not {scenario.plant.time_step:g}"
        )
    steps = (1 / 64) / scenario.plant.time_step
    if abs(steps - round(steps)) > 1e-9 or steps < 1:
        raise ValueError(
            "plant.time_step must divide 1/64 s, the planner's period, "
            f"not be {scenario.plant.time_step:g}"
        )
    if scenario.heightmap.z_min > 0:
        raise ValueError(
            f"heightmap.z_min is {scenario.heightmap.z_min:g}: the table, at 0, must be seen, as "
            "the hand goes by its height"
        )
    if -_PLAINLY_BELOW < scenario.heightmap.z_min < 0:
        raise ValueError(
            f"heightmap.z_min is {scenario.heightmap.z_min:g}: so little below the table it would "
            f"pass for an error of calibration: use 0, or -{_PLAINLY_BELOW:g} and less"
        )
    if scenario.heightmap.z_max <= scenario.heightmap.z_min:
        raise ValueError("heightmap.z_max must be above heightmap.z_min")
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
                f"planner.home[{index}] is {planner.home[index]:g}, beyond the hand's {axis}, "
                f"{low:g} to {high:g}"
            )
    lowest = scenario.heightmap.z_max + planner.travel_clearance
    if planner.home[2] < lowest:
        raise ValueError(
            f"planner.home[2] is {planner.home[2]:g}: the hand would sweep across the table below "
            f"what may stand there (heightmap.z_max + planner.travel_clearance: {lowest:g})"
        )
    if planner.grasp_depth > planner.max_grasp_depth:
        raise ValueError("planner.grasp_depth is more than planner.max_grasp_depth")
    for name in ("grasp_force", "firm_grasp_force"):
        force = getattr(planner, name)
        if force > scenario.controller.finger_force_limit:
            raise ValueError(
                f"planner.{name} is {force:g} N, more than the fingers can press "
                f"(controller.finger_force_limit: {scenario.controller.finger_force_limit:g} N)"
            )
    scenario.policy.validate()
    if scenario.policy.needs_observation and not scenario.cameras:
        raise ValueError("cameras is empty: this policy needs at least one to see by")
