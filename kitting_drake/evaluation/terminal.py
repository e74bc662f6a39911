"""Makes the terminal's tables of one episode and of a summary."""

import dataclasses
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from kitting_drake.episode import EpisodeResult
from kitting_drake.episode.episode import ObjectResult
from kitting_drake.evaluation.summary import (
    ACTION_ERRORS,
    ERRORS,
    find_ambiguities,
    peak_forces,
)

_ERROR_HEADINGS = ("ADD-S mm", "position mm", "angle deg", "height mm")


def episode_table(result: EpisodeResult) -> Table:
    """A table with a row for each object that can fill a goal."""
    table = Table(
        title=escape(f"{result.scenario}, seed {result.seed}"),
        title_justify="left",
    )
    table.add_column("object", no_wrap=True)
    table.add_column("success", justify="center")
    for heading in _ERROR_HEADINGS:
        table.add_column(heading, justify="right")
    for item in result.objects:
        table.add_row(
            escape(item.name),
            _verdict(item),
            number(item.add_s_mm),
            number(item.position_error_mm),
            number(item.angle_error_deg, "+.2f"),
            number(item.height_error_mm, "+.2f"),
        )
    return table


def _verdict(item: ObjectResult) -> str:
    if item.add_s_mm is None:
        return "-"
    if item.strict_success:
        return "[green]yes[/]"
    if item.success:
        return f"[yellow]{', '.join(find_ambiguities(dataclasses.asdict(item)))}[/]"
    return "[red]no[/]"


def print_episode(console: Console, result: EpisodeResult) -> None:
    """Prints the table of an episode and its summary."""
    console.print(episode_table(result))
    rate = result.sim_seconds / result.wall_seconds if result.wall_seconds else 0.0
    console.print(
        f"{result.strict_success_rate:.0%} strict success, "
        f"{result.success_rate:.0%} by the task's measure, in {result.actions} actions, "
        f"{result.sim_seconds:.1f} s simulated in {result.wall_seconds:.1f} s ({rate:.1f}x), "
        f"{result.point_contact_pairs} point contacts"
    )
    console.print(_ending(result), highlight=False, markup=False)
    _print_measures(console, result)
    causes = [
        f"{item.name} ({item.cause})"
        for item in result.objects
        if item.cause is not None and item.add_s_mm is not None
    ]
    if causes:
        console.print(f"no success: {escape(', '.join(causes))}", highlight=False)
    if result.missed_grasps or result.dropped_objects or result.stopped_actions:
        console.print(
            f"{result.missed_grasps} missed grasps, {result.dropped_objects} dropped objects, "
            f"{result.stopped_actions} actions stopped by a contact force"
        )
    if result.moving_at_end:
        moving = escape(", ".join(result.moving_at_end))
        console.print(f"[yellow]still moving at the end:[/] {moving}", highlight=False)
    if result.failure:
        console.print(
            f"[red]failed:[/] {escape(result.failure)}; the episode scores 0", highlight=False
        )
    if result.timed_out:
        console.print(
            "[yellow]timed out:[/] the scenario's time_limit was reached before the policy was "
            "done; the episode scores 0"
        )
    if result.interrupted:
        console.print("[yellow]interrupted:[/] the result covers the episode so far")


def _ending(result: EpisodeResult) -> str:
    """A line with the reason why the episode ended, the objects and goals left over, and the
    largest contact force."""
    verdict = " (wrong)" if result.stop_reason_right is False else ""
    left = result.left_over.text or "nothing"
    line = f"stopped: {result.stop_reason}{verdict}; left over: {left}"
    peaks = peak_forces([result.as_dict()])
    if peaks:
        line += f"; peak force {max(item['force'] for item in peaks):.0f} N"
    return line


def _print_measures(console: Console, result: EpisodeResult) -> None:
    """Prints the successes by each of the task's other measures, if it has any."""
    names = list(dict.fromkeys(name for item in result.objects for name in item.measures))
    if names:
        counts = [sum(item.measures.get(name, False) for item in result.objects) for name in names]
        rates = [
            f"{name} {count}/{len(result.objects)}"
            for name, count in zip(names, counts, strict=True)
        ]
        console.print(f"success by each measure: {', '.join(rates)}", highlight=False)


def summary_table(summary: dict[str, Any]) -> Table:
    """The table of a summary, with a row for each category. The columns `strict` and
    `success` count objects; the others are medians."""
    table = Table(title=_summary_title(summary), title_justify="left")
    # In a narrow terminal, break long names, so that the right border stays visible.
    table.add_column("category", overflow="fold")
    for heading in ("strict", "success", *_ERROR_HEADINGS):
        words = heading.split()
        table.add_column("\n".join(words), justify="right", min_width=max(map(len, words)))
    categories = summary["categories"]
    rows = [(name, row, _counts(row)) for name, row in categories.items()]
    totals = tuple(sum(column) for column in zip(*(counts for *_, counts in rows), strict=True))
    for name, row, (objects, strict_successes, successes) in [*rows, ("all", summary, totals)]:
        table.add_row(
            escape(name),
            f"{strict_successes}/{objects}",
            f"{successes}/{objects}",
            *(number(row[key]["median"]) for key in ERRORS),
        )
    return table


def _summary_title(summary: dict[str, Any]) -> str:
    def rate(key: str, interval_key: str) -> str:
        low, high = summary[interval_key]
        return f"{summary[key]:.1%} (95 %: {low:.1%} to {high:.1%})"

    return escape(
        f"{summary['scenario']} by {summary['policy']}: {summary['episodes']} episodes, "
        f"{summary['failed_episodes']} failed, {summary['timed_out_episodes']} timed out\n"
        f"strict success: {rate('strict_success_rate', 'strict_ci95')}\n"
        f"{summary['success_description']}: {rate('success_rate', 'ci95')}"
    )


def _counts(category: dict[str, Any]) -> tuple[int, int, int]:
    """The numbers of objects, strict successes and successes."""
    objects = category["objects"]
    return (
        objects,
        round(category["strict_success_rate"] * objects),
        round(category["success_rate"] * objects),
    )


def summary_notes(summary: dict[str, Any]) -> str:
    """The lines below the table: causes of failure, successes that are not strict, and errors of
    the actions."""
    causes = [f"{count} {cause}" for cause, count in summary["causes"].items() if count]
    ambiguous = [f"{count} {name}" for name, count in summary["ambiguous"].items() if count]
    pick_position, pick_angle, place_position, place_angle = (
        number(summary["action_errors"][key]["median"]) for key in ACTION_ERRORS
    )
    measures = [f"{name} {row['success_rate']:.1%}" for name, row in summary["measures"].items()]
    lines = [f"success by each measure: {', '.join(measures)}"] if measures else []
    lines += [
        f"no success: {', '.join(causes) or 'none'}",
        f"success, but not strict: {', '.join(ambiguous) or 'none'}",
        f"actions, median error: pick {pick_position} mm {pick_angle} deg, "
        f"place {place_position} mm {place_angle} deg",
    ]
    if summary["stop_reasons"]:
        counts = [
            f"{word} {count['right'] + count['wrong']}"
            + (f" ({count['wrong']} wrong)" if count["wrong"] else "")
            for word, count in summary["stop_reasons"].items()
        ]
        lines.append(f"stopped: {', '.join(counts)}")
    peak = summary["peak_force_n"]
    lines.append(
        f"peak force of an action: 95 % below {number(peak['p95'], '.0f')} N, "
        f"at most {number(peak['max'], '.0f')} N; {summary['stopped_actions']} stopped"
    )
    if summary["arm"]:
        lines.append(_arm_line(summary["arm"]))
    if summary["needless_actions"]:
        lines.append(
            f"actions on objects that have no goal: {summary['needless_actions']} of "
            f"{summary['actions']}"
        )
    if summary["repeated_moves"]:
        lines.append(f"actions that moved a placed object: {summary['repeated_moves']}")
    if summary["moving_at_end"]:
        lines.append(f"still moving at the end: {summary['moving_at_end']} objects")
    return "\n".join(lines)


def _arm_line(use: dict[str, Any]) -> str:
    """A line with the shares of an arm's limits that were used, and the collisions of its links."""
    shares = [f"{key} {share:.0%}" for key, share in use.items() if key != "collisions"]
    pairs = [f"{pair} ({count})" for pair, count in use["collisions"].items()]
    return f"arm, of its limits: {', '.join(shares)}; collisions: {', '.join(pairs) or 'none'}"


def number(value: float | None, form: str = ".2f") -> str:
    """Formats a number for a table; a dash for None."""
    return "-" if value is None else format(value, form)
