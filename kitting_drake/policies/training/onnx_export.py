"""ONNX export of the networks; docs/learning.md describes how to run them."""

from __future__ import annotations

import copy
import dataclasses
import tempfile
import warnings
from pathlib import Path
from types import ModuleType

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.common.files import require_folder, write_atomically, write_json
from kitting_drake.policies.networks import architecture as sizes
from kitting_drake.policies.networks.factored import FactoredNetworks
from kitting_drake.policies.networks.layers.steerable import BlurPool
from kitting_drake.policies.networks.unet import STRIDE
from kitting_drake.policies.networks.weights import load_networks, read_weights_file

GRAPHS = ("alpha", "beta", "phi", "psi")
"""Names of the exported networks. Each is written to its own file."""
_OPSET = 17


class _BlurOfAnySize(nn.Module):
    """`BlurPool` in ONNX operators that support any image size."""

    kernel: Tensor

    def __init__(self, pool: BlurPool) -> None:
        super().__init__()
        self.register_buffer("kernel", pool.kernel[None, None].clone())

    def forward(self, features: Tensor) -> Tensor:
        """Maps (batch, channels, rows, cols) with odd sides to half the resolution."""
        alone = features.reshape(-1, 1, features.shape[2], features.shape[3])
        halved = F.conv2d(alone, self.kernel, stride=2, padding=2)
        return halved.reshape(features.shape[0], -1, halved.shape[2], halved.shape[3])


def require_onnx() -> ModuleType:
    """Imports the package onnx.

    Raises:
        UserError: the package is not installed.
    """
    return import_extra("onnx", purpose="--export onnx", extra="onnx")


def export_onnx(weights: Path, folder: Path) -> list[Path]:
    """Writes the networks of a weights file as ONNX in float32, and `policy.json`.

    Each graph maps `image`, prepared as `policy.json` describes, to `output`. The U-nets alpha, phi
    and psi take images whose sides are one more than a multiple of 16 pixels; beta takes a crop
    with sides of `PICK_CROP` pixels. The steps that make, rotate and correlate crops are not
    exported (see docs/learning.md).

    Args:
        weights: a file that `train` wrote.
        folder: the output folder.

    Returns:
        The paths of the files.

    Raises:
        UserError: the weights are unusable, they are those of a Transporter, or the package onnx is
            not installed.
    """
    networks = load_networks(weights)
    card = read_weights_file(weights).card
    if not isinstance(networks, FactoredNetworks):
        raise UserError(
            f"{weights}: a {networks.config.method} cannot be exported as ONNX, because it rotates "
            "images between its networks: give weights of another method"
        )
    onnx = require_onnx()
    require_folder(folder)
    config = networks.config
    written = []
    # Write this file last, because it marks a complete export.
    described_in = folder / "policy.json"
    described_in.unlink(missing_ok=True)
    for name in GRAPHS:
        side = sizes.PICK_CROP if name == "beta" else 4 * STRIDE + 1
        example = torch.zeros(1, config.channels, side, side)
        content = _graph(getattr(networks, name), example, any_size=name != "beta")
        onnx.checker.check_model(onnx.load_from_string(content))
        written.append(folder / f"{name}.onnx")
        write_atomically(written[-1], content)
    described = {
        "format": "kitting_drake ONNX policy",
        "format_version": 1,
        **dataclasses.asdict(config),
        "stop_threshold": networks.stop_threshold,
        "channels": config.channels,
        "pick_crop": sizes.PICK_CROP,
        "place_crop": sizes.PLACE_CROP,
        "stride": STRIDE,
        "resolution": card.get("resolution"),
        "weights": weights.name,
    }
    write_json(described_in, described)
    return [*written, described_in]


def _graph(network: nn.Module, example: Tensor, *, any_size: bool) -> bytes:
    exported = copy.deepcopy(network)
    for module in list(exported.modules()):
        for name, child in module.named_children():
            if isinstance(child, BlurPool):
                setattr(module, name, _BlurOfAnySize(child))
    axes = {2: "rows", 3: "cols"}
    with (
        tempfile.TemporaryDirectory() as scratch,
        warnings.catch_warnings(),
        torch.no_grad(),
    ):
        # This exporter warns about traced shape checks and about its own deprecation. The newer one
        # takes a minute per network instead of a second.
        warnings.simplefilter("ignore")
        file = Path(scratch) / "network.onnx"
        torch.onnx.export(
            exported.eval(),
            (example,),
            file,
            dynamo=False,
            opset_version=_OPSET,
            input_names=["image"],
            output_names=["output"],
            dynamic_axes={"image": axes, "output": axes} if any_size else None,
        )
        return file.read_bytes()
