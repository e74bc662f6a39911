"""The catalogue of the generated tools, `models/tools/catalogue.yaml`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tools.tool import CATEGORIES, RecordLoader


class CatalogueError(UserError):
    """Raised for an invalid catalogue entry; the message names the entry and the field."""


@dataclass
class GraspEntry:
    """An annotated grasp in the tool frame T. The jaws close along the y axis, rotated by theta
    about z."""

    x_mm: float = 0.0
    y_mm: float = 0.0
    theta_deg: float = 0.0


@dataclass
class ToolEntry:
    """One entry of the catalogue."""

    name: str
    category: str
    split: str
    # The length in mm to which the design is scaled.
    length_mm: float
    grasp: GraspEntry
    # Parameters of the design that differ from the category's defaults.
    parameters: dict[str, Any] = field(default_factory=dict)


def load_catalogue(path: Path) -> list[ToolEntry]:
    """Reads `catalogue.yaml`.

    Raises:
        CatalogueError: an entry is invalid.
    """
    try:
        data = yaml.load(path.read_text(), Loader=RecordLoader)
    except OSError as error:
        raise CatalogueError(f"cannot read {path}: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise CatalogueError(f"{path}: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict) or not isinstance(data.get("tools"), list):
        raise CatalogueError(f"{path}: the file must hold a list named `tools`")
    entries: list[ToolEntry] = []
    for item in data["tools"]:
        name = item.get("name", f"number {len(entries) + 1}")
        try:
            entries.append(ToolEntry(**{**item, "grasp": GraspEntry(**item["grasp"])}))
        except (KeyError, TypeError) as error:
            raise CatalogueError(
                f"{path}: tool {name} must have the fields name, category, split, length_mm and "
                "grasp, and may have parameters; the grasp may have x_mm, y_mm and theta_deg"
            ) from error
        if entries[-1].category not in CATEGORIES:
            raise CatalogueError(
                f"{path}: tool {name}: category {entries[-1].category!r} is not one of "
                f"{', '.join(CATEGORIES)}"
            )
    names = [e.name for e in entries]
    for name in set(names):
        if names.count(name) > 1:
            raise CatalogueError(f"{path}: two tools are called {name!r}; rename one")
    return entries
