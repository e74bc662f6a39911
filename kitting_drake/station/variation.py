"""Varies the friction and mass of models."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from kitting_drake.common.errors import UserError

_DRAKE = "http://drake.mit.edu"


def varied_model(path: Path, *, friction: float, mass: float) -> str:
    """The SDFormat text of a model, with friction coefficients and inertia scaled.

    Args:
        path: the path of the model.
        friction: factor of all friction coefficients.
        mass: factor of all masses and moments of inertia.

    Raises:
        UserError: the file is not valid SDFormat.
    """
    ElementTree.register_namespace("drake", _DRAKE)
    try:
        text = path.read_text()
        if "xmlns:drake" not in text:
            # Drake's parser does not need the declaration, but XML does.
            text = text.replace("<sdf ", f'<sdf xmlns:drake="{_DRAKE}" ', 1)
        root = ElementTree.fromstring(text)
        for name in ("mu_static", "mu_dynamic"):
            for element in root.iter(f"{{{_DRAKE}}}{name}"):
                _scale(element, friction)
        for inertial in root.iter("inertial"):
            for element in (*inertial.iter("mass"), *inertial.findall("inertia/*")):
                _scale(element, mass)
    except (OSError, ElementTree.ParseError, ValueError, TypeError) as error:
        raise UserError(f"task: cannot read {path} as SDFormat: {error}") from error
    for uri in root.iter("uri"):
        if uri.text and "://" not in uri.text:
            # A text has no folder, so make URIs absolute. Drake decodes no escapes in them.
            uri.text = f"file://{path.resolve().parent / uri.text}"
    return ElementTree.tostring(root, encoding="unicode")


def _scale(element: ElementTree.Element, factor: float) -> None:
    element.text = f"{factor * float(element.text or ''):.12g}"
