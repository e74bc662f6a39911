"""`kitting-drake VERB ...`, and `python -m kitting_drake VERB ...`: the verbs under one command."""

import importlib
import sys

from kitting_drake import __version__

VERBS = {
    "run": "one episode, watched in Meshcat; keeps a replay",
    "evaluate": "many seeds side by side, and their summary",
    "collect": "demonstrations of the oracle, in one file",
    "draw_scenes": "static scenes of random tools, to learn from without physics",
    "train": "networks from demonstrations or static scenes",
    "decide": "a real camera's frame to one pick and place",
    "demonstrate": "frames and actions of a bench as demonstrations",
    "hkd": "tools and kits: list, sheet, build, import, annotate, kit",
    "results": "the pages of results, from the table of runs",
    "benchmark": "run times, recovery, MuJoCo, the paper's cells",
}
"""What each verb does."""


def main() -> None:
    """Runs the verb that the command line names, or lists them, and exits."""
    arguments = sys.argv[1:]
    if arguments[:1] == ["--version"]:
        print(f"kitting_drake {__version__}")
        sys.exit(0)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_listing())
        sys.exit(0)
    verb = arguments[0].replace("-", "_")
    if verb not in VERBS:
        print(
            f"error: there is no verb '{arguments[0]}': use one of {', '.join(VERBS)}",
            file=sys.stderr,
        )
        sys.exit(2)
    name = f"kitting_drake.{verb}" + (".__main__" if verb == "hkd" else "")
    sys.argv = [f"kitting-drake {arguments[0]}", *arguments[1:]]
    try:
        # Import only what the verb needs.
        module = importlib.import_module(name)
        run_command = importlib.import_module("kitting_drake.common.command_line").run_command
    except KeyboardInterrupt:
        sys.exit(130)
    run_command(module.main)


def _listing() -> str:
    width = max(map(len, VERBS))
    lines = [f"  {verb:<{width}}  {text}" for verb, text in VERBS.items()]
    tail = "kitting-drake VERB --help tells the rest."
    return "\n".join(["usage: kitting-drake VERB ...", "", *lines, "", tail])


if __name__ == "__main__":
    main()
