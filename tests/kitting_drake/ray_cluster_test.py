"""`evaluate` and `collect` on a real Ray cluster of two nodes, one of which is killed."""

import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import pytest

from kitting_drake.common.paths import MODELS

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]

# Its tools must be shipped to the nodes: one is beside the scenario, one was imported.
SCENARIO = """
Mine:
  time_limit: {time_limit}
  task: !Kitting
    tools: [{tools}]
"""


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A cluster that has only a head node, with one CPU."""
    utils = pytest.importorskip("ray.cluster_utils", reason="Ray is not installed")
    cluster = utils.Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    yield cluster
    cluster.shutdown()


@pytest.fixture
def start(tmp_path: Path) -> Callable[..., subprocess.Popen[bytes]]:
    """Starts a command on a scenario, in another process that can use the imported tool."""
    for place in (tmp_path / "imported" / "mine", tmp_path / "beside"):
        shutil.copytree(MODELS / "tools" / "combination_wrench", place)

    def start(command: str, scenario: Path, *flags: object) -> subprocess.Popen[bytes]:
        words = [sys.executable, "-m", f"kitting_drake.{command}", scenario, "--quiet", *flags]
        tools = {"KITTING_DRAKE_TOOLS": str(tmp_path / "imported")}
        return subprocess.Popen(list(map(str, words)), cwd=ROOT, env=os.environ | tools)

    return start


def scenario_file(folder: Path, *, time_limit: float, tools: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(SCENARIO.format(time_limit=time_limit, tools=tools))
    return path


def kill_node(cluster: Any, node: Any, process: subprocess.Popen[bytes], when: Callable) -> None:
    """Kills a node at a random moment after `when` first returns true."""
    while not when():
        assert process.poll() is None, "the node was to be killed before the end"
        time.sleep(0.05)
    time.sleep(random.Random(0).uniform(0.0, 2.0))
    assert process.poll() is None, "the node was to be killed before the end"
    cluster.remove_node(node, allow_graceful=False)


def test_episodes_are_independent_of_a_killed_node(
    cluster: Any, start: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
):
    scenario = scenario_file(tmp_path, time_limit=1.0, tools="beside, mine")
    here, there = tmp_path / "here", tmp_path / "there"

    def lines(folder: Path) -> list[str]:
        path = folder / "episodes.jsonl"
        return path.read_text().splitlines() if path.exists() else []

    def episodes(folder: Path) -> list[str]:
        found = [json.loads(line) | {"wall_seconds": 0.0} for line in lines(folder)]
        found.sort(key=lambda episode: episode["seed"])
        return [json.dumps(episode) for episode in found]

    assert start("evaluate", scenario, "--episodes", 12, "--output", here).wait() == 0
    node = cluster.add_node(num_cpus=1)
    flags = ("--episodes", 12, "--output", there, "--ray", cluster.address)
    process = start("evaluate", scenario, *flags)
    kill_node(cluster, node, process, lambda: len(lines(there)) >= 4)
    assert process.wait() == 0
    assert episodes(there) == episodes(here)
    assert len(set(episodes(here))) == 12
    assert not any(json.loads(line)["failure"] for line in lines(here))


@pytest.mark.usefixtures("rendering")
def test_demonstrations_are_independent_of_a_killed_node(
    cluster: Any, start: Callable[..., subprocess.Popen[bytes]], tmp_path: Path
):
    scenario = scenario_file(tmp_path, time_limit=60.0, tools="mine")
    here, there = tmp_path / "here", tmp_path / "there"

    def content(folder: Path) -> dict[str, object]:
        found: dict[str, object] = {}

        def note(name: str, item: h5py.Group | h5py.Dataset) -> None:
            found.update({f"{name}@{key}": str(value) for key, value in item.attrs.items()})
            if isinstance(item, h5py.Dataset):
                text = item.dtype == h5py.string_dtype()
                found[name] = item.asstr()[()].tolist() if text else item[()].tobytes()

        with h5py.File(folder / "demonstrations.h5") as file:
            note("", file)
            file.visititems(note)
        return found

    assert start("collect", scenario, "--demos", 4, "--output", here).wait() == 0
    node = cluster.add_node(num_cpus=1)
    flags = ("--demos", 4, "--output", there, "--ray", cluster.address)
    process = start("collect", scenario, *flags)
    kill_node(cluster, node, process, lambda: list((there / "parts").glob("seed_*")))
    assert process.wait() == 0
    assert content(there) == content(here)
