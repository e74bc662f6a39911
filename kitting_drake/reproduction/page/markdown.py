"""Formats text and tables in Markdown that is readable as source."""

from collections.abc import Sequence


def rate_text(rate: float, interval: Sequence[float]) -> str:
    """Formats a rate and its interval in percent; both are given as shares from 0 to 1."""
    low, high = interval
    return f"{100 * rate:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def markdown_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], left_columns: int = 1
) -> str:
    """Formats a table with aligned columns. If the last column is text, its cells are not padded.

    Args:
        headings: the headings of the columns.
        rows: the cells of each row.
        left_columns: the number of leading columns that are aligned left. The others are aligned
            right.
    """
    # Write at least three dashes below a heading, because some Markdown parsers require it.
    widths = [max(3, *map(len, column)) for column in zip(headings, *rows, strict=True)]
    if left_columns == len(headings):
        widths[-1] = 3
    rule = [
        "-" * width if index < left_columns else "-" * (width - 1) + ":"
        for index, width in enumerate(widths)
    ]
    lines = [
        [
            cell.ljust(width) if index < left_columns else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in (headings, rule, *rows)
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
