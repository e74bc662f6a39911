"""Reads the prose of the pages of results from `prose.md`."""

import re
from functools import cache
from pathlib import Path

_PART = re.compile(r"<!-- part: (\w+) -->\n")


def prose(part: str, **values: object) -> str:
    """Returns a part of `prose.md` with its placeholders filled in, and a final newline.

    Args:
        part: the name of the part.
        values: the values for the placeholders `{name}`.

    Raises:
        KeyError: the part does not exist, or a value is missing.
    """
    return _parts()[part].format(**values) + "\n"


@cache
def _parts() -> dict[str, str]:
    text = Path(__file__).with_name("prose.md").read_text()
    _, *found = _PART.split(text)
    return {name: part.strip() for name, part in zip(found[::2], found[1::2], strict=True)}
