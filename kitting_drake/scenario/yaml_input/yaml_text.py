"""Parses YAML with readable error messages, and writes YAML for Drake."""

import copy
import functools
from typing import Any

import yaml
from pydrake.common.yaml import yaml_load

from kitting_drake.common.errors import UserError

# Use libyaml if it is available, because it is several times as fast.
_Composer = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_TEXT, _MERGE = "tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"
_NULL = "tag:yaml.org,2002:null"


class _Dumper(yaml.SafeDumper):
    """Writes as YAML the mappings that Drake's `yaml_load` returned.

    `yaml_load` keeps the tag of a mapping under the key `_tag`; here it becomes a tag again.
    """

    def ignore_aliases(self, data: Any) -> bool:
        """Returns True, so that a repeated mapping is written again instead of as a reference."""
        return True


def _represent_tagged(dumper: yaml.SafeDumper, data: dict[str, Any]) -> yaml.Node:
    tag = data.get("_tag", "tag:yaml.org,2002:map")
    return dumper.represent_mapping(tag, {k: v for k, v in data.items() if k != "_tag"})


_Dumper.add_representer(dict, _represent_tagged)


def dumped(raw: dict) -> str:
    """Converts a mapping to YAML and keeps its order.

    The order matters for `appearance.paints`, where the last matching pattern wins. Drake's
    `yaml_dump` would sort the names.
    """
    return yaml.dump(raw, Dumper=_Dumper, sort_keys=False)


def parse(content: str, where: str) -> dict:
    """Parses a text that holds a mapping. Anchors, aliases and merge keys (`<<`) are resolved.

    Args:
        content: the text.
        where: name of the text in error messages.

    Raises:
        UserError: the text is not YAML, or not a mapping from names to values.
    """
    try:
        root = copy.deepcopy(_checked(content))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it cannot be parsed"
        if getattr(error, "context", None) == "while scanning a tag":
            problem = "a tag needs a space and a mapping behind it, as in !Oracle {}"
        raise UserError(f"{where}{line} is not YAML: {problem}") from error
    except ValueError as error:
        raise UserError(f"{where}: {error}") from error
    except RecursionError as error:
        raise UserError(f"{where} is endless: an alias in it contains itself") from error
    if root is None:
        return {}
    if not isinstance(root, dict):
        raise UserError(f"{where} must be a mapping from names to values")
    return root


# Cache the result, because benchmarks load one file hundreds of times.
@functools.lru_cache(maxsize=64)
def _checked(content: str) -> Any:
    """Parses and checks a text. The result is cached, so callers must not change it."""
    # Check for repeated fields here: a Python mapping would keep only the last.
    try:
        node = yaml.compose(content, Loader=_Composer)
    except yaml.YAMLError:
        # Parse it again with PyYAML's own parser, whose error messages are clearer.
        node = yaml.compose(content, Loader=yaml.SafeLoader)
    _check_names(node)
    # Drake's loader would drop such a tag without a warning.
    if isinstance(node, yaml.MappingNode) and node.tag != "tag:yaml.org,2002:map":
        raise ValueError(f"the tag {node.tag} at the beginning has no effect: remove it")
    # Do not pass an empty text to Drake, which would treat it as a missing argument.
    return yaml_load(data=content) if content.strip() else None


def _check_names(node: yaml.Node | None) -> None:
    if node is not None and not isinstance(node, yaml.MappingNode) and node.tag.startswith("!"):
        line = node.start_mark.line + 1
        raise ValueError(
            f"the tag {node.tag} on line {line} needs a mapping: write {node.tag} {{}}"
        )
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            line = key.start_mark.line + 1
            _check_names(value)
            if key.tag == _MERGE:
                continue
            if key.tag != _TEXT and value.tag == _NULL and not value.value:
                raise ValueError(
                    f"'{key.value}' on line {line} looks like an item of a list: a list needs "
                    "square brackets, as in [1, 2]"
                )
            if key.tag != _TEXT:
                raise ValueError(f"the name of the field on line {line} must be a string")
            if key.value == "_tag":
                raise ValueError(
                    f"'_tag' on line {line} is not a field: write !Name before the value"
                )
            if key.value in seen:
                raise ValueError(f"'{key.value}' is given twice (again on line {line})")
            seen.add(key.value)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_names(item)
