"""Reads a dataset with LeRobot itself, for lerobot_export_test.py.

It needs an interpreter with LeRobot. Usage: python lerobot_reader.py DATASET EXPECTED.npz

It prints as JSON the number of values that differ from the expected frames, and the largest
difference of the dataset's statistics from those that LeRobot computes.
"""

import json
import sys

import lerobot
import numpy as np
import torch
from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset

COLOUR, HEIGHT = "observation.images.colour", "observation.images.height"


def differing(one: torch.Tensor, other: np.ndarray) -> int:
    """The number of bitwise different values in two float32 arrays."""
    read = one.numpy()
    assert read.dtype == other.dtype == np.float32, (read.dtype, other.dtype)
    assert read.shape == other.shape, (read.shape, other.shape)
    return int((read.view(np.int32) != np.ascontiguousarray(other).view(np.int32)).sum())


def statistics_difference(dataset: LeRobotDataset, expected: dict[str, np.ndarray]) -> float:
    """The largest difference from LeRobot's own statistics of the expected values."""
    values = {
        COLOUR: expected["colour"] / 255,
        # LeRobot sums in the input's type; float32 is off by 4e-3 for real images.
        HEIGHT: expected["height"].astype(np.float64),
        "action": expected["action"].astype(np.float64),
    }
    worst = 0.0
    for name, array in values.items():
        image = name != "action"
        parts = []
        for episode in dataset.meta.episodes:
            part = array[episode["dataset_from_index"] : episode["dataset_to_index"]]
            found = get_feature_stats(part, axis=(0, 2, 3) if image else 0, keepdims=image)
            parts.append({k: v if k == "count" else v[0] if image else v for k, v in found.items()})
        own = aggregate_stats([{name: part} for part in parts])[name]
        for key in ("min", "max", "mean", "std", "count"):
            assert dataset.meta.stats[name][key].shape == own[key].shape, (name, key)
            worst = max(worst, float(np.abs(dataset.meta.stats[name][key] - own[key]).max()))
    return worst


def main() -> None:
    root = sys.argv[1]
    expected = dict(np.load(sys.argv[2]))
    metres = LeRobotDataset("some/name", root=root, depth_output_unit="m")
    millimetres = LeRobotDataset("some/name", root=root)
    differences = dict.fromkeys(("colour", "height", "action", "millimetres", "others"), 0)
    for index in range(len(metres)):
        frame = metres[index]
        levels = expected["colour"][index]
        differences["colour"] += differing(frame[COLOUR], levels.astype(np.float32) / 255)
        differences["colour"] += int((np.rint(frame[COLOUR].numpy() * 255) != levels).sum())
        differences["height"] += differing(frame[HEIGHT], expected["height"][index])
        differences["action"] += differing(frame["action"], expected["action"][index])
        by_default = millimetres[index][HEIGHT]
        differences["millimetres"] += differing(by_default, expected["height"][index] * 1000)
        for name in ("episode_index", "frame_index", "index", "object", "category", "next.done"):
            value = frame[name].item() if torch.is_tensor(frame[name]) else frame[name]
            differences["others"] += int(value != expected[name][index])
        differences["others"] += int(frame["task"] != str(expected["task"]))
    second = LeRobotDataset("some/name", root=root, episodes=[1])
    next_action = LeRobotDataset("some/name", root=root, delta_timestamps={"action": [0, 1]})
    batch = next(iter(torch.utils.data.DataLoader(next_action, batch_size=2)))
    result = {
        "lerobot": lerobot.__version__,
        "frames": len(metres),
        "episodes": metres.num_episodes,
        "depth_keys": metres.meta.depth_keys,
        "differences": differences,
        "statistics_difference": statistics_difference(metres, expected),
        "second_episode": [int(second[i]["index"]) for i in range(len(second))],
        "next_action": differing(batch["action"][0], expected["action"][:2]),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
