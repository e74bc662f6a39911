"""Outlines of the upper jaw of pliers, by kind; the lower jaw is its mirror image.

The points of an outline run clockwise from the joint over the back to the tip, and return along the
biting edge. Each function in OUTLINES draws one kind of jaw: it returns the points of the back and
the points of the biting edge.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kitting_drake.hkd.tools.solids import fillet

Line = list[tuple[float, float]]


@dataclass
class Jaws:
    """A pair of jaws. Lengths in mm of the full-size tool with the rivet at the origin."""

    # The shapes of the upper and the lower jaw, keys of OUTLINES. An empty `lower_kind` stands for
    # the shape of the upper jaw.
    kind: str = "combination"
    lower_kind: str = ""
    length_mm: float = 46.0
    # The width across both closed jaws at the tip, and the opening at the tip.
    tip_width_mm: float = 15.0
    gap_mm: float = 3.0
    # The thickness at the tip (0: the thickness of the joint).
    tip_thickness_mm: float = 0.0
    # The depth and the pitch of the serrations.
    tooth_mm: float = 0.9
    pitch_mm: float = 2.2
    # The angle by which both jaws turn where they leave the joint, and the angle by which they bend
    # from there to the tip.
    turn_deg: float = 0.0
    bend_deg: float = 0.0


def upper_jaw(j: Jaws, start: float, half: float, kind: str = "") -> np.ndarray:
    """Returns the outline (n, 2) of the upper jaw, counter-clockwise.

    The joint's flanks end at x = `start` and y = +-`half`. `kind` is a key of OUTLINES; an empty
    string stands for `j.kind`.
    """
    back, bite = OUTLINES[kind or j.kind](j, start, half)
    root = [(start - 6.0, 0.0), (start - 6.0, half - 0.3)]
    return np.array([*root, *back, *bite])[::-1].copy()


def bent(j: Jaws, outline: np.ndarray, start: float) -> np.ndarray:
    """Turns a jaw at the joint and bends it along an arc from there.

    Args:
        j: the jaws, with the angles `turn_deg` and `bend_deg`.
        outline: the outline (n, 2) of a straight jaw.
        start: the x at which the jaw leaves the joint.

    Returns:
        The outline (m, 2) of the bent jaw, with more points.
    """
    if not j.turn_deg and not j.bend_deg:
        return outline
    # Subdivide the edges, because straight edges must bend as well.
    count = np.ceil(np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1) / 2.0)
    outline = np.vstack(
        [
            a + (b - a) * np.linspace(0.0, 1.0, int(n), endpoint=False)[:, None]
            for a, b, n in zip(outline, np.roll(outline, -1, axis=0), count, strict=True)
        ]
    )
    t = np.clip((outline[:, 0] - start) / (j.length_mm - start), 0.0, 1.2)
    # Let the turn set in gradually at the joint.
    ease = np.clip((outline[:, 0] - start + 5.0) / 5.0, 0.0, 1.0)
    line = np.linspace(0.0, 1.2, 241)
    heading = np.radians(j.turn_deg + j.bend_deg * np.clip((line - 0.25) / 0.5, 0.0, 1.0))
    step = (line[1] - line[0]) * (j.length_mm - start)
    x = start + np.concatenate([[0.0], np.cumsum(step * np.cos(heading[:-1]))])
    y = np.concatenate([[0.0], np.cumsum(step * np.sin(heading[:-1]))])
    a = np.interp(t, line, heading) * ease
    middle = np.column_stack([np.interp(t, line, x), np.interp(t, line, y)])
    moved = middle + outline[:, 1:] * np.column_stack([-np.sin(a), np.cos(a)])
    behind = outline[:, 0] < start
    moved[behind] += (outline[behind, :1] - start) * np.array([[1.0, 0.0]])
    return moved


def _opening(j: Jaws) -> Callable[[float], float]:
    """Returns a function of x that gives half the opening; the jaws turn about the rivet."""
    return lambda x: 0.5 * j.gap_mm * max(0.0, x) / j.length_mm


def _teeth(j: Jaws, high: float, low: float) -> Line:
    """Returns the points of serrations from x = `high` down to `low`."""
    gap, bite = _opening(j), []
    for i in range(int((high - low) / j.pitch_mm)):
        x = high - i * j.pitch_mm
        bite += [(x, gap(x)), (x - 0.5 * j.pitch_mm, gap(x) + j.tooth_mm)]
    return bite


def _hollow(j: Jaws, high: float, low: float, depth: float, teeth: bool) -> Line:
    """Returns the points of an arched hollow between x = `low` and `high`, serrated or smooth."""
    gap = _opening(j)
    middle, radius = 0.5 * (low + high), 0.5 * (high - low)
    return [
        (
            middle + radius * float(np.cos(a)),
            gap(middle) + depth * float(np.sin(a)) + (j.tooth_mm if teeth and i % 2 else 0.0),
        )
        for i, a in enumerate(np.linspace(0.0, np.pi, 15))
    ]


def _rounded(line: Line, radii: list[float], j: Jaws) -> Line:
    """Rounds the corners of a jaw's back, except at its two ends."""
    end = (j.length_mm, _opening(j)(j.length_mm) + 0.3)
    soft = fillet([*line, end, (line[0][0], 0.0)], [0.0, *radii, 0.0, 0.0])
    return [(float(x), float(y)) for x, y in soft[:-1]]


def _combination(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws a jaw with a flat serrated tip, a pipe grip and a side cutter."""
    length, tip = j.length_mm, j.tip_width_mm / 2
    back = [
        (start, half),
        (0.55 * length, 0.80 * half + 0.20 * tip),
        (length - 1.5, tip + 0.6),
        (length, tip - 1.6),
    ]
    bite = _teeth(j, length - 1.0, 0.72 * length)
    bite += _hollow(j, 0.70 * length, 0.44 * length, 2.6, True)
    bite += [(0.40 * length, 0.35), (start, 0.3)]
    return _rounded(back, [14.0, 30.0, 2.0], j), bite


def _linesman(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws a broad, square nose with flat jaws and strong side cutters."""
    length, tip = j.length_mm, j.tip_width_mm / 2
    back = [(start, half), (length - 3.0, tip + 0.4), (length, tip - 1.8)]
    bite = _teeth(j, length - 0.8, 0.60 * length)
    bite += [(0.57 * length, 2.4), (0.50 * length, 2.6), (0.46 * length, 0.35), (start, 0.3)]
    return _rounded(back, [10.0, 2.5], j), bite


def _needle(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws a long slender nose, straight from the shoulder to the tip."""
    length, tip = j.length_mm, j.tip_width_mm / 2
    shoulder = start + 0.16 * (length - start)
    back = [(start, half), (shoulder, 0.60 * half + 0.40 * tip), (length, tip - 0.2)]
    bite = _teeth(j, length - 1.0, 0.52 * length)
    bite += [(0.50 * length, 1.0), (0.36 * length, 1.2), (0.30 * length, 0.35), (start, 0.3)]
    return _rounded(back, [20.0, 1.0], j), bite


def _flat(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws smooth jaws with a constant taper to a square tip."""
    length, tip, gap = j.length_mm, j.tip_width_mm / 2, _opening(j)
    back = [(start, half), (start + 5.0, 0.9 * half), (length, tip)]
    bite = [(length - 0.5, gap(length)), (start + 2.0, gap(start)), (start, 0.3)]
    return _rounded(back, [6.0, 0.8], j), bite


def _round(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws two cones with a gap between them."""
    length, tip, gap = j.length_mm, j.tip_width_mm / 2, _opening(j)
    open_tip = gap(length)
    back = [(start, half), (start + 8.0, 0.82 * half), (length - 0.6, open_tip + tip)]
    bite = [
        (length, open_tip + 0.3 * tip),
        (length - 0.8, open_tip),
        (start + 9.0, 0.5 * open_tip + 0.3),
        (start + 5.0, 0.6),
        (start, 0.3),
    ]
    rounded = fillet([*back, (length, open_tip), (start, 0.0)], [0, 12, 1.0, 0, 0])
    return [(float(x), float(y)) for x, y in rounded[:-2]], bite


def _diagonal(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws a short round head with a hollow at the joint and a cutting edge along its whole
    length."""
    length, tip = j.length_mm, j.tip_width_mm / 2
    back = [
        (start, half),
        (start + 0.30 * (length - start), 0.98 * half),
        (start + 0.80 * (length - start), 0.5 * half + 0.5 * tip),
        (length, tip),
    ]
    bite = [(length - 0.3, 0.35), (start + 7.0, 0.3)]
    bite += [(start + 6.0, 1.6), (start + 2.0, 2.2), (start - 2.0, 1.2)]
    return _rounded(back, [12.0, 22.0, 1.2], j), bite


def _circlip(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws slim jaws that end in pins."""
    length, pin = j.length_mm, 1.7
    open_tip = 0.5 * j.gap_mm
    neck = 0.72 * length
    wide = j.tip_width_mm / 2
    back = [
        (start, half),
        (start + 7.0, 0.74 * half + 0.26 * wide),
        (neck, wide + open_tip),
        (neck + 1.5, open_tip + 2 * pin),
        (length, open_tip + 2 * pin),
    ]
    rounded = fillet([*back, (length, 0.0), (start, 0.0)], [0, 14, 3, 0.4, 0.4, 0, 0])
    bite = [(length, open_tip), (neck, 0.75 * open_tip), (start + 4.0, 0.6), (start, 0.3)]
    return [(float(x), float(y)) for x, y in rounded[:-2]], bite


def _nipper(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws pincers, whose jaws arch apart and meet in a broad edge across the tool."""
    length, wide = j.length_mm, j.tip_width_mm / 2
    span = length - start
    back = [
        (start, half),
        (start + 0.22 * span, wide - 1.0),
        (start + 0.58 * span, wide),
        (length - 2.5, 0.52 * wide),
        (length, 1.2),
    ]
    bite = [(length - 0.3, 0.35), (length - 4.5, 0.4)]
    middle, radius = start + 0.46 * span, 0.33 * span
    bite += [
        (middle + radius * float(np.cos(a)), 0.4 + 0.52 * wide * float(np.sin(a)) ** 0.8)
        for a in np.linspace(0.05, np.pi - 0.05, 13)
    ]
    bite += [(start + 2.0, 0.4)]
    return _rounded(back, [8.0, 14.0, 10.0, 0.8], j), bite


def _snips(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws long blades, each with a straight back that tapers to a point."""
    length, tip, gap = j.length_mm, j.tip_width_mm / 2, _opening(j)
    back = [
        (start, half),
        (start + 0.2 * (length - start), 0.84 * half),
        (length - 1.0, gap(length) + tip),
    ]
    bite = [(length, gap(length) + 0.4), (start + 8.0, gap(start + 8.0)), (start, 0.2)]
    rounded = fillet([*back, (length, gap(length)), (start, 0.0)], [0, 20, 0.8, 0, 0])
    return [(float(x), float(y)) for x, y in rounded[:-2]], bite


def _stripper(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws blades with a row of round holes that grow toward the joint, and a serrated nose."""
    length, tip = j.length_mm, j.tip_width_mm / 2
    back = [(start, half), (start + 6.0, 0.92 * half), (length - 4.0, tip + 0.5), (length, tip - 2)]
    bite = _teeth(j, length - 1.0, length - 10.0)
    x = length - 12.5
    for radius in (0.9, 1.2, 1.5, 1.8, 2.1):
        bite.append((x, 0.3))
        bite += [
            (x - 0.4 - radius * (1 - float(np.cos(a))), 0.3 + radius * float(np.sin(a)))
            for a in np.linspace(0.2, np.pi - 0.2, 7)
        ]
        x -= 2 * radius + 2.0
    bite += [(x, 0.3), (start, 0.3)]
    return _rounded(back, [8.0, 8.0, 1.5], j), bite


def _pump(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws deep jaws with coarse teeth and a hollow for pipes."""
    length, tip, gap = j.length_mm, j.tip_width_mm / 2, _opening(j)
    back = [
        (start, half),
        (start + 0.40 * (length - start), half),
        (length - 3.0, gap(length) + tip + 1.0),
        (length, gap(length) + tip - 1.5),
    ]
    bite = _teeth(j, length - 1.0, 0.68 * length)
    bite += _hollow(j, 0.66 * length, 0.30 * length + 0.4 * start, 0.10 * length, True)
    bite += [(start + 1.0, 0.8), (start, 0.6)]
    return _rounded(back, [10.0, 18.0, 2.0], j), bite


def _poll(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws the hammer jaw of fencing pliers: a square striking face sticks out sideways at the
    tip."""
    length, out = j.length_mm, j.tip_width_mm / 2
    back = [
        (start, half),
        (0.46 * length, 0.70 * half),
        (0.56 * length, out - 1.5),
        (0.62 * length, out),
        (length - 1.5, out),
        (length, out - 1.5),
    ]
    return _rounded(back, [10.0, 8.0, 1.0, 1.0, 1.0], j), _staple_bite(j, start)


def _pick(j: Jaws, start: float, half: float) -> tuple[Line, Line]:
    """Draws the other jaw of fencing pliers: a curved point for staples sticks out sideways."""
    length, out = j.length_mm, j.tip_width_mm / 2
    back = [
        (start, half),
        (0.40 * length, 0.72 * half),
        (0.55 * length, 0.72 * half),
        (0.58 * length, out),
        (0.64 * length, out),
        (0.80 * length, 0.84 * half),
        (length, 0.55 * half),
    ]
    return _rounded(back, [10.0, 6.0, 1.0, 1.0, 14.0, 3.0], j), _staple_bite(j, start)


def _staple_bite(j: Jaws, start: float) -> Line:
    """Returns the edge of fencing pliers: a serrated tip, a round hole for wire, and a cutter
    behind it."""
    length = j.length_mm
    bite = _teeth(j, length - 1.0, 0.66 * length)
    bite += _hollow(j, 0.62 * length, 0.46 * length, 2.4, False)
    return [*bite, (0.42 * length, 0.35), (start, 0.3)]


OUTLINES: dict[str, Callable[[Jaws, float, float], tuple[Line, Line]]] = {
    "combination": _combination,
    "linesman": _linesman,
    "needle": _needle,
    "flat": _flat,
    "round": _round,
    "diagonal": _diagonal,
    "circlip": _circlip,
    "nipper": _nipper,
    "snips": _snips,
    "stripper": _stripper,
    "pump": _pump,
    "poll": _poll,
    "pick": _pick,
}
