import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS, SCENARIOS
from kitting_drake.common.provenance import commit
from kitting_drake.scenario.choosing import ChosenScenario
from kitting_drake.scenario.policies import Learned, PythonPolicy
from kitting_drake.scenario.schema import Scenario
from kitting_drake.scenario.shipping import Shipment, pack
from kitting_drake.tasks import ArrangedKitting, Kitting
from kitting_drake.tasks.kitting.tool_poses import TablePose

WRENCH = MODELS / "tools" / "combination_wrench"

_ON_THE_NODE = """
import importlib, pickle, sys
from pathlib import Path
import kitting_drake, systems
from kitting_drake.common.errors import UserError
from kitting_drake.common.own_modules import modules_beside
from kitting_drake.common.paths import MODELS
from kitting_drake.common.provenance import commit

here = Path.cwd()
assert all(Path(item.__file__).is_relative_to(here) for item in (kitting_drake, systems)), sys.path
assert MODELS.is_relative_to(here)
print(commit())
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


def on_a_node(shipment: Shipment, node: Path) -> str:
    """Copies a shipment as Ray does; returns the output of a process that uses the copy."""
    env = shipment.runtime_env
    ignored = shutil.ignore_patterns(*env["excludes"])
    shutil.copytree(env["working_dir"], node, ignore=ignored)
    paths = [str(node)]
    for number, module in enumerate(map(Path, env.get("py_modules", []))):
        place = node / f"module_{number}" / module.name
        place.parent.mkdir()
        shutil.copytree(module, place) if module.is_dir() else shutil.copy(module, place)
        paths.append(str(place.parent))
    done = subprocess.run(
        [sys.executable, "-c", _ON_THE_NODE],
        input=pickle.dumps(shipment.chosen),
        cwd=node,
        env=env["env_vars"] | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode().strip()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty folder, in which `pack` makes links."""
    folder = tmp_path / "links"
    folder.mkdir()
    return folder


def test_packs_all_files_of_a_scenario(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    own, mine, elsewhere = tmp_path / "tools", tmp_path / "mine", tmp_path / "elsewhere"
    for tool in (own / "imported", mine / "beside", elsewhere / "absolute", elsewhere / "linked"):
        shutil.copytree(WRENCH, tool)
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
    shipment = pack(chosen, folder)
    found = on_a_node(shipment, tmp_path / "node")
    # Messages on the node name the original scenario file, not its copy.
    assert found.splitlines() == [str(commit()), f"mine {mine / 'mine.yaml'}"]
    shipped = {path.name for path in folder.iterdir()}
    assert shipped == {"kitting_drake", "systems", "models", "files"}
    # Without modules there is no `py_modules`, because Ray rejects an empty list.
    assert "py_modules" not in shipment.runtime_env
    # Packing did not change the original scenario.
    assert chosen.scenario.task.tools == tools
    assert chosen.base == mine


def test_absolute_paths_are_made_relative(folder: Path, tmp_path: Path):
    shutil.copytree(WRENCH, tmp_path / "tool")
    weights = tmp_path / "policy.safetensors"
    weights.write_bytes(b"trained")
    task = ArrangedKitting(tools={str(tmp_path / "tool"): TablePose(), "claw_hammer": TablePose()})
    scenario = Scenario(task=task, policy=Learned(str(weights)))
    chosen = ChosenScenario(scenario, SCENARIOS / "mine.yaml", "mine", None)
    sent = pack(chosen, folder).chosen.scenario
    assert not Path(sent.policy.weights).is_absolute()
    assert (SCENARIOS / sent.policy.weights).resolve() == weights
    first, second = sent.task.tools
    assert (SCENARIOS / first).resolve() == tmp_path / "tool"
    assert second == "claw_hammer"


@pytest.mark.parametrize(
    ("name", "module", "place"),
    [
        pytest.param("policy_of_mine.py", "policy_of_mine", "where_i_run", marks=pytest.mark.slow),
        pytest.param(
            *("policy_of_mine/__init__.py", "policy_of_mine", "where_i_run"), marks=pytest.mark.slow
        ),
        pytest.param(
            "policies_of_mine/policy.py",
            "policies_of_mine.policy",
            "where_i_run",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("policies_of_mine/policy.py", "policies_of_mine.policy", "beside_the_scenario"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_packs_the_users_policy(
    name: str,
    module: str,
    place: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    source = tmp_path / place / name
    source.parent.mkdir(parents=True)
    source.write_text("def act(observation): ...\n")
    monkeypatch.syspath_prepend(tmp_path / "where_i_run")
    scenario = Scenario(policy=PythonPolicy(f"{module}:act"))
    yaml = tmp_path / "beside_the_scenario" / "mine.yaml"
    yaml.parent.mkdir(exist_ok=True)
    chosen = ChosenScenario(scenario, yaml, "mine", None)
    on_a_node(pack(chosen, folder), tmp_path / "node")


def test_a_module_from_elsewhere_is_sent_with_the_rest(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    package = tmp_path / "where_i_run" / "policies_of_mine"
    package.mkdir(parents=True)
    (package / "policy.py").write_text("def act(observation): ...\n")
    monkeypatch.syspath_prepend(package.parent)
    scenario = Scenario(policy=PythonPolicy("policies_of_mine.policy:act"))
    chosen = ChosenScenario(scenario, tmp_path / "mine.yaml", "mine", None)
    sent = pack(chosen, folder).runtime_env["py_modules"]
    assert [Path(module).name for module in sent] == ["policies_of_mine"]


def test_a_missing_file_is_refused(folder: Path, tmp_path: Path):
    chosen = ChosenScenario(
        Scenario(policy=Learned("gone.safetensors")), tmp_path / "mine.yaml", "mine", None
    )
    with pytest.raises(UserError, match=r"cannot pack .*gone\.safetensors: No such file"):
        pack(chosen, folder)
