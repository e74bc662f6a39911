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


def tool(
    outline: CrossSection = BLADE, height: float = HEIGHT, x: float = 90.0, y: float = 90.0
) -> PlacedTool:
    return PlacedTool(outline.translate((x, y)), height, ("dark steel", "blue"))


def photos_of(folder: Path, *shots: tuple[PhotoSpec, list[PlacedTool]]) -> tuple[Path, ...]:
    paths = []
    for number, (spec, tools) in enumerate(shots):
        paths.append(folder / f"photo_{number}.jpg")
        paths[-1].write_bytes(draw_photo(tools, spec))
    return tuple(paths)


@pytest.mark.parametrize("quarter", [0, pytest.param(90, marks=pytest.mark.slow)])
def test_two_photos_show_the_height(quarter: int, tmp_path: Path):
    """The second camera may be held upside down or upright."""
    other = SPEC.from_side(1)
    other = replace(other, roll=other.roll + quarter)
    photos = photos_of(tmp_path, (SPEC, [tool()]), (other, [tool()]))
    report = trace(TraceRequest(photos, tmp_path / "out"))
    (found,) = report.tools
    assert found.height_mm == pytest.approx(HEIGHT, abs=0.8)
    assert np.percentile(outline_errors(found.outline, BLADE), 95) < 0.6
    assert not found.doubts
    assert any(f"{found.height_mm:g} mm, as the photos show it" in note for note in report.notes)


def test_tools_of_different_heights_keep_apart(tmp_path: Path):
    """In an oblique photo, the silhouette of the high tool reaches over the place of the low one.
    A correction changes the tool that it touches."""
    low = tool(CrossSection.square((110, 30)), 6.0, y=60.0)
    high = tool(CrossSection.square((110, 40)), 24.0, y=110.0)
    photos = photos_of(tmp_path, (SPEC, [low, high]), (SPEC.from_side(1), [low, high]))
    found = trace(TraceRequest(photos, tmp_path / "out")).tools
    by_height = sorted(found, key=lambda item: item.height_mm)
    assert [item.height_mm for item in by_height] == pytest.approx([6, 24], abs=1.5)
    assert [item.size_mm[1] for item in by_height] == pytest.approx([30, 40], abs=1.0)
    points = tmp_path / "points.yaml"
    points.write_text("- remove: [[180, 50], [260, 50], [260, 100], [180, 100]]\n")
    heights = tuple(item.height_mm for item in found)
    again = trace(TraceRequest(photos, tmp_path / "out", heights_mm=heights, points=points)).tools
    lengths = sorted(item.size_mm[0] for item in again)
    assert lengths == pytest.approx([90, 110], abs=1.0)


def test_a_tool_that_is_missing_in_one_photo_is_named(tmp_path: Path):
    small = tool(CrossSection.square((50, 20)), x=120.0, y=150.0)
    photos = photos_of(tmp_path, (SPEC, [tool(), small]), (SPEC.from_side(1), [tool()]))
    place = r"photo_1.jpg does not show the tool .* at \(14\d, 15\d\) mm"
    with pytest.raises(UserError, match=place):
        trace(TraceRequest(photos, tmp_path / "out", heights_mm=(HEIGHT,)))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_second_photo_shows_a_hidden_gap(tmp_path: Path):
    fine = replace(SPEC, size=(3000, 2250))
    other = replace(fine.from_side(1), tilt=8.0)
    photos = photos_of(tmp_path, (fine, [tool(FORK)]), (other, [tool(FORK)]))
    for shown, (low, high) in ((photos[:1], (2.0, 30.0)), (photos, (0.0, 0.6))):
        (found,) = trace(TraceRequest(shown, tmp_path / "out", heights_mm=(HEIGHT,))).tools
        assert low < np.percentile(outline_errors(found.outline, FORK), 95) < high


def test_photos_that_do_not_belong_together_are_refused(tmp_path: Path):
    near = replace(SPEC, azimuth=SPEC.azimuth + 8)
    (same, close) = photos_of(tmp_path, (SPEC, [tool()]), (near, [tool()]))
    (tmp_path / "moved").mkdir()
    (moved,) = photos_of(tmp_path / "moved", (SPEC.from_side(1), [tool(x=170.0)]))
    with pytest.raises(UserError, match="the same tools at the same places"):
        trace(TraceRequest((same, moved), tmp_path / "out"))
    with pytest.raises(UserError, match=r"nearly the same place.*give --height_mm"):
        trace(TraceRequest((same, close), tmp_path / "out"))
    with pytest.raises(UserError, match="need a sheet"):
        trace(TraceRequest((same, close), tmp_path / "out", scale=Scale(disc_mm=25.0)))
    assert not (tmp_path / "out").exists()
