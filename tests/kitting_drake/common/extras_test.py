import tomllib

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import EXTRAS, import_extra
from kitting_drake.common.paths import SCENARIOS


def test_extras_equal_those_of_pyproject():
    project = tomllib.loads((SCENARIOS.parent / "pyproject.toml").read_text())["project"]
    declared = project["optional-dependencies"]
    assert {name: list(packages) for name, packages in EXTRAS.items()} == {
        name: declared[name] for name in EXTRAS
    }


def test_a_missing_package_raises_with_its_install_command():
    with pytest.raises(UserError) as told:
        import_extra("no_such_package", purpose="--this", extra="lerobot")
    assert str(told.value) == (
        "--this needs the package no_such_package: pip install 'pyarrow>=21'"
    )
