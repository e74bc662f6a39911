"""A policy that decides by onnxruntime and numpy, without torch: what `export_onnx` wrote.

The reference for who runs the networks elsewhere: the same decisions as `LearnedPolicy` with the
same settings. It takes from the project only what imports neither torch nor Drake.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.images import Image, crop, make_action, rotation_matrix
from kitting_drake.policies.matching.refinement import refine_grasp, refine_place
from kitting_drake.policies.matching.segmentation import segment
from kitting_drake.policies.matching.shape_matching import certain_fits
from kitting_drake.policies.networks.layers.discretization import discretization_matrix
from kitting_drake.policies.networks.layers.fourier_series import series_maximum
from kitting_drake.policies.numpy_correlation import Array, search
from systems.signals import Observation, PickPlaceAction, fill_unseen, wrap_to_pi

GRAPHS = ("alpha", "beta", "phi", "psi")
"""The networks, a file each."""
_FIELDS = (
    *("method", "orientations", "angle_frequencies", "stop", "stop_threshold", "stride"),
    *("colour", "colour_mean", "colour_std", "height_mean", "height_std", "channels"),
    *("pick_crop", "place_crop"),
)
"""The fields of `policy.json` that are read."""
_NOTHING_LOGIT = math.log(160 * 320)
"""See `losses.NOTHING_LOGIT`."""


class OnnxPolicy:
    """A function from an observation to an action, for `policy: !PythonPolicy` too."""

    def __init__(
        self,
        folder: Path,
        *,
        orientations: int = 180,
        continuous: bool = True,
        fit_outlines: bool = False,
    ) -> None:
        """
        Args:
            folder: what `export_onnx` wrote.
            orientations: N, even; that of the training for an Equivariant Transporter.
            continuous: as for `LearnedPolicy`.
            fit_outlines: as for `LearnedPolicy`.

        Raises:
            UserError: the folder cannot be used.
            ValueError: the networks cannot predict at N orientations.
            ImportError: onnxruntime is not installed.
        """
        import onnxruntime

        try:
            self.config: dict[str, Any] = json.loads((folder / "policy.json").read_text())
            missing = [key for key in _FIELDS if key not in self.config]
            if missing:
                raise ValueError(f"policy.json lacks '{missing[0]}'")
            graphs = {name: (folder / f"{name}.onnx").read_bytes() for name in GRAPHS}
        except (OSError, ValueError) as error:
            raise UserError(f"{folder} holds no policy as ONNX: {error}") from error
        self._sessions = {
            name: _session(onnxruntime, graph, folder / f"{name}.onnx")
            for name, graph in graphs.items()
        }
        self._check_orientations(orientations)
        self._orientations = orientations
        self._continuous = continuous
        self._fit_outlines = fit_outlines

    def __call__(self, observation: Observation) -> PickPlaceAction:
        """The action; both gripper poses are in the world.

        Raises:
            UserError: the pixels are of another size than those that the networks learned from.
        """
        resolution, orientations = observation.grid.resolution, self._orientations
        # Exports of earlier versions do not tell.
        learned_at = self.config.get("resolution")
        if learned_at is not None and not math.isclose(learned_at, resolution, rel_tol=1e-6):
            raise UserError(
                f"the pixels are of {resolution:g} m, and the policy of {self.config['weights']} "
                f"learned from pixels of {learned_at:g} m"
            )
        image = self._input(observation)
        rows, cols = image.shape[1:]
        outlines = segment(observation) if self._fit_outlines else None
        logits = self._run("alpha", image)[0, 0, :rows, :cols]
        if self._stops(logits):
            certain = None if outlines is None else certain_fits(outlines, resolution)
            if certain is None or not certain.any():
                return PickPlaceAction(stop=True)
            logits = np.where(certain, logits, -np.inf)
        row, col = divmod(int(logits.argmax()), cols)
        pixel = np.array([row, col], float)
        pick = pixel + _mean_offset(logits, (row, col)) if self._continuous else pixel
        theta = self._angle(self._run("beta", crop(image, (row, col), self.config["pick_crop"]))[0])
        if outlines is not None:
            grasp = refine_grasp(outlines, pick, theta, resolution)
            if grasp is not None:
                pick, theta = grasp.pick, grasp.theta

        encoding = self._run("psi", crop(image, (row, col), self.config["place_crop"]))[0]
        window = search(self._run("phi", image)[0], encoding, orientations, (rows, cols))
        found = window.best()
        if self._continuous:
            index = (found - window.origin).astype(int)
            found = found + _mean_offset(window.scores, tuple(index))
        rotation = wrap_to_pi(found[0] * math.tau / orientations)
        # The crop is centred on a pixel. Its predicted motion applies to the refined pick too.
        place = found[1:] + rotation_matrix(rotation) @ (pick - pixel)
        if outlines is not None:
            fitted = refine_place(outlines, pick, rotation, place, resolution)
            if fitted is not None:
                rotation, place = fitted.rotation, fitted.place
        return make_action(observation, pick, theta, place, rotation)

    def prepare(self, image: Image) -> Array:
        """(1, channels, rows, cols): an input of the graphs from an observation or a crop of one.

        Height alone where the networks see no colour; zeros below and on the right up to sides that
        are one above a multiple of `stride`; all normalised.

        Args:
            image: (4, rows, cols), as `Observation.image`.
        """
        config = self.config
        stride, channels = config["stride"], config["channels"]
        ends = [(0, (1 - side) % stride) for side in image.shape[1:]]
        seen = np.pad(image[-channels:], [(0, 0), *ends])
        mean = np.array([config["colour_mean"]] * 3 + [config["height_mean"]], np.float32)
        std = np.array([config["colour_std"]] * 3 + [config["height_std"]], np.float32)
        shape = (channels, 1, 1)
        return ((seen - mean[-channels:].reshape(shape)) / std[-channels:].reshape(shape))[None]

    def _check_orientations(self, orientations: int) -> None:
        """Raises ValueError as the networks' own `check_orientations`."""
        if self.config["method"] == "so2":
            discretization_matrix(orientations, self.config["angle_frequencies"], quotient=2)
        elif orientations != self.config["orientations"]:
            raise ValueError(
                f"these networks predict at {self.config['orientations']} orientations, not at "
                f"{orientations}"
            )

    def _input(self, observation: Observation) -> Image:
        if self.config["colour"]:
            return observation.image
        filled = fill_unseen(observation.height, observation.valid)
        return np.concatenate([observation.rgb, filled[None]])

    def _run(self, name: str, image: Image) -> Array:
        (output,) = self._sessions[name].run(["output"], {"image": self.prepare(image)})
        return output

    def _stops(self, logits: Array) -> bool:
        threshold = self.config["stop_threshold"]
        if not self.config["stop"] or threshold is None:
            return False
        most = float(logits.max())
        total = most + math.log(float(np.exp(logits.astype(np.float64) - most).sum()))
        return total - _NOTHING_LOGIT < threshold

    def _angle(self, output: Array) -> float:
        """The gripper's angle, in radians, from beta's output: coefficients, or logits of bins."""
        values, frequencies = output.astype(np.float64), self.config["angle_frequencies"]
        step = math.tau / self._orientations
        if self.config["method"] != "so2":
            return int(values.argmax()) * step
        if self._continuous:
            return series_maximum(values, frequencies)
        matrix = discretization_matrix(self._orientations, frequencies, quotient=2)
        return int((matrix @ values).argmax()) * step


def _session(onnxruntime: Any, graph: bytes, path: Path) -> Any:
    """Raises UserError for a graph that cannot be run."""
    try:
        return onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    except Exception as error:
        # onnxruntime has an exception of its own for each way to fail, and no common one.
        raise UserError(f"{path} is no network as ONNX") from error


def _mean_offset(logits: Array, index: tuple[int, ...]) -> NDArray[np.float64]:
    """Sub-pixel and sub-bin refinement: the mean offset from an entry under the softmax over it and
    its neighbours."""
    starts = [max(i - 1, 0) for i in index]
    part = logits[tuple(slice(start, i + 2) for start, i in zip(starts, index, strict=True))]
    weights = np.exp(part.astype(np.float64) - part.max())
    weights /= weights.sum()
    offsets = np.stack(np.meshgrid(*(np.arange(n) for n in part.shape), indexing="ij"))
    mean = (offsets * weights).reshape(len(index), -1).sum(axis=1)
    return np.array(starts) + mean - np.array(index)
