"""The flags of `hkd kit` that test a kit in simulation (`--prove`)."""

import argparse
import os
from collections.abc import Sequence

from kitting_drake.common.command_line import count_type
from kitting_drake.common.errors import UserError
from kitting_drake.hkd.generation.part_models import load_named


def describe_proof(maker: argparse.ArgumentParser) -> None:
    """Adds the flags `--prove`, `--prove_with` and `--workers`."""
    maker.add_argument(
        "--prove",
        type=count_type,
        nargs="?",
        const=10,
        metavar="N",
        help="simulate the kitting N times (10 if N is left out) with the errors of a printer, "
        "and write proof.html",
    )
    maker.add_argument(
        "--prove_with",
        type=_pair,
        action="append",
        default=[],
        metavar="TOOL=TRUE_TOOL",
        help="in the proof, put another tool into the cavity of TOOL, such as a scan into "
        "the cavity of a traced outline; may be repeated",
    )
    maker.add_argument(
        "--workers",
        type=count_type,
        help=f"number of parallel processes for --prove (default: {os.cpu_count()})",
    )


def _pair(text: str) -> tuple[str, str]:
    """Parses `TOOL=TRUE_TOOL`."""
    name, equals, true = text.partition("=")
    if not name or not equals or not true:
        raise argparse.ArgumentTypeError(f"'{text}' is not TOOL=TRUE_TOOL")
    return name, true


def tools_to_prove(tools: Sequence[str], given: Sequence[tuple[str, str]]) -> list[str]:
    """Returns the folders of the tools that `--prove` puts into the cavities of a kit.

    Args:
        tools: the kit's tools, as named on the command line.
        given: pairs (tool of the kit, tool to put into its cavity instead), by names or folders.

    Returns:
        A folder for each of `tools`; an empty list if `given` is empty.

    Raises:
        UserError: a tool does not exist, or the first tool of a pair is not in the kit.
    """
    if not given:
        return []
    loaded = [load_named(name) for name in tools]
    others = {name: load_named(true) for name, true in given}
    names = {*tools, *(tool.name for tool in loaded)}
    unknown = [name for name in others if name not in names]
    if unknown:
        listed = ", ".join(tool.name for tool in loaded)
        raise UserError(f"--prove_with: the kit has no tool '{unknown[0]}': give one of {listed}")
    chosen = [
        others.get(name) or others.get(tool.name) or tool
        for name, tool in zip(tools, loaded, strict=True)
    ]
    return [str(tool.directory.resolve()) for tool in chosen]
