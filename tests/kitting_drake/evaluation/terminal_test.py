from rich.console import Console

from kitting_drake.episode.ending import Position, Remainder
from kitting_drake.evaluation.summary import summarise
from kitting_drake.evaluation.terminal import (
    episode_table,
    print_episode,
    summary_notes,
    summary_table,
)
from tests.kitting_drake.evaluation.episodes import (
    ADD_S,
    CHOSEN,
    make_episode,
    make_object,
    make_result,
)


def rows(shown: str) -> dict[str, list[str]]:
    """The cells of a table's rows, by first cell."""
    lines = [line.strip("│ \n").split("│") for line in shown.splitlines() if "│" in line]
    return {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines}


def captured(*things: object, width: int = 110) -> str:
    console = Console(width=width)
    with console.capture() as shown:
        for thing in things:
            console.print(thing)
    return shown.get()


def test_the_table_names_the_ambiguity_of_a_success():
    objects = [
        make_object("cup", 1.0),
        make_object("bolt", 1.0, height_error_mm=-2.5),
        make_object("block", 1.0, angle_error_deg=178.0),
        make_object("lid", 1.0, height_error_mm=3.0, angle_error_deg=30.0),
        make_object("ring", 9.0),
        make_object("spare", None),
    ]
    table = episode_table(make_result(0, objects))
    found = rows(captured(table))
    assert {name: cells[0] for name, cells in found.items()} == {
        "cup": "yes",
        "bolt": "protruding",
        "block": "reversed",
        "lid": "protruding, reversed",
        "ring": "no",
        "spare": "-",
    }
    assert found["spare"] == ["-"] * 5
    assert found["block"][3] == "-178.00"
    words = list(table.columns[1].cells)
    assert ["green" in str(word) for word in words] == [True, *[False] * 5]
    assert all("yellow" in str(word) for word in words[1:4])


def test_the_summary_table_fits_into_80_columns():
    objects = [make_object("combination_wrench", 1.0), make_object("x" * 30, 1.0)]
    episode = make_result(0, objects).as_dict()
    summary = summarise([episode], CHOSEN, ADD_S, wall_seconds_total=1.0)
    shown = captured(summary_table(summary), width=80)
    assert "position" in shown
    assert "combination_wrench" in shown
    assert "…" not in shown
    lines = [line.rstrip() for line in shown.splitlines()[3:]]
    assert {line[-1] for line in lines} <= set("┓┃┩│┘")
    assert max(map(len, lines)) <= 80


def test_the_lines_below_the_table_of_an_episode():
    console = Console(width=200)
    result = make_result(
        0,
        [make_object("cup", 1.0), make_object("ring", 9.0)],
        timed_out=True,
        moving_at_end=["cup", "ring[/]"],
        stop_reason="time",
        stop_reason_right=False,
        left_over=Remainder(
            (Position(0.4, 0.1),), (Position(0.5, -0.2), Position(0.6, -0.2)), "policy"
        ),
    )
    with console.capture() as shown:
        print_episode(console, result)
    assert "no success: ring (misplaced)" in shown.get()
    assert (
        "stopped: time (wrong); left over: 1 object at (0.40, 0.10) and "
        "2 cavities at (0.50, -0.20), (0.60, -0.20); peak force 12 N"
    ) in shown.get()
    assert "timed out: the scenario's time_limit was reached" in shown.get()
    assert "still moving at the end: cup, ring[/]" in shown.get()


def test_the_text_of_a_failure_is_printed_unchanged():
    """The console must not read a failure's text as markup; as markup, this one is invalid."""
    console = Console(width=200)
    with console.capture() as shown:
        print_episode(console, make_result(0, [], failure="KeyError: [/x]"))
    assert "failed: KeyError: [/x]; the episode scores 0" in shown.get()


def test_the_summary_table_starts_with_the_strict_rate():
    protruding = make_object("cup", 1.0, height_error_mm=3.0)
    episodes = [
        make_result(0, [protruding, make_object("bolt", 1.0)]).as_dict(),
        make_episode(1, [1.0, 9.0], moving_at_end=["bolt"]),
        make_episode(2, [1.0, 9.0], timed_out=True),
    ]
    verdicts = [("done", True), ("done", False), ("time", True)]
    for episode, (reason, is_right) in zip(episodes, verdicts, strict=True):
        episode |= {"stop_reason": reason, "stop_reason_right": is_right}
    summary = summarise(episodes, CHOSEN, ADD_S, wall_seconds_total=1.0)
    shown = captured(summary_table(summary))
    assert "3 episodes, 0 failed, 1 timed out" in shown
    assert shown.index("strict success: 33.3%") < shown.index("ADD-S below 3.5 mm: 50.0%")
    assert {name: cells[:2] for name, cells in rows(shown).items()} == {
        "bolt": ["1/3", "1/3"],
        "cup": ["1/3", "2/3"],
        "all": ["2/6", "3/6"],
    }
    assert summary_notes(summary).splitlines() == [
        "no success: 1 misplaced, 2 timed out",
        "success, but not strict: 1 protruding",
        "actions, median error: pick 1.00 mm 2.00 deg, place 2.00 mm 3.00 deg",
        "stopped: done 2 (1 wrong), time 1",
        "peak force of an action: 95 % below 12 N, at most 12 N; 0 stopped",
        "still moving at the end: 1 objects",
    ]
