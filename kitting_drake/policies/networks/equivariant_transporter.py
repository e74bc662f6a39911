"""The Equivariant Transporter, the first baseline of the paper (section V-C.3).

It differs from the SO(2) method in its fields. The U-nets, whose output is invariant, have regular
fields of C_6, and the angle network has regular fields of C_N / C_2. N, the number of orientations,
is therefore part of the architecture: the angle network's parameters, kernels and time grow with N.
"""

from __future__ import annotations

from torch import Tensor

from kitting_drake.policies.networks import architecture as sizes
from kitting_drake.policies.networks.angle_net import AngleNet
from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.factored import FactoredNetworks
from kitting_drake.policies.networks.layers.fibres import Regular
from kitting_drake.policies.networks.layers.group_convolution import GroupConv2d
from kitting_drake.policies.networks.layers.steerable import Convolution, SteerableConv2d
from kitting_drake.policies.networks.unet import UNet

_ORDER = 6
"""The order of the cyclic group of the U-nets' regular fields."""


class EquivariantTransporterNetworks(FactoredNetworks):
    """The networks of the Equivariant Transporter, with regular fields.

    With the preset "paper" the angle network has the authors' 0.90, 1.81, 3.01 and 4.51 million
    parameters at N = 36, 72, 120 and 180.
    """

    def __init__(self, config: NetworkConfig, convolution: Convolution = SteerableConv2d) -> None:
        super().__init__(config)
        preset = self.preset
        fibre, angle_fibre = Regular(_ORDER), Regular(config.orientations, quotient=2)
        grouped = GroupConv2d if convolution is SteerableConv2d else convolution
        self.alpha = UNet(config.channels, 1, fibre, preset.unet, convolution)
        self.beta = AngleNet(config.channels, angle_fibre, angle_fibre, preset.group_angle, grouped)
        self.phi = UNet(config.channels, sizes.FEATURES, fibre, preset.unet, convolution)
        self.psi = UNet(config.channels, sizes.FEATURES, fibre, preset.unet, convolution)

    def check_orientations(self, orientations: int) -> None:
        """Raises ValueError if the networks were trained with another number of orientations N."""
        if orientations != self.config.orientations:
            raise ValueError(
                f"this Equivariant Transporter was trained at {self.config.orientations} "
                f"orientations and cannot predict at {orientations}: train one for that number"
            )

    def crop_angle_logits(self, crops: Tensor, orientations: int) -> Tensor:
        self.check_orientations(orientations)
        return self.beta(crops)
