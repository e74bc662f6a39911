import dataclasses
import inspect
import subprocess
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydrake.common.yaml import yaml_load

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import SCENARIOS
from kitting_drake.scenario import schema
from kitting_drake.scenario.schema import (
    ArrangedKitting,
    Kitting,
    Learned,
    LookAt,
    Oracle,
    Pinhole,
    Placement,
    PythonPolicy,
    Scenario,
    ToolsetKitting,
    load_scenario,
)

TEST_SCENARIOS = Path(__file__).parent / "test_scenarios.yaml"


def test_defaults():
    assert load_scenario(TEST_SCENARIOS) == Scenario()
    assert load_scenario(TEST_SCENARIOS, "Defaults") == Scenario()


def compare(kind: Any, raw: Any, loaded: Any, where: str, seen: set[type]) -> None:
    """Checks that YAML gives every field of a dataclass and that each arrives where it belongs."""
    if typing.get_origin(kind) is types.UnionType:
        kind = type(loaded)
        assert raw.pop("_tag") == f"!{kind.__name__}", where
    if typing.get_origin(kind) is dict:
        assert raw.keys() == loaded.keys(), where
        for key in raw:
            compare(typing.get_args(kind)[1], raw[key], loaded[key], f"{where}.{key}", seen)
    elif dataclasses.is_dataclass(kind):
        seen.add(typing.cast(type, kind))
        hints = typing.get_type_hints(kind)
        assert raw.keys() == hints.keys(), f"{where} must give every field of {kind}"
        for key, hint in hints.items():
            compare(hint, raw[key], getattr(loaded, key), f"{where}.{key}", seen)
    else:
        assert raw == loaded, where


def test_one_of_everything():
    root = yaml_load(filename=str(TEST_SCENARIOS))
    seen: set[type] = set()
    loaded = load_scenario(TEST_SCENARIOS, "OneOfEverything")
    compare(Scenario, root["OneOfEverything"], loaded, "OneOfEverything", seen)
    # What cannot stand beside it in one scenario.
    hints = typing.get_type_hints(Scenario)
    for name in ("OneOfEverythingElse", "OneOfEverythingLearned", "OneOfEverythingDrawn"):
        other = load_scenario(TEST_SCENARIOS, name)
        for key, raw in root[name].items():
            compare(hints[key], raw, getattr(other, key), f"{name}.{key}", seen)
    declared = {
        item
        for _, item in inspect.getmembers(schema, inspect.isclass)
        if dataclasses.is_dataclass(item) and not item.__name__.startswith("_")
    }
    assert seen == declared


def test_one_of_everything_says_nothing_that_is_the_default():
    """Else a field that is not read would pass."""
    loaded = load_scenario(TEST_SCENARIOS, "OneOfEverything")

    def walk(value: Any, default: Any, where: str) -> None:
        for field in dataclasses.fields(value):
            here, there = getattr(value, field.name), getattr(default, field.name)
            if dataclasses.is_dataclass(here) and dataclasses.fields(here):
                walk(here, there, f"{where}.{field.name}")
            elif not isinstance(here, Oracle):
                assert here != there, f"{where}.{field.name}"

    walk(loaded, Scenario(), "OneOfEverything")


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_the_first_scenario_is_the_default_and_others_go_by_name(tmp_path: Path):
    path = write(tmp_path, "B: {time_limit: 2.0}\nA: {time_limit: 3.0}\n")
    assert load_scenario(path).time_limit == 2.0
    assert load_scenario(path, "A").time_limit == 3.0


def test_text_is_merged_field_by_field(tmp_path: Path):
    path = write(
        tmp_path,
        """
A:
  time_limit: 9.0
  task: !Kitting {tools: [flat_screwdriver], spacing: 0.02}
  cameras: {front: !LookAt {width: 100}, top: !Pinhole {width: 99}}
  planner: {linear_speed: 0.5, home: [0.3, 0.1, 0.4, 0.0]}
""",
    )
    text = """
task: !Kitting {yaw_range_deg: 30.0}
cameras: {top: !Pinhole {height: 77}}
planner: {home: [0.4, 0.0, 0.5, 0.0]}
"""
    before, merged = load_scenario(path), load_scenario(path, text=text)
    assert merged.task == dataclasses.replace(before.task, yaw_range_deg=30.0)
    assert isinstance(merged.task, Kitting)
    assert merged.task.tools == ["flat_screwdriver"]
    assert merged.cameras["top"] == Pinhole(width=99, height=77)
    assert merged.cameras["front"] == LookAt(width=100)
    assert merged.planner.home == [0.4, 0.0, 0.5, 0.0]  # A list is replaced as a whole.
    assert merged.planner.linear_speed == 0.5
    assert merged.time_limit == 9.0


def test_text_without_a_tag_keeps_the_variant(tmp_path: Path):
    path = write(
        tmp_path,
        "A: {task: !ToolsetKitting {split: train}, policy: !Learned {weights: w},"
        " cameras: {top: !LookAt {width: 99}}}",
    )
    text = "{task: {spacing: 0.02}, policy: {orientations: 36}, cameras: {top: {height: 77}}}"
    merged = load_scenario(path, text=text)
    assert merged.task == ToolsetKitting(split="train", spacing=0.02)
    assert merged.policy == Learned(weights="w", orientations=36)
    assert merged.cameras == {"top": LookAt(width=99, height=77)}


def test_text_can_choose_another_variant(tmp_path: Path):
    path = write(tmp_path, "A: {task: !Kitting {spacing: 0.02}}")
    text = "{task: !ArrangedKitting {kit_pose: {x: 0.6}}, policy: !PythonPolicy {function: 'a:b'}}"
    merged = load_scenario(path, text=text)
    assert merged.task == ArrangedKitting(kit_pose=Placement(x=0.6, y=-0.1))
    assert merged.policy == PythonPolicy(function="a:b")
    merged = load_scenario(path, text="{task: !ArrangedKitting {tools: {flat_screwdriver: {}}}}")
    assert list(merged.task.tools) == ["flat_screwdriver"]


def test_arranged_tools_are_those_of_the_file(tmp_path: Path):
    path = write(tmp_path, "A: {task: !ArrangedKitting {tools: {flat_screwdriver: {x: 0.4}}}}")
    assert list(load_scenario(path).task.tools) == ["flat_screwdriver"]


def test_cameras_are_those_of_the_file(tmp_path: Path):
    path = write(tmp_path, "A: {cameras: {top: !Pinhole {}}}")
    assert list(load_scenario(path).cameras) == ["top"]


DEEP = "A: {planner: {hom: [0, 0, 0, 0]}}"
BAD = {
    # Not a mapping of names to scenarios.
    "not YAML": ("A: {", ["mine.yaml, line 1", "not YAML"]),
    "a list": ("[1, 2]", ["mine.yaml", "mapping"]),
    "a number": ("5", ["mine.yaml", "mapping"]),
    "two documents": ("A: {}\n---\nB: {}\n", ["mine.yaml", "not YAML"]),
    "bare fields": ("time_limit: 3.0", ["mine.yaml", "'time_limit' is a field"]),
    "contains itself": ("A: &a {planner: *a}", ["mine.yaml", "contains itself"]),
    "duplicate key": ("A: {time_limit: 1.0, time_limit: 2.0}", ["mine.yaml", "'time_limit'"]),
    "duplicate scenario": ("A: {}\nA: {}\n", ["mine.yaml", "'A' is given twice", "line 2"]),
    # Fields.
    "misspelt field": (DEEP, ["mine.yaml: A", "planner.hom", "did you mean 'home'?"]),
    "unlike any field": ("A: {colour: red}", ["colour", "use one of", "time_limit"]),
    "field of another variant": (
        "A: {task: !ArrangedKitting {spacing: 0.01}}",
        ["task.spacing", "unknown field"],
    ),
    "hand in the table": ("A: {planner: {home: [0.3, 0, -1, 0]}}", ["planner.home[2]", "table"]),
    "more force than there is": (
        "A: {controller: {finger_force_limit: 20.0}}",
        ["planner.grasp_force is 30 N", "controller.finger_force_limit: 20 N"],
    ),
    "unknown tag": ("A: {policy: !Orcle {}}", ["policy", "!Orcle", "!Oracle"]),
    "tag without a value": ("A: {policy: !Oracle }", ["mine.yaml"]),
    "empty value": ("A: {time_limit: }", ["time_limit", "empty"]),
    "empty section": ("A: {planner: }", ["planner", "empty"]),
    # Types.
    "text for a number": ("A: {time_limit: soon}", ["time_limit", "number", "'soon'"]),
    "quoted number": ("A: {time_limit: '3'}", ["time_limit", "number"]),
    "fraction for a whole number": ("A: {random_seed: 1.5}", ["random_seed", "whole"]),
    "truth for a number": ("A: {random_seed: true}", ["random_seed", "whole"]),
    "number for truth": ("A: {sleep: {enabled: 1}}", ["sleep.enabled", "true or false"]),
    "text for a list": ("A: {task: !Kitting {tools: hammer}}", ["task.tools", "list"]),
    "number in a list of texts": ("A: {task: !Kitting {tools: [1]}}", ["task.tools[0]", "text"]),
    "list for a mapping": ("A: {cameras: [1]}", ["cameras", "mapping"]),
    "text for a section": ("A: {policy: Oracle}", ["policy", "mapping"]),
    # Values.
    "out of range": ("A: {planner: {grasp_force: 1000.0}}", ["planner.grasp_force", "1 and 140"]),
    "out of range in a map": ("A: {cameras: {f: !Pinhole {width: 1}}}", ["cameras.f.width"]),
    "out of range in the kit": ("A: {task: !Kitting {kit: {height: 9.0}}}", ["task.kit.height"]),
    "NaN": ("A: {time_limit: .nan}", ["time_limit", "finite"]),
    "NaN in a list": ("A: {planner: {home: [0.1, .nan, 0.5, 0.0]}}", ["planner.home", "finite"]),
    "infinity": ("A: {time_limit: .inf}", ["time_limit", "finite"]),
    "wrong length": ("A: {planner: {home: [1.0, 2.0, 0.5]}}", ["planner.home", "4 numbers"]),
    "time step": ("A: {plant: {time_step: 0.003}}", ["plant.time_step", "1/64"]),
    "contact": ("A: {plant: {contact_approximation: tamsi}}", ["contact_approximation", "sap"]),
    "heights upside down": ("A: {heightmap: {z_max: -0.5}}", ["heightmap.z_max"]),
    "no tools": ("A: {task: !Kitting {tools: []}}", ["task.tools"]),
    "looks straight down": (
        "A: {cameras: {f: !LookAt {position: [0, 0, 1], target: [0, 0, 0]}}}",
        ["cameras.f", "!Pinhole"],
    ),
    "orientations": ("A: {policy: !QuantisedOracle {orientations: 1}}", ["policy.orientations"]),
    "orientations of a network": (
        "A: {policy: !Learned {weights: w, orientations: 4000}}",
        ["policy.orientations", "3600"],
    ),
    "no weights": ("A: {policy: !Learned {}}", ["policy.weights is empty", "train"]),
    "blind": (
        "A: {policy: !Learned {weights: w}, cameras: {}}",
        ["cameras is empty: this policy needs at least one"],
    ),
    "no function": ("A: {policy: !PythonPolicy {function: mine}}", ["policy.function", "mine"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(tmp_path: Path, case: str):
    text, words = BAD[case]
    with pytest.raises(UserError) as caught:
        load_scenario(write(tmp_path, text))
    message = str(caught.value)
    assert str(tmp_path / "mine.yaml") in message
    assert "\n" not in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("", id="empty"),
        pytest.param("# Only a comment.\n", id="comment"),
        pytest.param("1: {}", id="number for a name"),
        pytest.param("? [a]\n: 1\n", id="list for a name"),
        pytest.param("A: {? {b: 1} : 1}", id="mapping for a field"),
    ],
)
def test_odd_but_parsable_files_are_the_users_to_mend(tmp_path: Path, text: str):
    with pytest.raises(UserError, match=r"mine\.yaml"):
        load_scenario(write(tmp_path, text))


def test_files_that_cannot_be_read(tmp_path: Path):
    with pytest.raises(UserError, match=r"none\.yaml: No such file"):
        load_scenario(tmp_path / "none.yaml")
    with pytest.raises(UserError, match="Is a directory"):
        load_scenario(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\x80\xff\xfe\x00A: {}")
    with pytest.raises(UserError, match=r"binary\.yaml: it is not a text file"):
        load_scenario(tmp_path / "binary.yaml")


def test_an_unknown_name_is_told_with_the_known_ones():
    with pytest.raises(UserError, match="no scenario 'Default': use one of Defaults, OneOf"):
        load_scenario(TEST_SCENARIOS, "Default")


def test_bad_text_is_told_apart_from_a_bad_file():
    with pytest.raises(UserError, match=r"^--scenario_text: planner\.hom is an unknown field"):
        load_scenario(TEST_SCENARIOS, text="{planner: {hom: 1}}")
    with pytest.raises(UserError, match=r"^--scenario_text.* is not YAML"):
        load_scenario(TEST_SCENARIOS, text="{planner: ")
    with pytest.raises(UserError, match=r"^--scenario_text must be a mapping"):
        load_scenario(TEST_SCENARIOS, text="faster")


def test_a_range_holds_for_file_and_text_together(tmp_path: Path):
    """Each is right by itself: it is the sum that cannot be."""
    path = write(tmp_path, "A: {heightmap: {z_max: 0.1}}")
    with pytest.raises(UserError, match=r"--scenario_text: heightmap\.z_max must be above"):
        load_scenario(path, text="{heightmap: {z_min: 0.2}}")


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_scenarios_load(path: Path):
    names = yaml.compose(path.read_text(), Loader=yaml.SafeLoader).value
    assert names
    for key, _ in names:
        load_scenario(path, key.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("A: {planner: {hom: 1}}", "planner.hom is an unknown field: did you mean 'home'?"),
        ("A: {task: !Kitting {tools: [spoon]}}", "there is no tool 'spoon'"),
    ],
)
def test_bad_input_on_the_command_line(
    tmp_path: Path,
    verb: Callable[..., subprocess.CompletedProcess[str]],
    text: str,
    words: str,
):
    done = verb("run", write(tmp_path, text), "--no-meshcat", "--output", tmp_path / "out")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("out/*"))
