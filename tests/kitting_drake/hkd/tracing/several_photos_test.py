"""Traces from two photos of the same scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from manifold3d import CrossSection

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.tracing.scales import Scale
from kitting_drake.hkd.tracing.tracer import TraceRequest, trace
from kitting_drake.reproduction.benchmarks.trace_benchmark import outline_errors
from kitting_drake.reproduction.benchmarks.trace_photos import PhotoSpec, PlacedTool, draw_photo

pytest.importorskip("cv2")

BLADE = CrossSection.square((110, 18)) + CrossSection.circle(22, 60).translate((110, 9))
FORK = CrossSection.square((110, 40)) - CrossSection.square((70, 6)).translate((50, 17))
"""A tool with a gap of 6 mm, which its own sides hide in the first photo."""
HEIGHT = 14.0
SPEC = PhotoSpec(size=(1400, 1050), distance=380.0, tilt=20.0, azimuth=80.0, shadow=0.3)


def photos_of(
    folder: Path, *specs: PhotoSpec, outline: CrossSection = BLADE, x: float = 90.0
) -> tuple[Path, ...]:
    tool = PlacedTool(outline.translate((x, 90)), HEIGHT, ("dark steel", "blue"))
    paths = []
    for number, spec in enumerate(specs):
        paths.append(folder / f"photo_{number}.jpg")
        paths[-1].write_bytes(draw_photo([tool], spec))
    return tuple(paths)


@pytest.mark.parametrize("quarter", [0, pytest.param(90, marks=pytest.mark.slow)])
def test_two_photos_show_the_height(quarter: int, tmp_path: Path):
    """The second camera may be held upside down or upright."""
    other = SPEC.from_side(1)
    photos = photos_of(tmp_path, SPEC, replace(other, roll=other.roll + quarter))
    report = trace(TraceRequest(photos, tmp_path / "out"))
    (tool,) = report.tools
    assert tool.height_mm == pytest.approx(HEIGHT, abs=0.8)
    assert np.percentile(outline_errors(tool.outline, BLADE), 95) < 0.6
    assert not tool.doubts
    assert any(f"{tool.height_mm:g} mm, as the photos show it" in note for note in report.notes)


@pytest.mark.slow
def test_a_second_photo_shows_a_hidden_gap(tmp_path: Path):
    fine = replace(SPEC, size=(3000, 2250))
    photos = photos_of(tmp_path, fine, replace(fine.from_side(1), tilt=8.0), outline=FORK)
    for shown, (low, high) in ((photos[:1], (2.0, 30.0)), (photos, (0.0, 0.6))):
        (tool,) = trace(TraceRequest(shown, tmp_path / "out", heights_mm=(HEIGHT,))).tools
        assert low < np.percentile(outline_errors(tool.outline, FORK), 95) < high


def test_photos_that_do_not_belong_together_are_refused(tmp_path: Path):
    near = replace(SPEC, azimuth=SPEC.azimuth + 8)
    (same, close) = photos_of(tmp_path, SPEC, near)
    (tmp_path / "moved").mkdir()
    (moved,) = photos_of(tmp_path / "moved", SPEC.from_side(1), x=170.0)
    with pytest.raises(UserError, match="the same tools at the same places"):
        trace(TraceRequest((same, moved), tmp_path / "out"))
    with pytest.raises(UserError, match=r"nearly the same place.*give --height_mm"):
        trace(TraceRequest((same, close), tmp_path / "out"))
    with pytest.raises(UserError, match="need a sheet"):
        trace(TraceRequest((same, close), tmp_path / "out", scale=Scale(disc_mm=25.0)))
    assert not (tmp_path / "out").exists()
