"""Networks as ONNX: the same outputs, and the same decisions, without torch."""

import math
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.layers.correlation import search as torch_search
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.weights import load_networks, save_weights
from kitting_drake.policies.numpy_correlation import search
from kitting_drake.policies.onnx_runner import OnnxPolicy
from kitting_drake.policies.training import onnx_export
from kitting_drake.policies.training.onnx_export import export_onnx
from systems.signals import Observation, PickPlaceAction, PixelGrid

DATA = Path(__file__).parents[1] / "observations"
GENERALIST = MODELS / "policies" / "generalist.safetensors"
ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The generalist as ONNX."""
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    folder = tmp_path_factory.mktemp("onnx")
    export_onnx(GENERALIST, folder)
    return folder


def observations() -> list[Observation]:
    """The stored ones, and their mirror images."""
    seen = []
    for name in ("kitting_seen", "kitting_unseen", "kitting_unseen_final"):
        stored = np.load(DATA / f"{name}.npz")
        height = stored["height_tenth_mm"].astype(np.float32)[None] * np.float32(1e-4)
        image = np.concatenate([stored["rgb"].astype(np.float32) / 255, height])
        seen += [Observation(image, PixelGrid()), Observation(image[:, ::-1].copy(), PixelGrid())]
    return seen


def assert_alike(one: PickPlaceAction, other: PickPlaceAction) -> None:
    assert one.stop == other.stop
    if one.stop:
        return
    for name in ("pick", "place"):
        a, b = getattr(one, name), getattr(other, name)
        assert math.hypot(a.x - b.x, a.y - b.y) < 2e-6
        assert abs(math.remainder(a.theta - b.theta, math.tau)) < 1e-4


def test_the_graphs_agree_with_torch(exported: Path):
    import onnxruntime

    networks = load_networks(GENERALIST)
    image = observations()[1].image
    parts = {"alpha": image, "beta": image[:, 40:105, 100:165], "phi": image, "psi": image}
    for name, part in parts.items():
        prepared = networks.prepare(part)
        with torch.inference_mode():
            expected = getattr(networks, name)(prepared).numpy()
        session = onnxruntime.InferenceSession(str(exported / f"{name}.onnx"))
        (found,) = session.run(None, {"image": prepared.numpy()})
        # Rounding errors of float32, which differ from one processor to the next: 1e-5 of logits
        # that reach forty.
        assert np.abs(found - expected).max() < 5e-5 * max(10.0, np.abs(expected).max())
        assert np.abs(OnnxPolicy(exported).prepare(part) - prepared.numpy()).max() < 1e-6


@pytest.mark.parametrize("settings", [{}, {"continuous": False}, {"fit_outlines": True}])
def test_decisions_are_the_same(exported: Path, settings: dict[str, bool]):
    expected = LearnedPolicy(load_networks(GENERALIST), **settings)
    found = OnnxPolicy(exported, **settings)
    actions = [(expected(item), found(item)) for item in observations()]
    for one, other in actions:
        assert_alike(one, other)
    assert {one.stop for one, _ in actions} == {False, True}


def test_the_search_in_numpy_is_that_in_torch():
    generator = torch.Generator().manual_seed(3)
    scene = torch.randn(1, 3, 97, 113, generator=generator)
    encoding = torch.randn(1, 3, 97, 97, generator=generator)
    candidates, _ = torch_search(scene, encoding, 72, shape=(90, 110))
    window = search(scene[0].numpy(), encoding[0].numpy(), 72, (90, 110))
    assert window.corner == candidates[0].corner
    assert window.first_bin == candidates[0].first_bin
    np.testing.assert_allclose(window.scores, candidates[0].scores.numpy(), atol=2e-3)


def test_an_export_that_is_stopped_is_no_policy(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "onnx"
    shutil.copytree(exported, folder)

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(onnx_export, "_graph", stop)
    with pytest.raises(KeyboardInterrupt):
        export_onnx(GENERALIST, folder)
    with pytest.raises(UserError):
        OnnxPolicy(folder)


def test_it_runs_without_torch_and_drake(exported: Path):
    program = (
        "import sys; sys.modules['torch'] = sys.modules['pydrake'] = None\n"
        "from pathlib import Path\n"
        "from kitting_drake.policies.onnx_runner import OnnxPolicy\n"
        "from systems.signals import Observation\n"
        f"print(OnnxPolicy(Path({str(exported)!r}))(Observation()).stop)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "True\n", done.stderr


def test_what_cannot_be_exported_is_told(tmp_path: Path):
    path = tmp_path / "policy.safetensors"
    config = NetworkConfig(method="transporter", preset="tiny", orientations=36)
    save_weights(path, make_networks(config), {})
    with pytest.raises(UserError, match="a transporter cannot be exported as ONNX"):
        export_onnx(path, tmp_path / "onnx")
    with pytest.raises(UserError, match="there is no such file"):
        export_onnx(tmp_path / "none.safetensors", tmp_path / "onnx")
    pytest.importorskip("onnxruntime")
    with pytest.raises(UserError, match="holds no policy as ONNX"):
        OnnxPolicy(tmp_path)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("alpha.onnx", b"junk", "alpha.onnx is no network as ONNX"),
        ("policy.json", b"{}", "policy.json lacks 'method'"),
    ],
)
def test_a_damaged_policy_is_told(
    exported: Path, tmp_path: Path, file: str, content: bytes, message: str
):
    damaged = tmp_path / "onnx"
    shutil.copytree(exported, damaged)
    (damaged / file).write_bytes(content)
    with pytest.raises(UserError, match=message):
        OnnxPolicy(damaged)


def test_pixels_of_another_size_are_refused(exported: Path):
    seen = observations()[0]
    other = Observation(seen.image, PixelGrid(resolution=0.002))
    with pytest.raises(UserError, match=r"0\.002 m, and the policy of generalist\.safetensors"):
        OnnxPolicy(exported)(other)


def test_it_predicts_at_the_orientations_of_the_networks_only(exported: Path):
    networks = load_networks(GENERALIST)
    for orientations in (0, 16, 181):
        for make in (
            lambda n: LearnedPolicy(networks, orientations=n),
            lambda n: OnnxPolicy(exported, orientations=n),
        ):
            with pytest.raises(ValueError, match=f"{orientations} orientations"):
                make(orientations)


def test_the_command_exports_what_was_trained(weights_file: Path, verb):
    pytest.importorskip("onnx")
    folder = weights_file.parent
    done = verb("train", "--export", "onnx", "--output", folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "onnx" / "psi.onnx").is_file()
    assert verb("train", "--export", "onnx").returncode == 2
    assert verb("train").returncode == 2


@pytest.mark.slow
def test_twenty_rendered_scenes_are_decided_alike(exported: Path, rendering: None):
    gymnasium = pytest.importorskip("gymnasium")
    from kitting_drake.gym.spaces import as_observation

    expected = LearnedPolicy(load_networks(GENERALIST), fit_outlines=True)
    found = OnnxPolicy(exported, fit_outlines=True)
    environment = gymnasium.make("kitting_drake.gym:kitting_drake/KittingUnseen-v0")
    for seed in range(100, 120):
        arrays, _ = environment.reset(seed=seed)
        seen = as_observation(arrays, environment.unwrapped.grid)
        assert_alike(expected(seen), found(seen))
