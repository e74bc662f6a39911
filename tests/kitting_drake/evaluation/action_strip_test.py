"""Strips of frames."""

import io

import numpy as np
from PIL import Image

from kitting_drake.evaluation.action_strip import StripFrame, draw_strips


def width_and_height(*lengths: int) -> tuple[int, int]:
    colours = np.full((16, 32, 3), 0.4, np.float32)
    acts = StripFrame(colours, np.array([4.0, 5.0]), np.array([8.0, 20.0]))
    ends = StripFrame(colours, None, None)
    rows = [
        (f"row {number}", [acts] * (length - 1) + [ends], ["placed"] * (length - 1))
        for number, length in enumerate(lengths)
    ]
    with Image.open(io.BytesIO(draw_strips(rows))) as picture:
        return picture.size


def test_a_long_strip_goes_on_in_another_line():
    width, height = width_and_height(5, 2)
    assert width_and_height(3, 2)[0] < width
    longer = width_and_height(5, 7)
    assert longer[0] == width
    assert longer[1] > height
