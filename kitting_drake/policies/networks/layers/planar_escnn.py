"""Imports escnn for planar groups. All other modules import escnn from here.

escnn imports lie_learn, but uses it for SO(3) only. lie_learn 0.0.2 fails to load with numpy 2 and
has no wheel for Python 3.13 (see QUVA-Lab/escnn#80 and AMLab-Amsterdam/lie_learn#30). This module
replaces it with a stub that raises an error when called.
"""

import sys
import types
import warnings

__all__ = ["enn", "gspaces"]

_MODULE = "lie_learn.representations.SO3.wigner_d"


def _stand_in() -> types.ModuleType:
    """Makes the stub of the module that escnn imports."""

    def wigner_d_matrix(*args: object, **options: object) -> None:
        raise NotImplementedError(
            "escnn needs the package lie_learn for SO(3), which kitting_drake replaces with a "
            "stub: install lie_learn, and import escnn before kitting_drake"
        )

    module = types.ModuleType(_MODULE)
    vars(module)["wigner_D_matrix"] = wigner_d_matrix
    return module


# `setdefault` keeps the real lie_learn if escnn was imported first.
sys.modules.setdefault(_MODULE, _stand_in())
with warnings.catch_warnings():
    # escnn warns about an optional package that planar groups do not need.
    warnings.simplefilter("ignore")
    from escnn import gspaces
    from escnn import nn as enn
