"""Exports of kits without pictures."""

import pytest


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing its picture takes most of the time of a kit's export.

    The module's own fixtures run before this one, so their kits have a picture.
    """
    monkeypatch.setattr("kitting_drake.hkd.fabrication.export.picture_png", lambda _: b"")
