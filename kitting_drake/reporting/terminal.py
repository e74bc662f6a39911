"""What a person reads in the terminal."""

from rich.console import Console
from rich.table import Table

from kitting_drake.episode.episode import EpisodeResult


def episode_table(result: EpisodeResult) -> Table:
    """A row for each tool."""
    table = Table(title=f"{result.scenario}, seed {result.seed}", title_justify="left")
    table.add_column("tool", no_wrap=True)
    table.add_column("kitted", justify="center")
    for name in ("ADD-S mm", "position mm", "angle deg", "height mm"):
        table.add_column(name, justify="right")
    for item in result.objects:
        table.add_row(
            item.name,
            "[green]yes[/]" if item.success else "[red]no[/]",
            f"{item.add_s_mm:.2f}",
            f"{item.position_error_mm:.2f}",
            f"{item.angle_error_deg:+.2f}",
            f"{item.height_error_mm:+.2f}",
        )
    return table


def print_episode(console: Console, result: EpisodeResult) -> None:
    """The table of an episode and its summary."""
    console.print(episode_table(result))
    rate = result.sim_seconds / result.wall_seconds if result.wall_seconds else 0.0
    console.print(
        f"{result.success_rate:.0%} kitted in {result.actions} actions, "
        f"{result.sim_seconds:.1f} s simulated in {result.wall_seconds:.1f} s ({rate:.1f}x), "
        f"{result.point_contact_pairs} point contacts"
    )
    if result.missed_grasps or result.dropped_objects:
        console.print(
            f"{result.missed_grasps} missed grasps, {result.dropped_objects} dropped objects"
        )
    if result.failure:
        console.print(f"[red]failed:[/] {result.failure}", highlight=False)
    if result.timed_out:
        console.print("[yellow]stopped:[/] the scenario's time_limit was reached")
    if result.interrupted:
        console.print("[yellow]interrupted:[/] what happened so far is kept")
