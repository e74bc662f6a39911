"""Masks of drawn tools. The pictures are logarithms of light relative to the ground."""

import numpy as np
import pytest

from kitting_drake.hkd.tracing.tool_mask import CAREFUL, MIDDLE, ShadowLook, ToolMasks

cv2 = pytest.importorskip("cv2")

PX_PER_MM = 5.0
SHAPE = 300, 450
TINT = np.array([-0.02, 0.0, 0.03], np.float32)
"""The difference in colour between steel and the ground."""


def box(x: float, y: float, width: float, height: float) -> tuple[slice, slice]:
    """The pixels of a rectangle in mm; (x, y) is its upper left corner."""
    left, top, right, bottom = (round(v * PX_PER_MM) for v in (x, y, x + width, y + height))
    return slice(top, bottom), slice(left, right)


def steel(light: float, contrast: float) -> np.ndarray:
    """(rows, columns, 3): brushed steel that is `light` brighter than the ground."""
    rng = np.random.default_rng(0)
    streaks = cv2.GaussianBlur(rng.normal(size=SHAPE).astype(np.float32), (0, 0), 10, None, 1.0)
    return (light + contrast * streaks / streaks.std())[..., None] + TINT


def masks_of(logs: np.ndarray) -> ToolMasks:
    rng = np.random.default_rng(1)
    picture = cv2.GaussianBlur(logs.astype(np.float32), (0, 0), 1.0)
    picture += rng.normal(scale=0.004, size=SHAPE)[..., None].astype(np.float32)
    return ToolMasks(cv2, picture, np.ones(SHAPE, bool), 0.004, PX_PER_MM)


def mask_of(logs: np.ndarray, look: ShadowLook) -> np.ndarray:
    return masks_of(logs).mask(look)


def test_a_hole_in_pale_steel_is_no_reflection():
    logs = np.zeros((*SHAPE, 3))
    bar = box(15, 20, 60, 20)
    logs[bar] = steel(-0.45, 0.2)[bar]
    y, x = np.indices(SHAPE) / PX_PER_MM
    radius = np.hypot(x - 60, y - 30)
    hole = radius < 7
    # The hole is darker at its rim.
    logs[hole] = np.clip(-0.4 + 0.3 * (7 - radius[hole]), None, -0.04)[:, None]
    mask = mask_of(logs, MIDDLE)
    assert mask[radius < 6].mean() < 0.02
    assert mask[box(17, 22, 30, 16)].mean() > 0.98


def test_a_reflection_that_opens_into_a_gap_is_filled_and_the_gap_is_not():
    logs = np.zeros((*SHAPE, 3))
    tool = np.zeros(SHAPE, bool)
    for part in (box(15, 15, 60, 8), box(15, 29, 60, 8), box(65, 15, 10, 22)):
        tool[part] = True
    logs[tool] = steel(-1.6, 0.1)[tool]
    x = np.indices(SHAPE)[1] / PX_PER_MM
    shine = 1.75 * np.exp(-(((x - 50) / 5) ** 2))
    upper = np.zeros(SHAPE, bool)
    upper[box(40, 15, 20, 8)] = True
    logs[upper] += shine[upper][:, None]
    mask = mask_of(logs, MIDDLE)
    assert mask[box(42, 16, 16, 6)].mean() > 0.98
    assert mask[box(20, 24.5, 40, 3)].mean() < 0.02


def test_a_sharp_shadow_beside_a_high_tool_is_ground():
    logs = np.zeros((*SHAPE, 3))
    shadow, bar = box(20, 34, 60, 8), box(15, 20, 60, 15)
    logs[shadow] = -0.5
    logs = cv2.GaussianBlur(logs, (0, 0), 0.4 * PX_PER_MM)
    logs[bar] = steel(-1.0, 0.2)[bar]
    mask = mask_of(logs, CAREFUL)
    assert mask[box(25, 36.5, 45, 4)].mean() < 0.02
    assert mask[box(16, 21, 58, 13)].mean() > 0.98


@pytest.mark.parametrize(("tint", "doubtful"), [(0.0, True), (1.0, False)])
def test_a_soft_edge_is_in_doubt_only_beside_a_tool_of_the_hue_of_the_ground(
    *, tint: float, doubtful: bool
):
    logs = np.zeros((*SHAPE, 3))
    bar = box(15, 20, 60, 15)
    logs[bar] = (steel(-1.0, 0.05) - TINT)[bar]
    # The lower edge is so soft that it looks like a shadow's.
    soft = np.clip((np.indices(SHAPE)[0] / PX_PER_MM - 32) / 2.2, 0, 1)[bar]
    logs[bar] *= (1 - soft)[..., None]
    tinted = box(15, 20, 60, 12)
    logs[tinted] += tint * TINT
    masks = masks_of(logs)
    unsure = masks.hidden_by_hue(masks.mask(CAREFUL), CAREFUL)
    assert (unsure.sum() / PX_PER_MM**2 > 20) == doubtful
