"""The command `kitting-drake COMMAND ...`, or `python -m kitting_drake COMMAND ...`."""

import importlib
import sys

from kitting_drake import __version__

COMMANDS = {
    "run": "run one episode, show it in Meshcat, save a replay",
    "evaluate": "run many seeds in parallel and summarise them",
    "collect": "collect demonstrations of the oracle in one file",
    "draw_scenes": "draw static scenes of random tools, for training without demonstrations",
    "train": "train networks from demonstrations or static scenes",
    "decide": "decide one pick and place from a real camera's frames",
    "demonstrate": "convert frames and actions of a real bench to demonstrations",
    "hkd": "manage tools and kits: list, sheet, generate, build, import, trace, annotate, kit",
    "results": "write the pages of results from the table of runs",
    "benchmark": "measure run times, recovery, agreement with MuJoCo, the paper's tables",
}
"""The commands, with their help texts."""


def main() -> None:
    """Runs the command given as the first argument, or lists the commands, and exits."""
    arguments = sys.argv[1:]
    if arguments[:1] == ["--version"]:
        print(f"kitting_drake {__version__}")
        sys.exit(0)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_listing())
        sys.exit(0)
    command = arguments[0].replace("-", "_")
    if command not in COMMANDS:
        print(
            f"error: unknown command '{arguments[0]}': use one of {', '.join(COMMANDS)}",
            file=sys.stderr,
        )
        sys.exit(2)
    name = f"kitting_drake.{command}" + (".__main__" if command == "hkd" else "")
    sys.argv = [f"kitting-drake {arguments[0]}", *arguments[1:]]
    try:
        # Import only the modules that the command needs.
        module = importlib.import_module(name)
        run_command = importlib.import_module("kitting_drake.common.command_line").run_command
    except KeyboardInterrupt:
        sys.exit(130)
    run_command(module.main)


def _listing() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {command:<{width}}  {text}" for command, text in COMMANDS.items()]
    tail = "See kitting-drake COMMAND --help for its options."
    return "\n".join(["usage: kitting-drake COMMAND ...", "", *lines, "", tail])


if __name__ == "__main__":
    main()
