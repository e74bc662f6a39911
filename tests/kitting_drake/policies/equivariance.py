"""Smooth images, rotations of them, and equivariance errors."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from kitting_drake.policies.networks.layers.correlation import lift


def distance_from_middle(side: int) -> Tensor:
    """(side, side): each pixel's distance from the image's middle, in units of half the side."""
    offset = torch.arange(side, dtype=torch.float32) - side // 2
    return torch.hypot(offset[:, None], offset[None, :]) / (side / 2)


def smooth_image(side: int, *, seed: int = 0, channels: int = 4, blur: int = 6) -> Tensor:
    """A random image (1, channels, side, side), blurred by `blur` pixels, zero at the edge."""
    generator = torch.Generator().manual_seed(seed)
    reach = 3 * blur
    noise = torch.randn(channels, 1, side + 2 * reach, side + 2 * reach, generator=generator)
    taps = torch.exp(-((torch.arange(-reach, reach + 1) / blur) ** 2) / 2)
    noise = F.conv2d(F.conv2d(noise, taps[None, None, None, :]), taps[None, None, :, None])
    disc = torch.sigmoid(40 * (0.7 - distance_from_middle(side)))
    return (noise / noise.std() * disc).transpose(0, 1)


def rotate_image(image: Tensor, degrees: float) -> Tensor:
    """A square image rotated counter-clockwise about its centre; exact for multiples of 90."""
    quarters, rest = divmod(degrees, 90)
    if rest == 0:
        return image.rot90(int(quarters), (2, 3))
    return lift(image, torch.tensor([math.radians(degrees)]), image.shape[-1])


def relative_error(found: Tensor, expected: Tensor) -> float:
    """The norm of the difference, relative to the norm of the expected image's variation.

    Only the pixels of a disc inside the images count.
    """
    disc = distance_from_middle(expected.shape[-1]) < 0.7
    variation = expected[..., disc] - expected[..., disc].mean(-1, keepdim=True)
    return float((found - expected)[..., disc].norm() / variation.norm())
