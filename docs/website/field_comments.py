"""An extension of griffe that uses the comment above a field of a schema as its docstring.

Drake's YAML schemas explain their fields in comments, as Drake's own examples do.
"""

import griffe


class FieldComments(griffe.Extension):
    """Makes docstrings of the comments above fields."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **kwargs: object) -> None:
        """Reads the comment directly above an attribute without a docstring."""
        owner = attr.parent
        if attr.docstring or attr.lineno is None or owner is None or not owner.is_class:
            return
        lines = attr.lines_collection[attr.filepath]
        found: list[str] = []
        for line in reversed(lines[: attr.lineno - 1]):
            if not line.strip().startswith("#"):
                break
            found.insert(0, line.strip().removeprefix("#").strip())
        if found:
            attr.docstring = griffe.Docstring("\n".join(found), parent=attr)
