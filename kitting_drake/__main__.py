"""The command `kitting-drake VERB ...`, or `python -m kitting_drake VERB ...`."""

import importlib
import sys

from kitting_drake import __version__

VERBS = {
    "run": "run one episode, show it in Meshcat, save a replay",
    "evaluate": "run many seeds in parallel and summarise them",
    "collect": "collect demonstrations of the oracle in one file",
    "draw_scenes": "draw static scenes of random tools, for training without physics",
    "train": "train networks from demonstrations or static scenes",
    "decide": "decide one pick and place from a real camera's frames",
    "demonstrate": "convert frames and actions of a real bench to demonstrations",
    "hkd": "manage tools and kits: list, sheet, build, import, trace, annotate, kit",
    "results": "write the pages of results from the table of runs",
    "benchmark": "measure run times, recovery, agreement with MuJoCo, the paper's tables",
}
"""The verbs, with their help texts."""


def main() -> None:
    """Runs the verb given on the command line, or lists the verbs, and exits."""
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
            f"error: unknown verb '{arguments[0]}': use one of {', '.join(VERBS)}",
            file=sys.stderr,
        )
        sys.exit(2)
    name = f"kitting_drake.{verb}" + (".__main__" if verb == "hkd" else "")
    sys.argv = [f"kitting-drake {arguments[0]}", *arguments[1:]]
    try:
        # Import only the modules that the verb needs.
        module = importlib.import_module(name)
        run_command = importlib.import_module("kitting_drake.common.command_line").run_command
    except KeyboardInterrupt:
        sys.exit(130)
    run_command(module.main)


def _listing() -> str:
    width = max(map(len, VERBS))
    lines = [f"  {verb:<{width}}  {text}" for verb, text in VERBS.items()]
    tail = "See kitting-drake VERB --help for its options."
    return "\n".join(["usage: kitting-drake VERB ...", "", *lines, "", tail])


if __name__ == "__main__":
    main()
