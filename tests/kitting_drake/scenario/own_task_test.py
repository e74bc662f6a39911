"""`task: !PythonTask`: a task in a module beside the scenario's file."""

import json
import pickle
import sys
from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.scenario import load_scenario
from kitting_drake.scenario.description import describe
from kitting_drake.tasks.python_task import PythonTask
from systems.signals import PixelGrid

MODULE = """
import dataclasses

from kitting_drake.tasks.ravens.align_box_corner import AlignBoxCorner
from kitting_drake.tasks.task import TaskConfig


@dataclasses.dataclass
class SmallBoxes(AlignBoxCorner):
    rounds: int = 3
    names: dict[str, float] = dataclasses.field(default_factory=lambda: {"a": 1.0})


class NoTask:
    pass
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "boxes_of_mine.py").write_text(MODULE)
    # Forget the module before and after each test.
    monkeypatch.delitem(sys.modules, "boxes_of_mine", raising=False)
    return tmp_path


def load(folder: Path, fields: str, text: str | None = None) -> PythonTask:
    path = folder / "mine.yaml"
    path.write_text(f"Mine: {{task: !PythonTask {{{fields}}}}}")
    task = load_scenario(path, text=text).task
    assert isinstance(task, PythonTask)
    return task


def test_fields_of_the_class_can_be_given(folder: Path):
    task = load(folder, "class: 'boxes_of_mine:SmallBoxes', rounds: 5, box_sides: [0.03, 0.04]")
    assert (task.config.rounds, task.config.box_sides) == (5, [0.03, 0.04])
    scene = task.make_scene(grid=PixelGrid(), seed=3, base=folder)
    assert scene.objects[0].name == "box"
    assert task.causes == task.config.causes
    assert task.title == "small-boxes, changed"
    assert task.input_files(folder) == [folder / "boxes_of_mine.py"]
    described = json.dumps(describe(task))
    assert '"_tag": "!SmallBoxes"' in described
    assert str(folder) not in described


def test_text_merges_over_the_fields(folder: Path):
    fields = "class: 'boxes_of_mine:SmallBoxes', rounds: 5"
    task = load(folder, fields, text="{task: {box_height: [0.04, 0.05], names: {b: 2.0}}}")
    assert (task.config.rounds, task.config.box_height) == (5, [0.04, 0.05])
    assert task.config.names == {"a": 1.0, "b": 2.0}


def test_it_can_be_unpickled_in_another_process(folder: Path, monkeypatch: pytest.MonkeyPatch):
    task = load(folder, "class: 'boxes_of_mine:SmallBoxes', rounds: 7")
    sent = pickle.dumps(task)
    monkeypatch.delitem(sys.modules, "boxes_of_mine")
    assert pickle.loads(sent).config.rounds == 7


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ("", "task.class is missing"),
        ("class: boxes_of_mine", "task.class must be module:Class"),
        ("class: 'nowhere:Task'", "task.class: cannot import nowhere:Task"),
        ("class: 'boxes_of_mine:NoTask'", "must derive from"),
        ("class: 'boxes_of_mine:SmallBoxes', round: 3", "task.round is an unknown field"),
        ("class: 'boxes_of_mine:SmallBoxes', rounds: many", "task.rounds must be a whole number"),
        ("class: 'boxes_of_mine:SmallBoxes', box_sides: [0.06, 0.04]", "task.box_sides"),
    ],
)
def test_errors_name_the_field(folder: Path, fields: str, said: str):
    with pytest.raises(UserError, match=said):
        load(folder, fields)
