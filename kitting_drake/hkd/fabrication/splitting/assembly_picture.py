"""Draws a block's pieces apart from each other, with their numbers and dovetails."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from manifold3d import CrossSection, JoinType
from numpy.typing import NDArray

from kitting_drake.hkd.fabrication.splitting.opening import Opening, roomiest_point, united
from kitting_drake.hkd.fabrication.splitting.pieces import Piece, Split

_PAPER, _INK, _FAINT, _CAVITY = "#f6f5f1", "#26282c", "#8a8d91", "#3a3f46"
_COLOURS = ("#f4c95d", "#8fbcbb", "#e58f65", "#a3b565", "#b48ead", "#7aa2c9", "#d4a5a5", "#9ab87a")
_APART = 0.1
"""The distance between drawn pieces, as a share of the block's longer side."""


def assembly_png(split: Split, openings: Sequence[Opening]) -> bytes:
    """Draws the pieces from above, as a PNG.

    Args:
        split: the pieces.
        openings: the block's recesses.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    boxes = np.array([piece.region.bounds() for piece in split.pieces])
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    longest = float((high - low).max())
    middle = (low + high) / 2
    shifts = _shifts(split.pieces, middle, _APART * longest)
    moved = boxes + np.tile(shifts, 2)
    x_min, y_min = moved[:, :2].min(axis=0) - 0.05 * longest
    x_max, y_max = moved[:, 2:].max(axis=0) + 0.05 * longest
    scale = 10.0 / max(x_max - x_min, y_max - y_min)
    figure, axes = plt.subplots(
        figsize=(scale * (x_max - x_min), scale * (y_max - y_min) + 0.9),
        facecolor=_PAPER,
        layout="constrained",
    )
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_xlim(x_min, x_max)
    axes.set_ylim(y_min, y_max)
    for piece, shift in zip(split.pieces, shifts, strict=True):
        _draw_piece(axes, split, piece, openings, shift)
    sides = " by ".join(f"{side:g}" for side in np.round(high - low, 1))
    axes.set_title(
        f"{len(split.pieces)} pieces make the block of {sides} mm. Lay down piece 1, then lower\n"
        "the others in their order. Dashed: dovetails and sockets that end below a floor.",
        color=_INK,
        fontsize=12,
    )
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110, facecolor=_PAPER)
    plt.close(figure)
    return picture.getvalue()


def _shifts(
    pieces: Sequence[Piece], middle: NDArray[np.float64], apart: float
) -> NDArray[np.float64]:
    """Returns the shifts (n, 2), in mm, that separate the pieces in the picture."""
    centres = np.array([np.array(p.region.bounds()).reshape(2, 2).mean(axis=0) for p in pieces])
    sizes = np.array([p.region.bounds() for p in pieces])
    step = (sizes[:, 2:] - sizes[:, :2]).mean(axis=0)
    return apart * (centres - middle) / step


def _draw_piece(
    axes: Any,
    split: Split,
    piece: Piece,
    openings: Sequence[Opening],
    shift: NDArray[np.float64],
) -> None:
    index, height = piece.number - 1, piece.size[2]
    body = piece.region
    hidden = []
    for joint in split.joints:
        is_visible = joint.height >= height - 1e-6
        if joint.owner == index:
            if is_visible:
                body += joint.outline
            hidden += [] if is_visible else [joint.outline]
        elif joint.other == index:
            if is_visible:
                body -= joint.outline.offset(split.play, JoinType.Miter)
            hidden += [] if is_visible else [joint.outline]
    colour = _COLOURS[index % len(_COLOURS)]
    _fill(axes, body, shift, colour)
    for opening in openings:
        inside = opening.outline ^ piece.region
        _fill(axes, inside, shift, _INK if opening.is_label else _CAVITY)
    for outline in hidden:
        _fill(axes, outline, shift, "none", edge=_INK, style=(0, (3, 2)))
    _fill(axes, body, shift, "none", edge=_INK)
    free = piece.region - united(opening.outline for opening in openings)
    x, y = roomiest_point(free, float(piece.size[:2].min()) / 2) + shift
    axes.text(
        x,
        y,
        str(piece.number),
        color=_INK,
        fontsize=13,
        fontweight="bold",
        ha="center",
        va="center",
        bbox={"boxstyle": "circle,pad=0.3", "facecolor": "#ffffff", "edgecolor": _INK},
    )


def _fill(
    axes: Any,
    outline: CrossSection,
    shift: NDArray[np.float64],
    colour: str,
    edge: str = "none",
    style: Any = "-",
) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    loops = [loop + shift for loop in outline.to_polygons()]
    if loops:
        path = Path.make_compound_path(*(Path(np.vstack([a, a[:1]]), closed=True) for a in loops))
        patch = PathPatch(path, facecolor=colour, edgecolor=edge, linewidth=1.0, linestyle=style)
        axes.add_artist(patch)
