import dataclasses
import types
import typing
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydrake.common.yaml import yaml_load

from kitting_drake.common.paths import SCENARIOS
from kitting_drake.scenario import Scenario, load_scenario
from kitting_drake.scenario.description import describe
from kitting_drake.scenario.policies import Learned, Policy
from kitting_drake.scenario.yaml_input.drake_configs import struct_fields
from kitting_drake.tasks import Kitting, PythonTask, Task, ToolsetKitting
from systems.bounds import check_bounds

TEST_SCENARIOS = Path(__file__).parent / "test_scenarios.yaml"
ONE_OF_EVERYTHING = [
    name for name in yaml_load(filename=str(TEST_SCENARIOS)) if name.startswith("OneOfEverything")
]


SETTLED = {"start", "tray", "faces"}
APART = {
    Learned: {"avoid_failed_picks", "least_confidence"},
    Kitting: SETTLED,
    ToolsetKitting: SETTLED,
}
"""By class, the fields that `OneOfEverything` cannot give, because they exclude other fields.
`policies_test` and `starts_test` cover them."""


def reachable(kind: Any) -> set[type]:
    """The dataclasses of the schema that can occur in a value of type `kind`, and `kind` itself."""
    if kind is PythonTask:  # `own_task_test` covers own tasks.
        return set()
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        below = [reachable(hints[item.name]) for item in dataclasses.fields(kind)]
        return {typing.cast(type, kind)}.union(*below)
    return set().union(*map(reachable, typing.get_args(kind)))


def is_struct(value: Any) -> bool:
    """Whether a value is one of Drake's config structs."""
    return struct_fields(type(value)) is not None


def agrees(raw: Any, described: Any) -> bool:
    """Whether the description of a Drake config contains all values of the YAML."""
    if not isinstance(raw, dict):
        return bool(raw == described)
    # YAML gives a rotation without the name of its only field, `value`.
    inner = described if raw.keys() <= described.keys() else described["value"]
    return all(agrees(value, inner[name]) for name, value in raw.items())


def check_given(
    kind: Any, raw: Any, loaded: Any, default: Any, where: str, *, whole: bool = True
) -> set[type]:
    """Checks that every YAML value was loaded, and that none equals its field's default.

    If a value equalled the default, one could not tell whether the field was read.

    Args:
        kind: the type in the schema.
        raw: what YAML gives, untyped.
        loaded: the value that was loaded.
        default: the value of the field if YAML omits it; None if it has no default.
        where: the path of the field, for messages.
        whole: whether every field of a dataclass must be given.

    Returns:
        The dataclasses found.
    """
    if isinstance(kind, types.UnionType) and (
        dataclasses.is_dataclass(loaded) or is_struct(loaded)
    ):
        kind = type(loaded)
        assert raw.pop("_tag") == f"!{kind.__name__}", where
    if typing.get_origin(kind) is dict:
        assert raw.keys() == loaded.keys(), where
        item_kind = typing.get_args(kind)[1]
        below = [check_given(item_kind, raw[k], loaded[k], None, f"{where}.{k}") for k in raw]
        return set().union(*below)
    if typing.get_origin(kind) is list and dataclasses.is_dataclass(typing.get_args(kind)[0]):
        item_kind = typing.get_args(kind)[0]
        pairs = enumerate(zip(raw, loaded, strict=True))
        below = [check_given(item_kind, r, v, None, f"{where}[{i}]") for i, (r, v) in pairs]
        return set().union(*below)
    if struct_fields(kind) is not None:
        default = kind() if type(default) is not kind else default
        for name, value in raw.items():
            assert agrees(value, describe(getattr(loaded, name))), f"{where}.{name}"
            assert not agrees(value, describe(getattr(default, name))), f"{where}.{name}: default"
        return set()
    if not dataclasses.is_dataclass(kind):
        assert raw == loaded, where
        assert loaded != default, f"{where} is the default"
        return set()
    if type(default) is not kind:
        default = kind()
    hints = typing.get_type_hints(kind)
    names = {item.name for item in dataclasses.fields(kind)}
    given = raw.keys() | APART.get(kind, set())
    assert given == names or not whole, f"{where} must give every field of {kind}"
    below = [
        check_given(hints[k], raw[k], getattr(loaded, k), getattr(default, k), f"{where}.{k}")
        for k in raw
    ]
    return {kind}.union(*below)


def test_defaults():
    assert describe(load_scenario(TEST_SCENARIOS)) == describe(Scenario())
    assert describe(load_scenario(TEST_SCENARIOS, "Defaults")) == describe(Scenario())


def test_one_of_everything():
    root = yaml_load(filename=str(TEST_SCENARIOS))
    seen: set[type] = set()
    for name in ONE_OF_EVERYTHING:
        loaded = load_scenario(TEST_SCENARIOS, name)
        # Only the first scenario must give all fields of `Scenario`.
        whole = name == "OneOfEverything"
        seen |= check_given(Scenario, root[name], loaded, Scenario(), name, whole=whole)
    assert seen >= reachable(Scenario) - reachable(Task) - reachable(Policy)


def test_every_variant_of_task_and_policy_is_in_some_scenario():
    """Other tests run or build all scenarios of these files, so every variant is tested."""
    seen = set()
    for path in (TEST_SCENARIOS, *SCENARIOS.rglob("*.yaml")):
        for key, _ in yaml.compose(path.read_text(), Loader=yaml.SafeLoader).value:
            scenario = load_scenario(path, key.value)
            seen |= {type(scenario.task), type(scenario.policy)}
    assert seen == {*typing.get_args(Task), *typing.get_args(Policy)} - {PythonTask}


def test_defaults_are_within_their_bounds():
    for kind in reachable(Scenario):
        check_bounds(kind())


@pytest.mark.parametrize("path", sorted(SCENARIOS.rglob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_scenarios_load(path: Path):
    names = yaml.compose(path.read_text(), Loader=yaml.SafeLoader).value
    assert names
    for key, _ in names:
        load_scenario(path, key.value)
