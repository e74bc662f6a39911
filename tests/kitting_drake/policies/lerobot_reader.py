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

IMAGE, STATE = "observation.images.front", "observation.state"


def differing(one: torch.Tensor, other: np.ndarray) -> int:
    """The number of elements in which two float32 arrays differ."""
    read = one.numpy()
    assert read.dtype == other.dtype == np.float32, (read.dtype, other.dtype)
    assert read.shape == other.shape, (read.shape, other.shape)
    return int((read != other).sum())


def statistics_difference(dataset: LeRobotDataset, expected: dict[str, np.ndarray]) -> float:
    """The largest difference between the stored statistics and those that LeRobot computes from the
    expected values."""
    values = {
        IMAGE: np.moveaxis(expected["image"], -1, 1) / 255,
        STATE: expected["state"].astype(np.float64),
        "action": expected["action"].astype(np.float64),
    }
    worst = 0.0
    for name, array in values.items():
        image = name == IMAGE
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
    dataset = LeRobotDataset("some/name", root=root)
    differences = dict.fromkeys(("image", "state", "action", "others"), 0)
    for index in range(len(dataset)):
        frame = dataset[index]
        image = np.moveaxis(expected["image"][index], -1, 0).astype(np.float32) / 255
        differences["image"] += differing(frame[IMAGE], image)
        differences["state"] += differing(frame[STATE], expected["state"][index])
        differences["action"] += differing(frame["action"], expected["action"][index])
        for name in ("episode_index", "frame_index", "index", "next.done", "next.reward"):
            differences["others"] += int(frame[name].item() != expected[name][index])
        differences["others"] += int(frame["task"] != "kit")
    second = LeRobotDataset("some/name", root=root, episodes=[1])
    period = 1 / dataset.fps
    chunks = LeRobotDataset("some/name", root=root, delta_timestamps={"action": [0, period]})
    batch = next(iter(torch.utils.data.DataLoader(chunks, batch_size=2)))
    result = {
        "lerobot": lerobot.__version__,
        "frames": len(dataset),
        "episodes": dataset.num_episodes,
        "fps": dataset.fps,
        "differences": differences,
        "statistics_difference": statistics_difference(dataset, expected),
        "second_episode": [int(second[i]["index"]) for i in range(len(second))],
        "next_actions": differing(batch["action"][1], expected["action"][1:3]),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
