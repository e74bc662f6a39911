"""The SO(2) networks built from escnn's own modules, as a reference for `SteerableConv2d`.

They copy the weights of this package's networks and compute the same function. Their features are
Fourier coefficients, which FourierELU transforms to samples and back. Only the benchmark and the
tests use this module.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kitting_drake.policies.networks.angle_net import AngleNet
from kitting_drake.policies.networks.factored import Networks, SO2Networks
from kitting_drake.policies.networks.layers.fibres import Fibre, Irreps, Scalar
from kitting_drake.policies.networks.layers.planar_escnn import enn, gspaces
from kitting_drake.policies.networks.layers.steerable import (
    SteerableConv2d,
    frequencies_cutoff,
    upsample,
)
from kitting_drake.policies.networks.methods import make_networks
from kitting_drake.policies.networks.unet import ResidualBlock, UNet

_SIGMA = 0.66
"""The standard deviation of the pooling blur in pixels, as in `BlurPool`."""


def as_escnn(networks: SO2Networks, autocast: torch.dtype | None = None) -> Networks:
    """Returns the same networks, built from escnn's modules.

    Args:
        networks: networks made with `SteerableConv2d`; their weights are copied.
        autocast: the type for torch's automatic mixed precision; None for float32.
    """
    reference = make_networks(networks.config)
    for name, network in networks.named_children():
        if isinstance(network, UNet):
            setattr(reference, name, EscnnUNet(network, autocast))
        elif isinstance(network, AngleNet):
            setattr(reference, name, EscnnAngleNet(network, autocast))
    return reference.to(networks.device)


class EscnnUNet(nn.Module):
    """A `UNet` built from escnn's modules."""

    def __init__(self, source: UNet, autocast: torch.dtype | None = None) -> None:
        super().__init__()
        self.autocast = autocast
        self.lift = _convolution(source.lift)
        self.elu = _fourier_elu(source.lift)
        self.down = nn.ModuleList(_EscnnBlock(block) for block in source.down)
        last = source.up[-1]
        self.up = nn.ModuleList(_EscnnBlock(block, invariant=block is last) for block in source.up)
        self.pools = nn.ModuleList(_pool(block.out_type) for block in self.down[:-1])
        self.mix = _convolution(source.mix)
        self.mix_elu = enn.ELU(self.mix.out_type, inplace=True)
        self.out = _convolution(source.out)

    def forward(self, image: Tensor) -> Tensor:
        """Maps (batch, in channels, rows, cols) to (batch, out channels, rows, cols) in float32."""
        with _autocast(image, self.autocast):
            features = self.elu(self.lift(enn.GeometricTensor(image, self.lift.in_type)))
            levels = []
            for index, block in enumerate(self.down):
                if index:
                    levels.append(features)
                    features = self.pools[index - 1](features)
                features = block(features)
            for block in self.up:
                # escnn's R2Upsampling computes the same, but needs the size at construction.
                larger = enn.GeometricTensor(upsample(features.tensor), features.type)
                features = block(enn.tensor_directsum([larger, levels.pop()]))
            # escnn distinguishes a field of frequency 0 alone from a trivial field, so change its
            # type.
            scalars = enn.GeometricTensor(features.tensor, self.mix.in_type)
            return self.out(self.mix_elu(self.mix(scalars))).tensor.float()


class _EscnnBlock(nn.Module):
    """A `ResidualBlock` built from escnn's modules."""

    def __init__(self, source: nn.Module, *, invariant: bool = False) -> None:
        """
        Args:
            source: the block to copy.
            invariant: whether the output is only the invariant part.
        """
        super().__init__()
        assert isinstance(source, ResidualBlock)
        self.first = _convolution(source.first)
        self.first_elu = _fourier_elu(source.first)
        self.second = _convolution(source.second)
        self.shortcut = (
            _convolution(source.shortcut)
            if isinstance(source.shortcut, SteerableConv2d)
            else enn.IdentityModule(self.first.in_type)
        )
        self.elu = _fourier_elu(source.second, invariant=invariant)
        self.out_type = self.elu.out_type

    def forward(self, features: enn.GeometricTensor) -> enn.GeometricTensor:
        """Maps (batch, coefficients in, rows, cols) to (batch, coefficients out, rows, cols)."""
        hidden = self.second(self.first_elu(self.first(features)))
        return self.elu(hidden + self.shortcut(features))


class EscnnAngleNet(nn.Module):
    """An `AngleNet` of irreps built from escnn's modules."""

    def __init__(self, source: AngleNet, autocast: torch.dtype | None = None) -> None:
        super().__init__()
        self.autocast = autocast
        modules: list[nn.Module] = []
        for stage in source.stages:
            if modules:
                modules.append(_pool(modules[-1].out_type))
            assert isinstance(stage, nn.ModuleList)
            for layer in stage:
                if isinstance(layer, ResidualBlock):
                    modules.append(_EscnnBlock(layer))
                else:
                    modules += [_convolution(layer), _fourier_elu(layer)]
        self.layers = nn.Sequential(*modules, _convolution(source.readout))
        self.in_type = modules[0].in_type

    def forward(self, crop: Tensor) -> Tensor:
        """Maps (batch, in channels, side, side) to (batch, out channels), in float32."""
        with _autocast(crop, self.autocast):
            features = self.layers(enn.GeometricTensor(crop, self.in_type))
            return features.tensor.float().mean(dim=(2, 3))


def _autocast(image: Tensor, type_: torch.dtype | None) -> torch.autocast:
    return torch.autocast(image.device.type, type_, enabled=type_ is not None)


def _field_type(fibre: Fibre, count: int) -> enn.FieldType:
    space = gspaces.rot2dOnR2(-1, maximum_frequency=1)
    if isinstance(fibre, Scalar):
        return enn.FieldType(space, count * [space.trivial_repr])
    if not isinstance(fibre, Irreps):
        raise ValueError(f"{fibre} is not a fibre of SO(2)")
    irreps = [(j,) for j in fibre.frequencies]
    group = space.fibergroup
    return enn.FieldType(space, count * [group.spectral_regular_representation(*irreps, name=None)])


def _convolution(source: nn.Module) -> enn.R2Conv:
    """Makes escnn's version of a convolution, with the same weights. Both store their weights in
    the same order."""
    assert isinstance(source, SteerableConv2d)
    out_fields, in_fields, _ = source.weights.shape
    layer = enn.R2Conv(
        _field_type(source.in_fibre, in_fields),
        _field_type(source.out_fibre, out_fields),
        source.basis.shape[-1],
        padding=source.padding,
        bias=source.bias is not None,
        initialize=False,
        frequencies_cutoff=frequencies_cutoff(
            source.in_fibre, source.out_fibre, source.basis.shape[-1]
        ),
    )
    with torch.no_grad():
        layer.weights.copy_(source.weights.flatten())
        if source.bias is not None:
            layer.bias.copy_(source.bias)
    return layer


def _fourier_elu(source: nn.Module, *, invariant: bool = False) -> enn.FourierELU:
    """Makes the nonlinearity after a convolution, with as many samples as the output fibre has."""
    assert isinstance(source, SteerableConv2d)
    assert isinstance(source.out_fibre, Irreps)
    return enn.FourierELU(
        gspaces.rot2dOnR2(-1, maximum_frequency=1),
        len(source.weights),
        [(j,) for j in source.out_fibre.frequencies],
        out_irreps=[(0,)] if invariant else None,
        type="regular",
        N=source.out_fibre.samples,
    )


def _pool(type_: enn.FieldType) -> enn.PointwiseAvgPoolAntialiased2D:
    return enn.PointwiseAvgPoolAntialiased2D(type_, sigma=_SIGMA, stride=2)
