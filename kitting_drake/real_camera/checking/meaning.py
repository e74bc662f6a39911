"""Explains the results of a camera check: each number, and its effect on a clearance of 2 mm."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kitting_drake.real_camera.checking.check import CameraCheck, Check, TableCheck
from kitting_drake.real_camera.checking.kit_block import Block, SeenBlock
from systems.pick_place_parameters import PickPlaceParameters

CLEARANCE = 0.002
"""The clearance between a tool and its cavity, in metres."""
GOOD, TIGHT, BAD = "good", "tight", "too much"
_HALF_KIT = 0.1
"""The distance from a kit's centre to its edge, in metres."""
_OUT_OF_SCALE = 0.008
"""If the scale's relative error is smaller than this, it may be noise."""
_HALF_WORKSPACE = 0.5
"""Half the length of the workspace, in metres."""
_LEVEL = math.radians(0.02)
"""The tilt, in radians, below which a table counts as level."""
_CLEAN = 0.0005
"""The noise, in metres, above which heights are filtered (see
`policies/matching/regions/segmentation.py`)."""
_NOISY = 0.0016
"""The noise, in metres, above which details of 3 mm are lost."""
_LOST = 1.8
"""Details lower than this multiple of the noise are lost. It is 2 * 0.9: a detail must exceed two
standard deviations of the filtered noise, and the filter leaves nine tenths of a noise that is
correlated between neighbouring pixels."""
_FEW_HOLES, _MANY_HOLES = 0.02, 0.10


@dataclass(frozen=True)
class Finding:
    """One line of a check's report."""

    who: str
    """The camera, the pair of cameras, or `together` for o_t."""
    what: str
    value: str
    verdict: str
    """The verdict on the value: `GOOD`, `TIGHT` or `BAD`."""
    meaning: str


def findings(check: Check, planner: PickPlaceParameters | None = None) -> list[Finding]:
    """Returns all lines of a check's report, camera by camera.

    Args:
        check: the check of the cameras.
        planner: the parameters of the robot's motion; None for the simulated cell's defaults.
    """
    planner = PickPlaceParameters() if planner is None else planner
    lines: list[Finding] = []
    for name, camera in check.cameras.items():
        lines += _of_table(name, camera.table, camera.distance, planner)
        if explains_depth(camera):
            lines.append(
                Finding(
                    name,
                    "depth",
                    f"{1e3 * camera.depth_bias:+.2f} mm",
                    _verdict(camera.depth_bias),
                    "a constant depth error explains tilt and bias as well as a wrong pose does: "
                    "measure one distance before you correct the pose",
                )
            )
        if camera.block is not None and check.block is not None:
            lines += _of_block(name, camera.block, check.block)
    lines += _of_table("together", check.together, None, planner)
    for (one, other), height in check.disagreements.items():
        lines.append(
            Finding(
                f"{one}, {other}",
                "disagreement",
                f"{1e3 * height:+.2f} mm",
                _verdict(height),
                "difference in height: an edge that is seen obliquely appears twice, about this "
                "far apart",
            )
        )
    for (one, other), shift in check.block_shifts.items():
        lines.append(
            Finding(
                f"{one}, {other}",
                "disagreement",
                f"({1e3 * shift[0]:+.2f}, {1e3 * shift[1]:+.2f}) mm",
                _verdict(float(np.linalg.norm(shift))),
                "difference in the block's x and y: objects look wider by this much, and "
                "cavities narrower",
            )
        )
    return lines


def explains_depth(camera: CameraCheck) -> bool:
    """Whether a constant depth error fits the measured heights about as well as an error of the
    pose does."""
    if abs(camera.depth_bias) < CLEARANCE / 4:
        return False
    return camera.depth_bias_noise < 1.05 * camera.table.noise + 5e-5


def _of_table(
    who: str, table: TableCheck, distance: float | None, planner: PickPlaceParameters
) -> list[Finding]:
    floor = planner.floor_clearance
    angle = table.tilt_angle
    aside = (_HALF_WORKSPACE if distance is None else distance) * angle
    if angle < _LEVEL:
        tilted = "the table looks level"
    elif distance is None:
        tilted = f"heights change by {1e3 * aside:.1f} mm over half a metre"
    else:
        about_x, about_y = np.degrees(table.tilt)
        tilted = (
            f"{about_x:+.3f} about x and {about_y:+.3f} about y: if the camera is rotated by this "
            f"much, everything is displaced by {1e3 * aside:.1f} mm"
        )
    high = "high" if table.bias > 0 else "low"
    bias = f"grasps and rims look {1e3 * abs(table.bias):.1f} mm too {high}"
    if table.bias > floor:
        # The hand stops at the height `floor` above `table_height`, whatever the cameras measure.
        into = f"{1e3 * (table.bias - floor):.1f} mm"
        bias += f"; if table_height is too low, fingertips may go {into} into the table"
    if table.noise <= _CLEAN:
        noise, blurred = "heights are used unfiltered", GOOD
    else:
        least = max(3.0, 1e3 * _LOST * table.noise)
        noise = f"heights are filtered, and details below {least:.1f} mm are lost"
        blurred = TIGHT if table.noise <= _NOISY else BAD
    holes = GOOD if table.holes < _FEW_HOLES else TIGHT if table.holes < _MANY_HOLES else BAD
    return [
        Finding(who, "tilt", f"{math.degrees(angle):.3f} deg", _verdict(aside), tilted),
        Finding(who, "height bias", f"{1e3 * table.bias:+.2f} mm", _verdict(table.bias), bias),
        Finding(who, "noise", f"{1e3 * table.noise:.2f} mm", blurred, noise),
        Finding(
            who,
            "holes",
            f"{100 * table.holes:.1f} %",
            holes,
            "unseen pixels are filled in from their neighbours",
        ),
    ]


def _of_block(who: str, seen: SeenBlock, block: Block) -> list[Finding]:
    length, width, height = scales(seen, block)
    # Report the larger of the two errors, whether the side looks too long or too short.
    worst = max(length, width, key=lambda share: abs(share - 1))
    wrong = (worst - 1) * _HALF_KIT
    reason = ""
    if abs(worst - 1) > _OUT_OF_SCALE:
        alike = max(abs(s - worst) for s in (length, width, height)) < 0.4 * abs(worst - 1)
        reason = "; depth_scale may be wrong" if alike else "; the focal length may be wrong"
    skew = (seen.corner - math.pi / 2) * _HALF_KIT
    lines = [
        Finding(
            who,
            "scale",
            f"{worst:.4f}",
            _verdict(wrong),
            f"length {length:.4f}, width {width:.4f}, height {height:.4f}: 10 cm look "
            f"{1e3 * abs(wrong):.2f} mm too {'long' if wrong > 0 else 'short'}{reason}",
        ),
        Finding(
            who,
            "squareness",
            f"{math.degrees(seen.corner):.2f} deg",
            _verdict(skew),
            f"a right angle is {1e3 * abs(skew):.2f} mm off over 10 cm",
        ),
    ]
    off = offset(seen, block)
    if off is not None:
        x, y, yaw = off
        lines.append(
            Finding(
                who,
                "offset",
                f"({1e3 * x:+.2f}, {1e3 * y:+.2f}) mm, {math.degrees(yaw):+.2f} deg",
                _verdict(math.hypot(x, y) + _HALF_KIT * abs(yaw)),
                "picks and places are off by this much, and by more farther from the block",
            )
        )
    return lines


def scales(seen: SeenBlock, block: Block) -> tuple[float, float, float]:
    """Returns the apparent length, width and height of a block, divided by the true ones."""
    length, width, height = np.divide(seen.size, block.size).tolist()
    return length, width, height


def offset(seen: SeenBlock, block: Block) -> tuple[float, float, float] | None:
    """Returns how far a block seems to be from its true pose; None if the true pose is not known.

    The values are x and y in metres, and the yaw in radians, modulo `Block.period`.
    """
    if block.pose is None:
        return None
    x, y = seen.middle - np.array(block.pose[:2])
    return float(x), float(y), math.remainder(seen.yaw - block.pose[2], block.period)


def _verdict(error: float) -> str:
    """Returns the verdict on an error in metres, by its ratio to the clearance."""
    share = abs(error) / CLEARANCE
    return GOOD if share < 0.25 else TIGHT if share < 0.75 else BAD
