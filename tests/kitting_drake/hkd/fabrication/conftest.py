"""A fixture with which kits are exported without their pictures."""

import pytest


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces a kit's picture by no data, because drawing it takes most of an export's time.

    Module-scoped fixtures run before this one, so the kits that they export do have a picture.
    """
    monkeypatch.setattr("kitting_drake.hkd.fabrication.export.picture_png", lambda _: b"")
