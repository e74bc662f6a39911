"""Counts and times as text, with three digits and a prefix."""

from __future__ import annotations


def seconds_text(seconds: float | None) -> str:
    """A time with three digits, in s or ms."""
    if seconds is None:
        return "-"
    if seconds >= 100:
        return f"{seconds:.0f} s"
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def count_text(count: float) -> str:
    """A count with three digits and a prefix: k, M, G or T."""
    for power, letter in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if count >= power:
            return f"{count / power:.3g} {letter}"
    return f"{count:.3g}"
