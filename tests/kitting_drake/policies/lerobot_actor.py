"""Lets a policy of LeRobot's trainer act, for lerobot_training_test.py.

It needs an interpreter with LeRobot. Usage: python lerobot_actor.py CHECKPOINT SOCKET

It answers each observation of a `kitting_drake/KittingJoint-v0` environment with an action.
"""

import sys
from multiprocessing.connection import Client
from typing import Any

import numpy as np
import torch
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors


def as_batch(observation: dict[str, np.ndarray]) -> dict[str, Any]:
    """An observation as a batch of one, in the form of the dataset."""
    batch: dict[str, Any] = {"task": ["kit"]}
    for name, value in observation.items():
        tensor = torch.from_numpy(np.array(value, np.float32))
        batch[name] = (tensor.permute(2, 0, 1) / 255 if value.ndim == 3 else tensor)[None]
    return batch


def main() -> None:
    checkpoint, socket = sys.argv[1:]
    policy = ACTPolicy.from_pretrained(checkpoint)
    before, after = make_pre_post_processors(policy.config, pretrained_path=checkpoint)
    with Client(socket) as connection, torch.inference_mode():
        while (observation := connection.recv()) is not None:
            action = after(policy.select_action(before(as_batch(observation))))
            connection.send(action[0].numpy())


if __name__ == "__main__":
    main()
