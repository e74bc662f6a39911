"""Refuses unknown fields, because misspelt fields would otherwise be ignored silently."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.layouts import OWN_INTRINSICS


def check_distortion(node: dict[str, Any], where: str) -> None:
    """Raises UserError for misspelt distortion coefficients.

    OpenCV and ROS write no other fields that begin with "dist".
    """
    for key in node:
        if str(key).lower().startswith("dist") and key not in OWN_INTRINSICS:
            raise UserError(
                f"{where} has the unknown field '{key}': the lens's coefficients are called "
                "distortion_coefficients, or d in ROS"
            )


def check_fields(node: dict[str, Any], known: Sequence[str], where: str) -> None:
    """Raises UserError for an unknown field."""
    for key in node:
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            advice = f"did you mean '{close[0]}'?" if close else "remove it"
            raise UserError(f"{where} has the unknown field '{key}': {advice}")


def check_misspelt(
    node: dict[str, Any], meant: Sequence[str], known: Sequence[str], where: str, likeness: float
) -> None:
    """Raises UserError for an unknown field that resembles an expected field.

    Args:
        node: the fields to check.
        meant: the names of the expected fields.
        known: the names of fields that are allowed.
        where: the beginning of the error message.
        likeness: two names resemble each other if their similarity, from 0 to 1, is at least this.
    """
    for key in node:
        close = difflib.get_close_matches(str(key), meant, cutoff=likeness)
        if close and key not in known:
            raise UserError(f"{where} has the unknown field '{key}': did you mean '{close[0]}'?")
