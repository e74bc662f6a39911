import tomllib

import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import EXTRAS, import_extra
from kitting_drake.common.paths import SCENARIOS


def test_the_advice_is_what_the_project_declares():
    project = tomllib.loads((SCENARIOS.parent / "pyproject.toml").read_text())["project"]
    declared = project["optional-dependencies"]
    assert {name: list(packages) for name, packages in EXTRAS.items()} == {
        name: declared[name] for name in EXTRAS
    }


def test_what_is_missing_is_told_with_what_would_bring_it():
    with pytest.raises(UserError) as told:
        import_extra("no_such_package", purpose="--this", extra="lerobot")
    assert str(told.value) == (
        "--this needs the package no_such_package: pip install 'pyarrow>=21'"
    )
