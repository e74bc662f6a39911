"""Draws an outline as it was read, with its size."""

import math
from pathlib import Path

import numpy as np
from manifold3d import CrossSection
from PIL import Image, ImageDraw, ImageFont

# The picture is drawn `_FINER` times as large and then scaled down, which smooths its edges.
_LENGTH_PX, _MARGIN_PX, _FINER = 1000, 60, 2
_TOOL, _GROUND, _TEXT = (70, 90, 120), (255, 255, 255), (30, 30, 30)


def write_outline_picture(outline: CrossSection, path: Path) -> None:
    """Draws an outline as a PNG, with its length, its width and a scale bar of 10 mm.

    Args:
        outline: the outline in mm, with y up.
        path: the PNG to write.
    """
    x_min, y_min, x_max, y_max = outline.bounds()
    sides = np.array([x_max - x_min, y_max - y_min])
    scale = _FINER * _LENGTH_PX / sides.max()
    margin = _FINER * _MARGIN_PX
    width, height = (math.ceil(scale * side) + 2 * margin for side in sides)
    image = Image.new("RGB", (width, height), _GROUND)
    draw = ImageDraw.Draw(image)
    # Loops around holes are clockwise. Each area is drawn before the holes in it.
    loops = sorted(outline.to_polygons(), key=lambda loop: -np.ptp(loop, axis=0).prod())
    for loop in loops:
        x, y = loop.T
        is_hole = np.dot(x, np.roll(y, -1)) < np.dot(y, np.roll(x, -1))
        places = margin + scale * np.column_stack([x - x_min, y_max - y])
        draw.polygon([tuple(map(float, p)) for p in places], fill=_GROUND if is_hole else _TOOL)
    font = ImageFont.load_default(_FINER * 20)
    text = f"{sides[0]:.1f} x {sides[1]:.1f} mm, {holes_text(outline)}"
    draw.text((margin, margin // 4), text, fill=_TEXT, font=font)
    low = height - margin // 2
    draw.line([(margin, low), (margin + 10 * scale, low)], fill=_TEXT, width=2 * _FINER)
    draw.text((margin + 11 * scale, low - margin // 4), "10 mm", fill=_TEXT, font=font)
    image.resize((width // _FINER, height // _FINER)).save(path)


def holes_text(outline: CrossSection) -> str:
    """Returns the number of holes of an outline in words, such as "2 holes"."""
    holes = outline.num_contour() - len(outline.decompose())
    return "no hole" if not holes else f"{holes} {'hole' if holes == 1 else 'holes'}"
