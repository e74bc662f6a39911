"""Formats counts and times with three significant digits, and makes tables of them."""

from __future__ import annotations

from rich.table import Table


def seconds_text(seconds: float | None) -> str:
    """Formats a time: in whole seconds from 100 s on; otherwise in s or ms, with three digits."""
    if seconds is None:
        return "-"
    if seconds >= 100:
        return f"{seconds:.0f} s"
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1e3 * seconds:.3g} ms"


def count_text(count: float) -> str:
    """Formats a count with three significant digits, and the prefix k, M, G or T."""
    for power, letter in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if count >= power:
            return f"{count / power:.3g} {letter}"
    return f"{count:.3g}"


def ratio_text(ratio: float | None) -> str:
    """Formats a ratio with two decimals; a dash for None."""
    return "-" if ratio is None else f"{ratio:.2f}"


def numbers_table(title: str, *headings: str) -> Table:
    """A table for the terminal; the first column holds text, the others numbers."""
    table = Table(title=title, title_justify="left")
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="right" if index else "left", no_wrap=not index)
    return table
