"""A policy from LeRobot's own trainer learns from exported frames, and moves the joints.

KITTING_LEROBOT_PYTHON is the interpreter of an environment with `lerobot[dataset,training]`.
"""

import os
import subprocess
from multiprocessing.connection import Listener
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import kitting_drake.gym
from kitting_drake.episode.chosen import build_chosen, run_chosen
from kitting_drake.episode.frame_recorder import FrameRecorder
from kitting_drake.policies.data.frames import EpisodeFrames, FrameSettings
from kitting_drake.policies.data.lerobot_export import export_lerobot
from kitting_drake.scenario.choosing import find_scenario

LEROBOT = os.environ.get("KITTING_LEROBOT_PYTHON")
SCENARIO = """
OneTool:
  task: !ArrangedKitting
    kit_pose: {x: 0.5, y: -0.1}
    tools: {combination_wrench: {x: 0.42, y: 0.14}}
"""
SETTINGS = FrameSettings(fps=16, width=80, cameras=("front",))
OPTIONS = """
--dataset.repo_id=me/kitting --policy.type=act --policy.push_to_hub=false --policy.device=cpu
--policy.chunk_size=16 --policy.n_action_steps=8 --policy.dim_model=128 --policy.use_vae=false
--policy.dim_feedforward=256 --policy.n_encoder_layers=2 --policy.pretrained_backbone_weights=null
--policy.optimizer_lr=1e-3 --policy.optimizer_lr_backbone=1e-4 --steps=120 --batch_size=8
--num_workers=0 --save_freq=120
"""


def record(path: Path) -> EpisodeFrames:
    chosen = find_scenario(path)
    diagram, station = build_chosen(chosen, seed=3)
    recorder = FrameRecorder(station, SETTINGS)
    run_chosen(chosen, diagram, station, sampler=recorder)
    return recorder.frames()


def offline(folder: Path) -> dict[str, str]:
    """Neither the Hub nor this project's packages may be used. One thread, because several are
    slower for small networks."""
    return {
        "PATH": os.environ["PATH"],
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(folder / "hub"),
        "OMP_NUM_THREADS": "1",
    }


@pytest.mark.slow
@pytest.mark.usefixtures("rendering")
@pytest.mark.skipif(not LEROBOT, reason="KITTING_LEROBOT_PYTHON is not set")
def test_act_learns_to_move_to_the_tool(tmp_path: Path):
    pytest.importorskip("pyarrow", exc_type=ImportError)
    assert LEROBOT is not None
    scenario = tmp_path / "one_tool.yaml"
    scenario.write_text(SCENARIO)
    frames = record(scenario)
    frames.save(tmp_path / "frames.npz")
    export_lerobot([tmp_path / "frames.npz"], tmp_path / "lerobot", "kit")
    trainer = Path(LEROBOT).with_name("lerobot-train")
    where = [f"--dataset.root={tmp_path / 'lerobot'}", f"--output_dir={tmp_path / 'act'}"]
    environment = offline(tmp_path)
    subprocess.run(
        [str(trainer), *OPTIONS.split(), *where], env=environment, check=True, cwd=tmp_path
    )
    checkpoint = tmp_path / "act" / "checkpoints" / "last" / "pretrained_model"
    actor = Path(__file__).parents[1] / "policies" / "lerobot_actor.py"
    socket = str(tmp_path / "socket")
    cell = gymnasium.make(
        f"kitting_drake/{kitting_drake.gym.JOINTS}-v0",
        scenario=scenario,
        fps=SETTINGS.fps,
        image_width=SETTINGS.width,
        cameras=SETTINGS.cameras,
    )
    with Listener(socket) as listener:
        process = subprocess.Popen([LEROBOT, str(actor), str(checkpoint), socket], env=environment)
        with listener.accept() as connection:
            observation, _ = cell.reset(seed=3)
            states = [observation["observation.state"]]
            for _ in range(len(frames) - 1):
                connection.send(observation)
                observation, *_, info = cell.step(connection.recv())
                assert info["failure"] is None
                states.append(observation["observation.state"])
            connection.send(None)
        assert process.wait(60) == 0
    # The hand comes near the grasp of the demonstration: 0.3 m from where it starts.
    closed = int(np.argmin(frames.action[:, -1]))
    grasp = frames.state[closed, :3]
    nearest = min(np.linalg.norm(state[:3] - grasp) for state in states)
    start = np.linalg.norm(states[0][:3] - grasp)
    print(f"{start:.3f} m from the grasp at first, {nearest:.3f} m at best; {info['success_rate']}")
    assert nearest < 0.05 < start
