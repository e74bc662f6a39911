"""Reads scenarios from YAML; a mistake is told by its file and field."""

import dataclasses as dc
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydrake.common.yaml import yaml_load, yaml_load_typed

from kitting_drake.common.errors import UserError
from kitting_drake.scenario.cameras import check_camera
from kitting_drake.scenario.perturbations import perturbation
from kitting_drake.scenario.schema import Scenario
from kitting_drake.scenario.yaml_check import check_yaml
from kitting_drake.tasks import Task
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
            given is that of what is merged over.
        perturb: perturbations (see `scenario.perturbations`), merged over it before `text`.

    Raises:
        UserError: the file cannot be used; names the file and the field.
    """
    try:
        content = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise UserError(f"cannot read the scenario {path}: {reason}") from error
    root = _parse(content, str(path))
    names = list(root)
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
    scenario = _load(root[name], content, name, Scenario(), f"{path}: {name}")
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
        scenario = _load(raw, _dumped(raw), None, defaults, "--perturb")
    if text is not None:
        raw, defaults = _onto(_parse(text, "--scenario_text"), scenario)
        scenario = _load(raw, _dumped(raw), None, defaults, "--scenario_text")
    return scenario


class _Dumper(yaml.SafeDumper):
    """Writes what Drake's `yaml_load` reads: the tag of a mapping is under `_tag`."""


def _represent_tagged(dumper: yaml.SafeDumper, data: dict[str, Any]) -> yaml.Node:
    tag = data.get("_tag", "tag:yaml.org,2002:map")
    return dumper.represent_mapping(tag, {k: v for k, v in data.items() if k != "_tag"})


_Dumper.add_representer(dict, _represent_tagged)


def _dumped(raw: dict) -> str:
    """The YAML of a mapping. Drake's `yaml_dump` would sort it: but of paints the later one wins,
    and tools are taken in their order."""
    return yaml.dump(raw, Dumper=_Dumper, sort_keys=False)


def _parse(content: str, where: str) -> dict:
    try:
        # A Python mapping swallows a field that is given twice.
        node = yaml.compose(content, Loader=yaml.SafeLoader)
        _check_names(node)
        # It would be dropped without a word.
        if isinstance(node, yaml.MappingNode) and node.tag != "tag:yaml.org,2002:map":
            raise ValueError(f"the tag {node.tag} at the beginning means nothing there")
        # Drake takes an empty text for no text at all.
        root = yaml_load(data=content) if content.strip() else None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it cannot be parsed"
        raise UserError(f"{where}{line} is not YAML: {problem}") from error
    except ValueError as error:
        raise UserError(f"{where}: {error}") from error
    except RecursionError as error:
        raise UserError(f"{where} is not YAML that ends: it contains itself") from error
    if root is None:
        return {}
    if not isinstance(root, dict):
        raise UserError(f"{where} must be a mapping of names, not a {type(root).__name__}")
    return root


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
    if "cameras" in raw:
        tagged["cameras"] = _of_variants(raw["cameras"], defaults.cameras)
    appearance = raw.get("appearance")
    if isinstance(appearance, dict) and "paints" in appearance:
        paints = _of_variants(appearance["paints"], defaults.appearance.paints)
        tagged["appearance"] = {**appearance, "paints": paints}
    return tagged, defaults


def _without_mappings(given: dict, current: Task) -> Task:
    """The task to merge `given` over: of another variant than `current`, its defaults, but for the
    mappings that are given."""
    for variant in typing.get_args(Task):
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


def _check_names(node: yaml.Node | None) -> None:
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            line = key.start_mark.line + 1
            if key.tag != "tag:yaml.org,2002:str":
                raise ValueError(f"the name on line {line} must be a text")
            if key.value == "_tag":
                raise ValueError(f"'_tag' on line {line} is no field: write !Name before the value")
            if key.value in seen:
                raise ValueError(f"'{key.value}' is given twice (again on line {line})")
            seen.add(key.value)
            _check_names(value)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_names(item)


def _load(raw: object, content: str, name: str | None, defaults: Scenario, where: str) -> Scenario:
    try:
        check_yaml(Scenario, raw if raw is not None else {}, "")
        if raw is None or raw == {}:
            scenario = defaults
        else:
            scenario = yaml_load_typed(
                schema=Scenario,
                data=content,
                child_name=name,
                defaults=defaults,
                # A file's cameras and tools replace the default ones; --scenario_text adds.
                retain_map_defaults=name is None,
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
