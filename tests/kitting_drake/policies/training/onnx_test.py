"""Networks exported as ONNX give the same outputs as torch."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from kitting_drake import train
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import GENERALIST
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.weights import load_networks, save_weights
from kitting_drake.policies.training import onnx_export
from kitting_drake.policies.training.onnx_export import GRAPHS, export_onnx
from tests.kitting_drake.policies.scenes import stored_observation


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The generalist as ONNX."""
    pytest.importorskip("onnx")
    folder = tmp_path_factory.mktemp("onnx")
    export_onnx(GENERALIST, folder)
    return folder


@pytest.fixture(scope="module")
def generalist() -> Networks:
    return load_networks(GENERALIST)


def prepared(image: np.ndarray, config: dict) -> np.ndarray:
    """The input of a graph (1, channels, rows, cols), made as docs/learning.md describes."""
    channels, stride = config["channels"], config["stride"]
    ends = [(0, (1 - side) % stride) for side in image.shape[1:]]
    seen = np.pad(image[-channels:], [(0, 0), *ends])
    mean = np.array([config["colour_mean"]] * 3 + [config["height_mean"]], np.float32)[-channels:]
    std = np.array([config["colour_std"]] * 3 + [config["height_std"]], np.float32)[-channels:]
    return ((seen - mean[:, None, None]) / std[:, None, None])[None]


@pytest.mark.parametrize("name", GRAPHS)
def test_the_graphs_agree_with_torch(exported: Path, generalist: Networks, name: str):
    onnxruntime = pytest.importorskip("onnxruntime")
    networks = generalist
    config = json.loads((exported / "policy.json").read_text())
    assert config["stop_threshold"] == networks.stop_threshold
    session = onnxruntime.InferenceSession(str(exported / f"{name}.onnx"))
    # All graphs but beta take any size.
    sizes = {"alpha": 96, "beta": config["pick_crop"], "phi": 160, "psi": config["place_crop"]}
    image = stored_observation("kitting_unseen").image[:, : sizes[name], 60 : 60 + sizes[name]]
    image = image[..., :128] if name == "phi" else image
    given = prepared(image, config)
    assert np.abs(given - networks.prepare(image).numpy()).max() < 1e-6
    with torch.inference_mode():
        expected = getattr(networks, name)(torch.from_numpy(given)).numpy()
    (found,) = session.run(["output"], {"image": given})
    # Rounding in float32 differs between processors: by about 1e-5 for logits of up to 40.
    assert np.abs(found - expected).max() < 5e-5 * max(10.0, np.abs(expected).max())


def test_a_stopped_export_has_no_policy_file(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "onnx"
    shutil.copytree(exported, folder)

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(onnx_export, "_graph", stop)
    with pytest.raises(KeyboardInterrupt):
        export_onnx(GENERALIST, folder)
    assert not (folder / "policy.json").exists()


def test_impossible_exports_raise_user_errors(tmp_path: Path):
    path = tmp_path / "policy.safetensors"
    config = NetworkConfig(method="transporter", preset="tiny", orientations=36)
    save_weights(path, make_networks(config), {})
    with pytest.raises(UserError, match="transporter cannot be exported"):
        export_onnx(path, tmp_path / "onnx")
    with pytest.raises(UserError, match=r"none\.safetensors"):
        export_onnx(tmp_path / "none.safetensors", tmp_path / "onnx")


@pytest.mark.slow
def test_the_command_exports_trained_networks(
    weights_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("onnx")
    folder = weights_file.parent

    def command(*words: str) -> None:
        monkeypatch.setattr("sys.argv", ["train", *words])
        train.main()

    command("--export", "onnx", "--output", str(folder))
    assert (folder / "onnx" / "psi.onnx").is_file()
    for words in (["--export", "onnx"], []):
        with pytest.raises(SystemExit) as caught:
            command(*words)
        assert caught.value.code == 2
    assert "--demos is required" in capsys.readouterr().err
