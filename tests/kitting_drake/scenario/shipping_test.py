import pickle
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from kitting_drake.common.paths import MODELS, SCENARIOS
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.policies import Learned, PythonPolicy
from kitting_drake.scenario.schema import Scenario
from kitting_drake.scenario.shipping import Shipment, pack
from kitting_drake.tasks import ArrangedKitting, Kitting
from kitting_drake.tasks.kitting.kitting import TablePose

WRENCH = MODELS / "tools" / "combination_wrench"

_ON_THE_NODE = """
import importlib, pickle, sys
from pathlib import Path
import kitting_drake, systems
from kitting_drake.common.own_modules import modules_beside
from kitting_drake.common.paths import MODELS

here = Path.cwd()
assert all(Path(item.__file__).is_relative_to(here) for item in (kitting_drake, systems)), sys.path
assert MODELS.is_relative_to(here)
chosen = pickle.loads(sys.stdin.buffer.read())
assert chosen.base.is_relative_to(here)
for path in (*chosen.scenario.policy.input_files(chosen.base),
             *chosen.scenario.task.input_files(chosen.base)):
    assert path.resolve().is_relative_to(here), path
    assert path.is_file(), path
for module in chosen.scenario.policy.modules():
    with modules_beside(chosen.base):
        assert Path(importlib.import_module(module).__file__).is_relative_to(here), module
print(chosen.name, chosen.path)
"""


def unpacked(shipment: Shipment, archive: Path, folder: Path) -> str:
    """What a process finds that runs in a folder where the archive was unpacked."""
    with zipfile.ZipFile(archive) as file:
        file.extractall(folder)
    done = subprocess.run(
        [sys.executable, "-c", _ON_THE_NODE],
        input=pickle.dumps(shipment.chosen),
        cwd=folder,
        env=shipment.environment | {"PYTHONPATH": str(folder)},
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode().strip()


def test_all_that_a_scenario_names_is_found_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    own, mine, elsewhere = tmp_path / "tools", tmp_path / "mine", tmp_path / "elsewhere"
    for folder in (own / "imported", mine / "beside", elsewhere / "absolute", elsewhere / "linked"):
        shutil.copytree(WRENCH, folder)
    (mine / "link").symlink_to(elsewhere / "linked")
    (mine / "policies").mkdir()
    weights = tmp_path / "weights" / "policy.safetensors"
    weights.parent.mkdir()
    weights.write_bytes(b"trained")
    monkeypatch.setenv("KITTING_DRAKE_TOOLS", str(own))
    tools = ["imported", "beside", str(elsewhere / "absolute"), "link", "claw_hammer"]
    chosen = ChosenScenario(
        Scenario(task=Kitting(tools=tools), policy=Learned("../weights/policy.safetensors")),
        mine / "mine.yaml",
        "mine",
        None,
    )
    shipment = pack(chosen, tmp_path / "a.zip")
    # Messages name the file as here.
    found = unpacked(shipment, tmp_path / "a.zip", tmp_path / "node")
    assert found == f"mine {mine / 'mine.yaml'}"
    names = zipfile.ZipFile(tmp_path / "a.zip").namelist()
    assert len(names) == len(set(names))
    assert not any("__pycache__" in name or "/.venv/" in name for name in names)
    # What the user is working with is as it was.
    assert chosen.scenario.task.tools == tools
    assert chosen.base == mine


def test_absolute_paths_are_made_relative(tmp_path: Path):
    shutil.copytree(WRENCH, tmp_path / "tool")
    weights = tmp_path / "policy.safetensors"
    weights.write_bytes(b"trained")
    task = ArrangedKitting(tools={str(tmp_path / "tool"): TablePose(), "claw_hammer": TablePose()})
    scenario = Scenario(task=task, policy=Learned(str(weights)))
    chosen = ChosenScenario(scenario, SCENARIOS / "mine.yaml", "mine", None)
    sent = pack(chosen, tmp_path / "a.zip").chosen.scenario
    assert not Path(sent.policy.weights).is_absolute()
    assert (SCENARIOS / sent.policy.weights).resolve() == weights
    first, second = sent.task.tools
    assert (SCENARIOS / first).resolve() == tmp_path / "tool"
    assert second == "claw_hammer"


@pytest.mark.parametrize(
    ("name", "module", "folder"),
    [
        ("policy_of_mine.py", "policy_of_mine", "where_i_run"),
        ("policy_of_mine/__init__.py", "policy_of_mine", "where_i_run"),
        ("policies_of_mine/policy.py", "policies_of_mine.policy", "where_i_run"),
        ("policies_of_mine/policy.py", "policies_of_mine.policy", "beside_the_scenario"),
    ],
)
def test_a_policy_of_ones_own_travels_along(
    name: str, module: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    source = tmp_path / folder / name
    source.parent.mkdir(parents=True)
    source.write_text("def act(observation): ...\n")
    monkeypatch.syspath_prepend(tmp_path / "where_i_run")
    scenario = Scenario(policy=PythonPolicy(f"{module}:act"))
    yaml = tmp_path / "beside_the_scenario" / "mine.yaml"
    yaml.parent.mkdir(exist_ok=True)
    chosen = ChosenScenario(scenario, yaml, "mine", None)
    shipment = pack(chosen, tmp_path / "a.zip")
    unpacked(shipment, tmp_path / "a.zip", tmp_path / "node")
