import dataclasses
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Learning,
    Origin,
    Rejection,
    merge_demonstrations,
    read_contents,
    read_demonstrations,
    write_demonstrations,
)
from kitting_drake.policies.data.recorded import DemonstrationStep, FinalObservation, Stored
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

GRID = PixelGrid(rows=5, cols=7, z_max=0.3)
LEARNING = Learning(later_picks_possible=True, curvature=False)
ORIGIN = Origin("mine", {"time_limit": 1.0}, GRID, 10, {"drake": "1.51.1"}, LEARNING)
REJECTED = (Rejection(11, 0.5, "a tool fell"),)


def step(seed: int) -> DemonstrationStep:
    rng = np.random.default_rng(seed)
    return DemonstrationStep.of(
        Observation(rng.random((4, *GRID.shape), np.float32), GRID),
        PickPlaceAction(PlanarPose(*rng.random(3)), PlanarPose(*rng.random(3))),
        name=f"wrench_{seed}",
        category="wrench",
    )


def demonstration(seed: int, steps: int = 3, *, final: bool = True) -> Demonstration:
    image = np.random.default_rng(seed).random((4, *GRID.shape), np.float32)
    return Demonstration(
        seed,
        1.0,
        tuple(step(10 * seed + i) for i in range(steps)),
        FinalObservation.of(Observation(image, GRID)) if final else None,
    )


def assert_same(one: Demonstration, other: Demonstration) -> None:
    assert (one.seed, one.score) == (other.seed, other.score)
    for a, b in zip(one.steps, other.steps, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.height, b.height)
        assert a.rgb.dtype == b.rgb.dtype == np.uint8
        assert a.height.dtype == b.height.dtype == np.float32
        for name in ("pick", "place", "object", "category"):
            assert getattr(a, name) == getattr(b, name)
    assert (one.final is None) == (other.final is None)
    if one.final is not None and other.final is not None:
        np.testing.assert_array_equal(one.final.image, other.final.image)
        assert one.final.rgb.dtype == other.final.rgb.dtype == np.uint8


def written(folder: Path) -> Path:
    path = folder / "demonstrations.h5"
    items = [demonstration(12), demonstration(10, final=False)]
    write_demonstrations(path, ORIGIN, items, REJECTED)
    return path


def test_a_step_rounds_colours_to_8_bits_and_keeps_heights():
    image = np.random.default_rng(0).random((4, *GRID.shape), np.float32)
    observation = Observation(image, GRID)
    taken = DemonstrationStep.of(observation, PickPlaceAction(), name="")
    assert taken.category == ""
    for found in (taken.image, FinalObservation.of(observation).image):
        assert found.shape == image.shape
        assert found.dtype == np.float32
        np.testing.assert_allclose(found[:3], image[:3], atol=0.5 / 255 + 1e-6)
        np.testing.assert_array_equal(found[3], image[3])


def test_a_written_file_reads_back(tmp_path: Path):
    path = written(tmp_path)
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    read = read_demonstrations(path)
    assert read.origin == ORIGIN
    assert read.rejected == REJECTED
    for found, expected in zip(
        read.demonstrations, [demonstration(10, final=False), demonstration(12)], strict=True
    ):
        assert_same(found, expected)
    assert read_contents(path).seeds == (10, 12)
    assert [item.seed for item in read_demonstrations(path, first=1).demonstrations] == [10]


def test_images_stay_available_when_their_file_is_replaced(tmp_path: Path):
    path = written(tmp_path)
    read = read_demonstrations(path).demonstrations
    # Replacing or deleting the file does not change the images that were read from it.
    write_demonstrations(path, ORIGIN, [demonstration(99)])
    path.unlink()
    for found, expected in zip(read, [demonstration(10), demonstration(12)], strict=True):
        taken = found.steps[1]
        assert isinstance(taken.rgb, Stored)
        assert isinstance(taken.height, Stored)
        assert taken.image is not taken.image
        np.testing.assert_array_equal(taken.image, expected.steps[1].image)


def test_the_layout_of_the_file(tmp_path: Path):
    with h5py.File(written(tmp_path)) as file:
        assert file.attrs["format"] == "kitting_drake demonstrations"
        assert file.attrs["format_version"] == 2
        assert sorted(file) == ["seed_00000010", "seed_00000012"]
        group = file["seed_00000012"]
        assert group["rgb"].shape == (3, 3, 5, 7)
        assert group["rgb"].chunks == (1, 3, 5, 7)
        assert group["height"].shape == (3, 5, 7)
        assert group["pick"].shape == group["place"].shape == (3, 3)
        assert "surface_height" not in group
        assert group["final_rgb"].shape == (3, 5, 7)
        assert group["final_height"].shape == (5, 7)
        assert group["object"].asstr()[0] == "wrench_120"
        assert "final_rgb" not in file["seed_00000010"]


def test_merging_may_include_the_file_itself(tmp_path: Path):
    path, part = written(tmp_path), tmp_path / "part.h5"
    write_demonstrations(part, ORIGIN, [demonstration(13, steps=1)])
    sources = [(path, 10), (path, 12), (part, 13)]
    merge_demonstrations(path, sources, ORIGIN, REJECTED)
    read = read_demonstrations(path)
    assert read.rejected == REJECTED
    for found, expected in zip(
        read.demonstrations,
        [demonstration(10, final=False), demonstration(12), demonstration(13, steps=1)],
        strict=True,
    ):
        assert_same(found, expected)


def test_a_failed_merge_keeps_the_old_file(tmp_path: Path):
    path = written(tmp_path)
    before = path.read_bytes()
    with pytest.raises(UserError, match="there is no file"):
        merge_demonstrations(path, [(path, 10), (tmp_path / "gone.h5", 13)], ORIGIN, [])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_not_reported_as_a_damaged_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = written(tmp_path)

    def full(*_):
        raise RuntimeError("Unable to synchronously copy object (No space left on device)")

    monkeypatch.setattr(h5py.File, "copy", full)
    with pytest.raises(UserError, match=r"cannot copy seed_00000010 of .* to .*No space left") as e:
        merge_demonstrations(path, [(path, 10)], ORIGIN, [])
    assert "delete" not in str(e.value)


def test_commits_are_recorded(tmp_path: Path):
    path = tmp_path / "demonstrations.h5"
    made = [dataclasses.replace(demonstration(seed), commit=f"c{seed % 2}") for seed in (1, 2, 3)]
    write_demonstrations(path, ORIGIN, [*made, demonstration(4)])
    assert read_contents(path).commits == ("c0", "c1")
    assert [item.commit for item in read_demonstrations(path).demonstrations] == [
        "c1",
        "c0",
        "c1",
        None,
    ]


def test_thousands_of_rejected_seeds_fit(tmp_path: Path):
    path = tmp_path / "demonstrations.h5"
    rejected = tuple(Rejection(seed, 0.75, "why " * 30) for seed in range(5000))
    write_demonstrations(path, ORIGIN, [], rejected)
    assert read_contents(path).rejected == rejected


def test_a_missing_file_is_rejected(tmp_path: Path):
    with pytest.raises(UserError, match=r"gone\.h5"):
        read_demonstrations(tmp_path / "gone.h5")


@pytest.mark.parametrize("share", [0.001, 0.5, 0.99])
def test_a_truncated_file_is_rejected(tmp_path: Path, share: float):
    path = written(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(UserError, match=r"demonstrations\.h5"):
        read_demonstrations(path)


def test_a_damaged_file_is_rejected(tmp_path: Path):
    path = written(tmp_path)
    with h5py.File(path, "a") as file:
        del file["seed_00000010"]["place"]
    with pytest.raises(UserError, match="damaged"):
        read_demonstrations(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("final_height", np.zeros((5, 8), np.float32)),
        ("final_rgb", np.zeros((5, 7, 3), np.uint8)),
        ("height", np.zeros((3, 4, 7), np.float32)),
        ("rgb", np.zeros((3, 5, 7, 3), np.uint8)),
        ("pick", np.full((3, 3), np.nan)),
        ("height", np.full((3, 5, 7), np.inf, np.float32)),
        ("place", np.zeros((2, 3))),
    ],
)
def test_invalid_content_is_rejected(tmp_path: Path, name: str, value: np.ndarray):
    path = written(tmp_path)
    with h5py.File(path, "a") as file:
        del file["seed_00000012"][name]
        file["seed_00000012"][name] = value
    with pytest.raises(UserError, match=rf"damaged.*seed_00000012/{name} "):
        read_demonstrations(path)


def test_flipped_bytes_raise_only_user_errors(tmp_path: Path):
    path = written(tmp_path)
    content, rng = path.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(100):
        damaged = bytearray(content)
        for place in rng.integers(len(content), size=4):
            damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            read_demonstrations(path)
        except UserError:
            refused += 1
    assert refused > 10


def test_a_foreign_file_is_rejected(tmp_path: Path):
    text, other = tmp_path / "notes.h5", tmp_path / "other.h5"
    text.write_text("not HDF5 at all\n")
    with h5py.File(other, "w") as file:
        file["weights"] = np.zeros(3)
    for path in (text, other):
        with pytest.raises(UserError, match=f"{path.name} is not a file of demonstrations"):
            read_demonstrations(path)


def test_another_format_version_is_rejected(tmp_path: Path):
    path = written(tmp_path)
    with h5py.File(path, "a") as file:
        file.attrs["format_version"] = 1
    with pytest.raises(UserError, match="format version 1"):
        read_demonstrations(path)


def test_reading_does_not_import_drake():
    module = "kitting_drake.policies.data.demonstrations"
    program = f"import sys, {module}; print('pydrake' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
