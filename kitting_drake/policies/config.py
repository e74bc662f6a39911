"""What a policy's networks are made of: all that a weights file must say beside the weights."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from kitting_drake.policies.angle_net import AngleNetSize
from kitting_drake.policies.unet import UNetSize

METHODS = ("so2", "equivariant_transporter", "transporter")
"""The paper's own, and its two baselines (section V-C.3)."""


@dataclass(frozen=True)
class Preset:
    """How large the networks of a method are."""

    unet: UNetSize = field(default_factory=UNetSize)
    """Of alpha, phi and psi."""
    samples: int = 16
    """Samples of each SO(2) field of the U-nets, at which their nonlinearity acts."""
    angle: AngleNetSize = field(
        default_factory=lambda: AngleNetSize(
            stages=((16,), (32, 32), (16, 16), (16, 16), (8,)), residual=True
        )
    )
    """Of beta."""
    angle_band: int = 6
    """j_c of beta's hidden fields."""
    angle_samples: int = 32
    """Samples of each of beta's SO(2) fields."""
    group_angle: AngleNetSize = field(
        default_factory=lambda: AngleNetSize(
            stages=((18,), (36, 36), (18, 18), (18, 18), (8,)), residual=True
        )
    )
    """Of the Equivariant Transporter's angle network, in regular fields of N / 2 channels; these,
    in blocks, have the authors' 0.90, 1.81, 3.01 and 4.51 M parameters at N = 36, 72, 120, 180."""
    resnet: tuple[int, int, int, int, int] = (64, 64, 128, 256, 512)
    """Channels of the Transporter's stem and of its four stages."""


PRESETS = {
    # Section V-A of the paper.
    "paper": Preset(),
    # For machines without an accelerator: 0.2 M parameters for each U-net.
    "small": Preset(
        unet=UNetSize(down=(4, 8, 16, 24, 24), up=(16, 8, 4, 4), head=8, skip=1),
        samples=8,
        angle=AngleNetSize(
            stages=((12, 12), (24, 24), (24, 24), (24,)), kernel=3, readout=9, whole=True
        ),
        angle_band=3,
        angle_samples=8,
        group_angle=AngleNetSize(
            stages=((2, 2), (4, 4), (6, 6), (6,)), kernel=3, readout=9, whole=True
        ),
        resnet=(16, 16, 24, 32, 48),
    ),
    # For tests: everything is there, and nothing is large.
    "tiny": Preset(
        unet=UNetSize(down=(2, 4, 4, 4, 4), up=(4, 4, 2, 2), head=4, skip=1),
        samples=8,
        angle=AngleNetSize(stages=((4, 4), (6, 6), (6,)), kernel=3, readout=17, whole=True),
        angle_band=3,
        angle_samples=8,
        group_angle=AngleNetSize(stages=((1,), (2,), (2,), (2,)), kernel=3, readout=9, whole=True),
        resnet=(8, 8, 8, 12, 16),
    ),
}

BAND = 3
"""j_c of alpha, phi and psi (section V-A.1)."""
ANGLE_FREQUENCIES = (0, 2, 4, 6, 8, 10, 12)
"""Of beta's answer, on SO(2)/C_2: j = 0 to 6 over a half turn (section V-A.2)."""
FEATURES = 3
"""Channels of phi's and psi's encodings."""
PICK_CROP = 65
"""Side of c_1, beta's input, in pixels."""
PLACE_CROP = 97
"""Side of c_2, psi's input, in pixels."""


@dataclass(frozen=True)
class NetworkConfig:
    """Which networks, and for which inputs."""

    method: str = "so2"
    """One of METHODS."""
    preset: str = "small"
    """One of PRESETS."""
    orientations: int = 180
    """N at which they are trained."""
    colour_mean: float = 0.5
    """Of the inputs' colours, which are normalised by it ..."""
    colour_deviation: float = 0.25
    """... and by their standard deviation."""
    height_mean: float = 0.005
    """Of the inputs' heights, in metres."""
    height_deviation: float = 0.01
    """Likewise."""
    band: int = BAND
    """j_c of the U-nets' fields."""
    angle_frequencies: tuple[int, ...] = ANGLE_FREQUENCIES
    """Of beta's answer."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, not '{self.method}'")
        if self.preset not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, not '{self.preset}'")
        if self.orientations < 2 or self.orientations % 2:
            raise ValueError(f"orientations must be an even number, not {self.orientations}")
        deviations = (self.colour_deviation, self.height_deviation)
        if not all(map(math.isfinite, (self.colour_mean, self.height_mean, *deviations))):
            raise ValueError("means and standard deviations must be finite")
        if min(deviations) <= 0:
            raise ValueError("a standard deviation must be positive")

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dataclasses.asdict(self)
