"""Writes the page of results, docs/results.md.

It has the main figures, how to reproduce them, and the departures from the paper.
"""

from collections.abc import Sequence

from kitting_drake.reproduction.page.pooled import pooled_section
from kitting_drake.reproduction.page.prose import prose
from kitting_drake.reproduction.page.runs import Run


def results_page(
    runs: Sequence[Run], link: str, fresh: Sequence[str] = (), paper: Sequence[str] = ()
) -> str:
    """Writes the whole page, in Markdown.

    Args:
        runs: the runs that fill no cell of the paper's tables, from `cell_results`.
        link: the path from the page's folder to that of the table of runs.
        fresh: the sections from `kitting_drake.reproduction.paper.paper_sections.fresh_tools`.
        paper: the sections from `kitting_drake.reproduction.paper.paper_sections.paper_sections`.
    """
    headline = [*pooled_section(runs), *fresh]
    if headline:
        headline.insert(0, "## The shipped policies\n")
    return "\n".join([prose("results", link=link), *headline, *paper, prose("reproduce")])
