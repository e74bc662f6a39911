"""Makes the networks of each method by its name in configs and command lines."""

from __future__ import annotations

from collections.abc import Callable

from kitting_drake.policies.networks.architecture import NetworkConfig
from kitting_drake.policies.networks.equivariant_transporter import EquivariantTransporterNetworks
from kitting_drake.policies.networks.factored import Networks, SO2Networks
from kitting_drake.policies.networks.layers.steerable import Convolution, SteerableConv2d
from kitting_drake.policies.networks.transporter import TransporterNetworks

_METHODS: dict[str, Callable[[NetworkConfig, Convolution], Networks]] = {
    "so2": SO2Networks,
    "equivariant_transporter": EquivariantTransporterNetworks,
    "transporter": TransporterNetworks,
}


def make_networks(config: NetworkConfig, convolution: Convolution = SteerableConv2d) -> Networks:
    """Makes the networks of a config, with untrained weights.

    Args:
        config: the architecture.
        convolution: `SteerableConv2d` for training, `PlainConv2d` to load exported weights.
    """
    return _METHODS[config.method](config, convolution)
