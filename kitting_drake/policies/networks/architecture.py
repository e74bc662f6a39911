"""The config of a policy's networks, which a weights file stores."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from kitting_drake.policies.networks.angle_net import AngleNetSize
from kitting_drake.policies.networks.unet import UNetSize

METHODS = ("so2", "equivariant_transporter", "transporter")
"""The paper's own method and its two baselines (section V-C.3)."""


@dataclass(frozen=True)
class Preset:
    """A named set of sizes for the networks of all methods."""

    unet: UNetSize = field(default_factory=UNetSize)
    """The size of the U-nets alpha, phi and psi."""
    samples: int = 16
    """The number of samples of each SO(2) field of the U-nets, on which the nonlinearity acts."""
    angle: AngleNetSize = field(
        default_factory=lambda: AngleNetSize(
            stages=((16,), (32, 32), (16, 16), (16, 16), (8,)), residual=True
        )
    )
    """The size of the pick-angle network beta."""
    angle_band: int = 6
    """The cutoff frequency j_c of beta's hidden fields."""
    angle_samples: int = 32
    """The number of samples of each of beta's SO(2) fields, on which the nonlinearity acts."""
    group_angle: AngleNetSize = field(
        default_factory=lambda: AngleNetSize(
            stages=((18,), (36, 36), (18, 18), (18, 18), (8,)), residual=True
        )
    )
    """The size of the Equivariant Transporter's angle network, whose fields are regular and have
    N / 2 channels. The default gives as many parameters as the authors report: 0.90, 1.81, 3.01 and
    4.51 million at N = 36, 72, 120 and 180."""
    resnet: tuple[int, int, int, int, int] = (64, 64, 128, 256, 512)
    """The numbers of channels of the Transporter's stem and of its four stages."""


_SMALL = Preset(
    unet=UNetSize(down=(4, 8, 16, 24, 24), up=(16, 8, 4, 4), head=8, skip=1),
    samples=8,
    angle=AngleNetSize(
        stages=((12, 12), (24, 24), (24, 24), (24,)), kernel=3, readout=9, full_readout=True
    ),
    angle_band=3,
    angle_samples=8,
    group_angle=AngleNetSize(
        stages=((2, 2), (4, 4), (6, 6), (6,)), kernel=3, readout=9, full_readout=True
    ),
    resnet=(16, 16, 24, 32, 48),
)

PRESETS = {
    # The sizes in section V-A of the paper.
    "paper": Preset(),
    # For machines without an accelerator: each U-net has 0.16 M parameters.
    "small": _SMALL,
    # As "small", but the baselines are reduced by the same factor as the SO(2) networks. The
    # Transporter has 1/25 of the original's parameters. At N = 36 the Equivariant Transporter's
    # angle network has as many parameters as beta.
    "matched": dataclasses.replace(
        _SMALL,
        group_angle=AngleNetSize(
            stages=((6, 6), (13, 13), (20, 20), (20,)), kernel=3, readout=9, full_readout=True
        ),
        resnet=(13, 13, 26, 52, 102),
    ),
    # For tests: every part of the architecture has its smallest size.
    "tiny": Preset(
        unet=UNetSize(down=(2, 4, 4, 4, 4), up=(4, 4, 2, 2), head=4, skip=1),
        samples=8,
        angle=AngleNetSize(stages=((4, 4), (6, 6), (6,)), kernel=3, readout=17, full_readout=True),
        angle_band=3,
        angle_samples=8,
        group_angle=AngleNetSize(
            stages=((1,), (2,), (2,), (2,)), kernel=3, readout=9, full_readout=True
        ),
        resnet=(8, 8, 8, 12, 16),
    ),
}

BAND = 3
"""The cutoff frequency j_c of alpha, phi and psi (section V-A.1)."""
ANGLE_FREQUENCIES = (0, 2, 4, 6, 8, 10, 12)
"""The frequencies of beta's output on SO(2)/C_2: j = 0 to 6, period pi (section V-A.2)."""
FEATURES = 3
"""The number of channels of phi's and psi's encodings."""
PICK_CROP = 65
"""The side of c_1, the crop that beta takes, in pixels."""
PLACE_CROP = 97
"""The side of c_2, the crop that psi takes, in pixels."""


@dataclass(frozen=True)
class NetworkConfig:
    """The architecture of a method's networks, and how their inputs are normalised."""

    method: str = "so2"
    """The method, one of METHODS."""
    preset: str = "small"
    """The name of the networks' size, one of PRESETS."""
    orientations: int = 180
    """N, the number of orientations in a full turn, at which the networks are trained."""
    colour_mean: float = 0.5
    """The mean colour in training; inputs are normalised by it."""
    colour_std: float = 0.25
    """The standard deviation of the colours in training."""
    height_mean: float = 0.005
    """The mean height in training, in metres."""
    height_std: float = 0.01
    """The standard deviation of the heights in training, in metres."""
    band: int = BAND
    """The cutoff frequency j_c of the U-nets' fields."""
    angle_frequencies: tuple[int, ...] = ANGLE_FREQUENCIES
    """The frequencies of the output of the pick-angle network beta."""
    colour: bool = True
    """Whether the networks see colours. Otherwise they see only heights, with unseen pixels filled
    in (see `systems.signals.fill_unseen`)."""
    stop: bool = False
    """Whether the picking module has a class "nothing to pick" (see `losses.log_odds`)."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, not '{self.method}'")
        if self.preset not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, not '{self.preset}'")
        if self.orientations < 2 or self.orientations % 2:
            raise ValueError(f"orientations must be an even number, not {self.orientations}")
        if not isinstance(self.colour, bool):
            raise ValueError(f"colour must be true or false, not '{self.colour}'")
        scales = (self.colour_std, self.height_std)
        if not all(map(math.isfinite, (self.colour_mean, self.height_mean, *scales))):
            raise ValueError(
                "means and standard deviations of colours and heights must be finite, not "
                f"{(self.colour_mean, self.height_mean, *scales)}"
            )
        if min(scales) <= 0:
            raise ValueError(f"standard deviations must be positive, not {scales}")

    @property
    def channels(self) -> int:
        """The number of input channels: red, green, blue and height, or only height."""
        return 4 if self.colour else 1

    def has_unets_of(self, preset: str) -> bool:
        """Whether alpha, phi and psi have the sizes of a preset; beta may differ."""
        own, other = PRESETS[self.preset], PRESETS[preset]
        return (own.unet, own.samples) == (other.unet, other.samples)

    def as_dict(self) -> dict[str, Any]:
        """Returns the fields as JSON values."""
        return dataclasses.asdict(self)
