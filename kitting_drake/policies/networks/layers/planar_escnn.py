"""escnn for groups of the plane: every import of escnn in this project goes through here.

escnn imports one function of lie_learn, and calls it for SO(3) alone. lie_learn 0.0.2 does not load
with numpy 2 and has no wheel for Python 3.13: see the requests QUVA-Lab/escnn#80 and
AMLab-Amsterdam/lie_learn#30. A module with a function that refuses stands in for it here.
"""

import sys
import types
import warnings

__all__ = ["enn", "gspaces"]

_MODULE = "lie_learn.representations.SO3.wigner_d"


def _stand_in() -> types.ModuleType:
    """The module that escnn imports, with a function that refuses."""

    def wigner_d_matrix(*args: object, **options: object) -> None:
        raise NotImplementedError(
            "escnn needs the package lie_learn for SO(3), and kitting_drake put a stand-in in its "
            "place: install lie_learn, and import escnn before kitting_drake"
        )

    module = types.ModuleType(_MODULE)
    vars(module)["wigner_D_matrix"] = wigner_d_matrix
    return module


# Where escnn was imported before, the real lie_learn is loaded and stays.
sys.modules.setdefault(_MODULE, _stand_in())
with warnings.catch_warnings():
    # escnn warns of an optional package that planar groups never use.
    warnings.simplefilter("ignore")
    from escnn import gspaces
    from escnn import nn as enn
