import dataclasses
from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.scenario import load_scenario
from kitting_drake.scenario.cameras import LookAt, Pinhole
from kitting_drake.scenario.policies import Learned, PythonPolicy
from kitting_drake.tasks import ArrangedKitting, Kitting, ToolsetKitting
from kitting_drake.tasks.kitting.kit_stands import KitPose
from systems.insertion_search import InsertionSearch

TEST_SCENARIOS = Path(__file__).parent / "test_scenarios.yaml"


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_selects_the_first_scenario_or_the_named_one(tmp_path: Path):
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
  planner: {linear_speed: 0.5, home: [0.3, 0.1, 0.4, 0.0], search: {press: 0.002}}
""",
    )
    text = """
task: !Kitting {yaw_range_deg: 30.0}
cameras: {top: !Pinhole {height: 77}}
planner: {home: [0.4, 0.0, 0.5, 0.0], search: {amplitude: 0.0}}
"""
    before, merged = load_scenario(path), load_scenario(path, text=text)
    assert merged.task == dataclasses.replace(before.task, yaw_range_deg=30.0)
    assert isinstance(merged.task, Kitting)
    assert merged.task.tools == ["flat_screwdriver"]
    assert merged.cameras["top"] == Pinhole(width=99, height=77)
    assert merged.cameras["front"] == LookAt(width=100)
    assert merged.planner.home == [0.4, 0.0, 0.5, 0.0]  # Lists are replaced, not merged.
    assert merged.planner.linear_speed == 0.5
    assert merged.planner.search == InsertionSearch(press=0.002, amplitude=0.0)
    assert merged.time_limit == 9.0


def test_text_removes_and_replaces_cameras(tmp_path: Path):
    path = write(tmp_path, "A: {cameras: {front: !LookAt {width: 100}, top: !Pinhole {}}}")
    text = "cameras: {front: null, side: !LookAt {height: 77}}"
    assert load_scenario(path, text=text).cameras == {
        "top": Pinhole(),
        "side": LookAt(height=77),
    }
    # If the text chooses another variant, no fields of the old one are kept.
    text = "cameras: {front: !Pinhole {height: 88}}"
    assert load_scenario(path, text=text).cameras["front"] == Pinhole(height=88)


def test_anchors_and_merge_keys_are_resolved(tmp_path: Path):
    path = write(
        tmp_path,
        """
x-common: &slow {lower_speed: 0.05, linear_speed: 0.5}
.tools: &tools [flat_screwdriver]
A:
  task: !Kitting {tools: *tools}
  planner: {<<: *slow, linear_speed: 0.7}
""",
    )
    scenario = load_scenario(path)
    assert scenario.planner.lower_speed == 0.05
    assert scenario.planner.linear_speed == 0.7
    assert scenario.task == Kitting(tools=["flat_screwdriver"])


def test_text_keeps_the_order_of_mappings(tmp_path: Path):
    """The order matters: the oracle picks tools in this order, and the last matching paint wins."""
    path = write(tmp_path, "A: {}")
    text = """
task: !ArrangedKitting {tools: {slip_joint_pliers: {x: 0.3, y: 0.3}, claw_hammer: {x: 0.6, y: 0.3}}}
appearance: {paints: {'table/*': !Fixed {rgb: [1, 0, 0]}, '*': !Drawn {}}}
cameras: {zed: !LookAt {}, alpha: !LookAt {}}
"""
    merged = load_scenario(path, text=text)
    assert [*merged.task.tools] == ["slip_joint_pliers", "claw_hammer"]
    assert [*merged.appearance.paints] == ["table/*", "*"]
    assert [*merged.cameras][-2:] == ["zed", "alpha"]


def test_text_without_a_tag_keeps_the_variant(tmp_path: Path):
    path = write(
        tmp_path,
        "A: {task: !ToolsetKitting {split: train}, policy: !Learned {weights: w},"
        " cameras: {top: !LookAt {width: 99}}}",
    )
    text = "{task: {spacing: 0.02}, policy: {orientations: 36}, cameras: {top: {height: 77}}}"
    merged = load_scenario(path, text=text)
    drawn = load_scenario(path, text="appearance: {paints: {'*': {spread: 0.1}}}", perturb="colour")
    assert drawn.appearance.paints["*"].spread == 0.1
    assert merged.task == ToolsetKitting(split="train", spacing=0.02)
    assert merged.policy == Learned(weights="w", orientations=36)
    assert merged.cameras == {"top": LookAt(width=99, height=77)}


def test_text_can_choose_another_variant(tmp_path: Path):
    path = write(tmp_path, "A: {task: !Kitting {spacing: 0.02}}")
    text = "{task: !ArrangedKitting {kit_pose: {x: 0.6}}, policy: !PythonPolicy {function: 'a:b'}}"
    merged = load_scenario(path, text=text)
    assert merged.task == ArrangedKitting(kit_pose=KitPose(x=0.6, y=-0.1))
    assert merged.policy == PythonPolicy(function="a:b")
    merged = load_scenario(path, text="{task: !ArrangedKitting {tools: {flat_screwdriver: {}}}}")
    assert list(merged.task.tools) == ["flat_screwdriver"]


def test_arranged_tools_replace_the_default_ones(tmp_path: Path):
    path = write(tmp_path, "A: {task: !ArrangedKitting {tools: {flat_screwdriver: {x: 0.4}}}}")
    assert list(load_scenario(path).task.tools) == ["flat_screwdriver"]


def test_cameras_replace_the_default_ones(tmp_path: Path):
    path = write(tmp_path, "A: {cameras: {top: !Pinhole {}}}")
    assert list(load_scenario(path).cameras) == ["top"]


DEEP = "A: {planner: {hom: [0, 0, 0, 0]}}"
BAD = {
    # The file is not a mapping from names to scenarios.
    "not YAML": ("A: {", ["mine.yaml, line 1", "not YAML"]),
    "a list": ("[1, 2]", ["mine.yaml", "mapping"]),
    "a number": ("5", ["mine.yaml", "mapping"]),
    "two documents": ("A: {}\n---\nB: {}\n", ["mine.yaml", "not YAML"]),
    "bare fields": ("time_limit: 3.0", ["mine.yaml", "'time_limit' is a field"]),
    "contains itself": ("A: &a {planner: *a}", ["mine.yaml", "contains itself"]),
    "duplicate key": ("A: {time_limit: 1.0, time_limit: 2.0}", ["mine.yaml", "'time_limit'"]),
    "duplicate scenario": ("A: {}\nA: {}\n", ["mine.yaml", "'A' is given twice", "line 2"]),
    # Unknown fields and missing values.
    "misspelt field": (DEEP, ["mine.yaml: A", "planner.hom", "did you mean 'home'?"]),
    "unlike any field": ("A: {colour: red}", ["colour", "use one of", "time_limit"]),
    "field of another variant": (
        "A: {task: !ArrangedKitting {spacing: 0.01}}",
        ["task.spacing", "unknown field"],
    ),
    "attribute of a variant that is not a field": (
        "A: {policy: !Oracle {needs_observation: true}}",
        ["policy.needs_observation is an unknown field"],
    ),
    "home too low": ("A: {planner: {home: [0.3, 0, 0.2, 0]}}", ["planner.home[2]", "0.295"]),
    "home out of reach": ("A: {planner: {home: [2, 0, 0.4, 0]}}", ["planner.home[0]", "1.5"]),
    "grasp depth above its maximum": (
        "A: {planner: {grasp_depth: 0.03}}",
        ["planner.grasp_depth", "planner.max_grasp_depth"],
    ),
    "tag of a field without variants": ("A: {planner: !Foo {}}", ["A: planner has the tag !Foo"]),
    "tag of a scenario": ("A: !Foo {}", ["the scenario has the tag !Foo"]),
    "grasp force above the limit": (
        "A: {controller: {finger_force_limit: 20.0}}",
        ["planner.grasp_force is 30 N", "20 N", "finger_force_limit"],
    ),
    "firm grasp force above the limit": (
        "A: {controller: {finger_force_limit: 50.0}}",
        ["planner.firm_grasp_force is 70 N", "50 N", "finger_force_limit"],
    ),
    "unknown tag": ("A: {policy: !Orcle {}}", ["policy", "!Orcle", "!Oracle"]),
    "tag without a value": (
        "A:\n  policy: !Oracle\n",
        ["mine.yaml: the tag !Oracle on line 2 needs a mapping: write !Oracle {}"],
    ),
    "tag before a brace": ("A: {policy: !Oracle}", ["mine.yaml, line 1", "as in !Oracle {}"]),
    "list without brackets": (
        "A: {planner: {home: -0.4, 0, 0.4, 0}}",
        ["mine.yaml: '0' on line 1 looks like an item of a list: a list needs square brackets"],
    ),
    "empty value": ("A: {time_limit: }", ["time_limit", "empty"]),
    "empty section": ("A: {planner: }", ["planner", "empty"]),
    # Values of a wrong type.
    "text for a number": ("A: {time_limit: soon}", ["time_limit", "number", "'soon'"]),
    "quoted number": ("A: {time_limit: '3'}", ["time_limit", "number"]),
    "fraction for a whole number": ("A: {random_seed: 1.5}", ["random_seed", "whole"]),
    "boolean for a number": ("A: {random_seed: true}", ["random_seed", "whole"]),
    "number for a boolean": ("A: {sleep: {enabled: 1}}", ["sleep.enabled", "true or false"]),
    "text for a list": ("A: {task: !Kitting {tools: hammer}}", ["task.tools", "list"]),
    "number among strings": ("A: {task: !Kitting {tools: [1]}}", ["task.tools[0]", "string"]),
    "list for a mapping": ("A: {cameras: [1]}", ["cameras", "mapping"]),
    "text for a section": ("A: {policy: Oracle}", ["policy", "mapping", "write !Oracle {}"]),
    # Values that are not allowed.
    "out of range": ("A: {planner: {grasp_force: 1000.0}}", ["planner.grasp_force", "1 and 140"]),
    "out of range in a map": ("A: {cameras: {f: !Pinhole {width: 1}}}", ["cameras.f.width"]),
    "out of range in the kit": ("A: {task: !Kitting {kit: {height: 9.0}}}", ["task.kit.height"]),
    "out of range two levels down": (
        "A: {planner: {search: {amplitude: 3.0}}}",
        ["planner.search.amplitude", "0 and 0.5"],
    ),
    "NaN": ("A: {time_limit: .nan}", ["time_limit", "finite"]),
    "NaN in a list": ("A: {planner: {home: [0.1, .nan, 0.5, 0.0]}}", ["planner.home", "finite"]),
    "infinity": ("A: {time_limit: .inf}", ["time_limit", "finite"]),
    "wrong length": ("A: {planner: {home: [1.0, 2.0, 0.5]}}", ["planner.home", "4 numbers"]),
    "time step": ("A: {plant: {time_step: 0.003}}", ["plant.time_step", "1/64"]),
    "contact": (
        "A: {plant: {discrete_contact_approximation: tamsi}}",
        ["contact_approximation", "sap"],
    ),
    "heights upside down": ("A: {heightmap: {z_max: -0.5}}", ["heightmap.z_max"]),
    "no tools": ("A: {task: !Kitting {tools: []}}", ["task.tools is empty"]),
    "no arranged tools": ("A: {task: !ArrangedKitting {tools: {}}}", ["task.tools is empty"]),
    "too many tools": (
        "A: {task: !Kitting {tools: [a, a, a, a, a, a, a, a, a, a, a, a, a]}}",
        ["task.tools has 13 tools", "up to 12"],
    ),
    "no such split": (
        "A: {task: !ToolsetKitting {split: dev}}",
        ["task.split", "train, test, fresh"],
    ),
    "lengths the wrong way round": (
        "A: {task: !ToolsetKitting {tool_length: [0.2, 0.15]}}",
        ["task.tool_length"],
    ),
    "camera that looks straight down": (
        "A: {cameras: {f: !LookAt {position: [0, 0, 1], target: [0, 0, 0]}}}",
        ["cameras.f", "!Pinhole"],
    ),
    "orientations": ("A: {policy: !QuantizedOracle {orientations: 1}}", ["policy.orientations"]),
    "orientations of a network": (
        "A: {policy: !Learned {weights: w, orientations: 4000}}",
        ["policy.orientations", "3600"],
    ),
    "no cameras": (
        "A: {policy: !Learned {weights: w}, cameras: {}}",
        ["cameras is empty"],
    ),
    "no function": ("A: {policy: !PythonPolicy {function: mine}}", ["policy.function", "mine"]),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_name_file_and_field(tmp_path: Path, case: str):
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
def test_odd_but_parsable_files_are_refused(tmp_path: Path, text: str):
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


def test_an_unknown_scenario_is_refused_with_the_known_names():
    with pytest.raises(UserError, match=r"no scenario 'Default'.*Defaults, OneOf"):
        load_scenario(TEST_SCENARIOS, "Default")


def test_errors_in_scenario_text_name_the_flag():
    with pytest.raises(UserError, match=r"^--scenario_text: planner\.hom is an unknown field"):
        load_scenario(TEST_SCENARIOS, text="{planner: {hom: 1}}")
    with pytest.raises(UserError, match=r"^--scenario_text.* is not YAML"):
        load_scenario(TEST_SCENARIOS, text="{planner: ")
    with pytest.raises(UserError, match=r"^--scenario_text: the tag !Oracle at the beginning"):
        load_scenario(TEST_SCENARIOS, text="!Oracle {time_limit: 3.0}")
    with pytest.raises(UserError, match=r"^--scenario_text must be a mapping"):
        load_scenario(TEST_SCENARIOS, text="faster")
    with pytest.raises(UserError, match=r"^--scenario_text: '_tag' on line 1 is not a field"):
        load_scenario(TEST_SCENARIOS, text="{task: {_tag: 5}}")


def test_only_a_camera_of_the_scenario_can_be_removed():
    with pytest.raises(UserError) as caught:
        load_scenario(TEST_SCENARIOS, text="{cameras: {lft: null}}")
    assert str(caught.value) == (
        "--scenario_text: there is no camera 'lft' to remove: use one of front, left, right"
    )
    left = load_scenario(TEST_SCENARIOS, text="{cameras: {left: null}}")
    assert list(left.cameras) == ["front", "right"]


def test_the_merged_scenario_is_validated(tmp_path: Path):
    """The file and the text are each valid, but not if they are merged."""
    path = write(tmp_path, "A: {heightmap: {z_min: -0.1}}")
    with pytest.raises(UserError, match=r"--scenario_text: heightmap\.z_max"):
        load_scenario(path, text="{heightmap: {z_max: -0.2}}")
    with pytest.raises(UserError, match=r"heightmap\.z_min is 0\.02"):
        load_scenario(path, text="{heightmap: {z_min: 0.02}}")
    with pytest.raises(UserError, match=r"heightmap\.z_min is -0\.005"):
        load_scenario(path, text="{heightmap: {z_min: -0.005}}")
