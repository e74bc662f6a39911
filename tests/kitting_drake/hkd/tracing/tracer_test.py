import json
import math
from pathlib import Path

import numpy as np
import pytest
from manifold3d import CrossSection
from PIL import ExifTags, Image

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.outline import read_drawing
from kitting_drake.hkd.tracing.photo_file import Photo, read_photo
from kitting_drake.hkd.tracing.scales import Scale, plane_of_scale
from kitting_drake.hkd.tracing.tracer import TraceReport, TraceRequest, trace
from kitting_drake.reproduction.benchmarks.trace_benchmark import outline_errors
from kitting_drake.reproduction.benchmarks.trace_photos import (
    PhotoSpec,
    PlacedPrint,
    PlacedTool,
    draw_photo,
)

cv2 = pytest.importorskip("cv2")

SMALL, FINE = (1400, 1050), (2000, 1500)
SPANNER = (
    CrossSection.square((110, 18)).translate((0, -9))
    + CrossSection.circle(17, 60)
    + CrossSection.circle(15, 60).translate((112, 0))
    - CrossSection.circle(9, 60)
    - CrossSection.square((22, 12)).translate((110, -6))
)
"""The outline of a spanner with a ring whose hole is 18 mm and a jaw that is 12 mm wide."""


def photo_of(folder: Path, *tools: PlacedTool, printed: PlacedPrint | None = None, **spec) -> Path:
    path = folder / "My Photo.jpg"
    path.write_bytes(
        draw_photo(list(tools), PhotoSpec(**{"size": SMALL, "distance": 380.0, **spec}), printed)
    )
    return path


def spanner(height: float = 12.0, x: float = 90.0, y: float = 100.0) -> PlacedTool:
    return PlacedTool(SPANNER.translate((x, y)), height, ("dark steel", "blue"))


def traced(path: Path, **request) -> TraceReport:
    return trace(TraceRequest((path,), path.parent / "out", **request))


@pytest.mark.parametrize(
    ("ground", "tilt", "height", "exif", "size"),
    [
        ("dark", 22.0, 14.0, True, SMALL),
        pytest.param("light", 8.0, 6.0, True, FINE, marks=pytest.mark.slow),
        pytest.param("dark", 20.0, 14.0, False, FINE, marks=pytest.mark.slow),
    ],
)
def test_an_oblique_photo_gives_the_true_outline(
    *,
    ground: str,
    tilt: float,
    height: float,
    exif: bool,
    size: tuple[int, int],
    tmp_path: Path,
):
    view = {"ground": ground, "tilt": tilt, "azimuth": 130, "roll": 12, "size": size}
    path = photo_of(tmp_path, spanner(height), exif=exif, **view)
    report = traced(path, heights_mm=(height,))
    (tool,) = report.tools
    median, p95 = np.percentile(outline_errors(tool.outline, SPANNER), (50, 95))
    assert median < 0.3
    assert p95 < 0.9
    assert tool.holes == 1
    assert not tool.doubts
    assert tool.size_mm[0] == pytest.approx(142.7, abs=0.6)
    assert any("EXIF" in note for note in report.notes) == exif
    for suffix in (".svg", ".dxf"):
        drawing = read_drawing(tool.svg.with_suffix(suffix)).outline
        assert drawing.area() == pytest.approx(tool.outline.area(), rel=1e-3)
    assert (path.parent / "out/trace.png").stat().st_size > 10_000
    (photo,) = json.loads((path.parent / "out/trace.json").read_text())["photos"]
    assert photo["tilt_deg"] == pytest.approx(tilt, abs=1.0)


@pytest.mark.slow
def test_several_tools_are_numbered_from_the_left_and_have_heights_of_their_own(tmp_path: Path):
    bar = PlacedTool(CrossSection.square((20, 90)).translate((250, 60)), 25, ("red", "red"))
    path = photo_of(tmp_path, spanner(8), bar, tilt=5, size=FINE)
    report = traced(path, heights_mm=(8.0, 25.0), name="set")
    assert [tool.name for tool in report.tools] == ["set_1", "set_2"]
    assert report.tools[1].size_mm == pytest.approx((90, 20), abs=0.6)
    with pytest.raises(UserError, match=r"3 heights.*2 tools"):
        traced(path, heights_mm=(8.0, 25.0, 3.0))


def test_a_tool_over_the_edge_of_the_sheet_is_not_cut_off_silently(tmp_path: Path):
    tool = spanner(6, x=120, y=2)
    path = photo_of(tmp_path, tool, ground="light", tilt=3, shadow=0.2, size=FINE)
    with pytest.raises(UserError, match="over the sheet's edge"):
        traced(path, heights_mm=(6.0,))


def test_letter_is_told_from_a4(tmp_path: Path):
    path = photo_of(tmp_path, spanner(), sheet=(279.4, 215.9), tilt=15)
    assert "279.4 x 215.9" in traced(path).notes[0]


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        ({"tilt": 36.0, "distance": 520.0}, "degrees from the vertical"),
        ({"blur": 9.0}, "blurred"),
        pytest.param({"sheet": (1500.0, 1200.0)}, "no sheet", marks=pytest.mark.slow),
        pytest.param(
            {"sheet": (210.0, 210.0)}, "sides of the largest sheet", marks=pytest.mark.slow
        ),
    ],
)
def test_a_poor_photo_is_refused_in_a_sentence(spec: dict, reason: str, tmp_path: Path):
    middle = {"x": 700.0, "y": 600.0} if spec.get("sheet") == (1500.0, 1200.0) else {}
    path = photo_of(tmp_path, spanner(**middle), **spec)
    with pytest.raises(UserError, match=reason) as error:
        traced(path, heights_mm=(12.0,))
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_an_empty_sheet_and_files_that_are_no_photos_are_refused(tmp_path: Path):
    with pytest.raises(UserError, match="no tool is seen"):
        traced(photo_of(tmp_path))
    (tmp_path / "text.jpg").write_text("no photo")
    with pytest.raises(UserError, match="cannot be read as a photo"):
        traced(tmp_path / "text.jpg")
    with pytest.raises(UserError, match="there is no file"):
        traced(tmp_path / "missing.jpg")


def test_photos_of_other_kinds_are_read_as_seen(tmp_path: Path):
    shades = np.zeros((600, 800), np.uint16)
    shades[:, 400:] = 40_000
    Image.fromarray(shades).save(tmp_path / "deep.png")
    deep = read_photo(tmp_path / "deep.png").pixels
    assert (deep[0, 0, 0], deep[0, 700, 0]) == (0, 156)
    clear = np.zeros((600, 800, 4), np.uint8)
    clear[:, 400:, 3] = 255
    Image.fromarray(clear).save(tmp_path / "clear.png")
    cut_out = read_photo(tmp_path / "clear.png").pixels
    assert (cut_out[0, 0, 0], cut_out[0, 700, 0]) == (255, 0)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.fromarray(clear[..., :3]).save(tmp_path / "turned.jpg", exif=exif)
    assert read_photo(tmp_path / "turned.jpg").size == (600, 800)
    (tmp_path / "phone.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(200))
    with pytest.raises(UserError, match="convert a HEIC first"):
        read_photo(tmp_path / "phone.heic")


def test_points_correct_the_outline(tmp_path: Path):
    path = photo_of(tmp_path, spanner())
    points = tmp_path / "points.yaml"
    # In the sheet's coordinates (mm): close the ring and cut off the jaw.
    points.write_text(
        "- add: [[75, 85], [105, 85], [105, 115], [75, 115]]\n"
        "- remove: [[190, 50], [250, 50], [250, 150], [190, 150]]\n"
    )
    (tool,) = traced(path, points=points).tools
    assert tool.holes == 0
    assert tool.size_mm[0] < 125
    points.write_text("- widen: [[1, 2]]\n")
    with pytest.raises(UserError, match="item 1 must have one of the keys add, remove, sheet"):
        traced(path, points=points)


@pytest.mark.slow
def test_an_outline_that_may_be_wrong_is_in_doubt_until_its_user_settles_it(tmp_path: Path):
    # The steel is as bright as the shadow beside it.
    pale = PlacedTool(SPANNER.translate((90, 100)), 14, ("steel", "steel"))
    path = photo_of(tmp_path, pale, shadow=0.5, light=(0.9, -0.9), softness=0.2, seed=2)
    # A correction in another part of the photo leaves this outline doubtful.
    points = tmp_path / "points.yaml"
    points.write_text("- remove: [[0, 0], [297, 0], [297, 60], [0, 60]]\n")
    (tool,) = traced(path, points=points).tools
    assert tool.doubts
    places = [item.place for item in tool.doubts]
    silhouette = SPANNER.translate((90, 100)).offset(25.0)
    for x, y in places:
        assert not (silhouette ^ CrossSection.square((1, 1)).translate((x, y))).is_empty()
    record = json.loads((tmp_path / "out/trace.json").read_text())
    assert len(record["tools"][0]["doubts"]) == len(places)
    points.write_text("- add: [[60, 70], [240, 70], [240, 130], [60, 130]]\n")
    assert not traced(path, points=points).tools[0].doubts


def test_close_neighbours_may_be_one_tool_until_their_gap_is_corrected(tmp_path: Path):
    bars = [
        PlacedTool(CrossSection.square((120, 20)).translate((90, y)), 8, ("red", "red"))
        for y in (80, 110)
    ]
    path = photo_of(tmp_path, *bars)
    lower, upper = traced(path, heights_mm=(8.0,), name="set").tools
    assert {lower.name, upper.name} == {"set_1", "set_2"}
    (gap,) = upper.doubts
    assert gap.place == pytest.approx((150, 105), abs=3)
    assert [item.place for item in lower.doubts] == [gap.place]
    points = tmp_path / "points.yaml"
    points.write_text("- remove: [[80, 103], [220, 103], [220, 107], [80, 107]]\n")
    assert not any(tool.doubts for tool in traced(path, heights_mm=(8.0,), points=points).tools)


@pytest.mark.slow
@pytest.mark.parametrize("by", ["points", "coin"])
def test_two_points_or_a_coin_give_the_scale_without_a_sheet(by: str, tmp_path: Path):
    coin = PlacedTool(CrossSection.circle(12.875, 200).translate((380, 280)), 2.0, ("red", "red"))
    path = photo_of(tmp_path, spanner(x=280, y=330), coin, sheet=(700.0, 600.0), distance=400.0)
    if by == "coin":
        (tool,) = traced(path, heights_mm=(12.0,), scale=Scale(disc_mm=25.75)).tools
        assert np.median(outline_errors(tool.outline, SPANNER)) < 0.4
        return
    # The photo's scale: a 26 mm lens on full frame (diagonal 43.27 mm), 400 mm away.
    px_per_mm = 26 / math.hypot(36, 24) * math.hypot(*SMALL) / 400
    scale = Scale(points=(100.0, 100.0, 100.0 + 50 * px_per_mm, 100.0), length_mm=50.0)
    tools = traced(path, heights_mm=(12.0, 2.0), scale=scale).tools
    assert np.median(outline_errors(tools[0].outline, SPANNER)) < 0.4


def test_a_camera_height_overrules_the_focal_length(tmp_path: Path):
    photo = Photo(tmp_path / "photo.jpg", np.zeros((600, 800, 3), np.uint8), 26.0)
    scale = Scale(points=(0.0, 0.0, 300.0, 0.0), length_mm=100.0)
    by_lens = plane_of_scale(cv2, photo, scale, None)
    assert any("26 mm" in note and "EXIF" in note for note in by_lens.notes)
    given = plane_of_scale(cv2, photo, scale, 500.0)
    assert given.view.camera[2] == pytest.approx(500.0)
    assert not any("EXIF" in note for note in given.notes)
    assert any("500 mm above the" in note for note in given.notes)


def test_a_coin_or_a_board_gives_the_scale(tmp_path: Path):
    """Both photos are taken from straight above, at 5 pixels per millimetre."""
    pixels = np.full((900, 1200, 3), 60, np.uint8)
    cv2.circle(pixels, (300, 400), 100, (180, 40, 40), -1, cv2.LINE_AA)
    photo = Photo(tmp_path / "photo.jpg", pixels, 26.0)
    found = plane_of_scale(cv2, photo, Scale(disc_mm=40.0), 500.0)
    ends = found.view.to_plane(np.array([[200.0, 400.0], [400.0, 400.0]]))
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(40, abs=0.3)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 5), 20.0, 15.0, dictionary)
    pixels = np.full((900, 1200, 3), 255, np.uint8)
    pixels[200:700, 250:950] = board.generateImage((700, 500))[..., None]
    photo = Photo(tmp_path / "photo.jpg", pixels, 26.0)
    found = plane_of_scale(cv2, photo, Scale(board=(7, 5, 20.0, 15.0)), 500.0)
    ends = found.view.to_plane(np.array([[250.0, 200.0], [950.0, 200.0]]))
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(140, abs=0.5)
    with pytest.raises(UserError, match="corners of the board"):
        plane_of_scale(
            *(cv2, photo, Scale(board=(7, 5, 20.0, 15.0), dictionary="DICT_6X6_50"), None)
        )


@pytest.mark.slow
def test_a_board_gives_the_scale_and_the_pose(tmp_path: Path):
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 5), 20.0, 15.0, dictionary)
    printed = PlacedPrint(board.generateImage((1120, 800)), (230.0, 330.0), (140.0, 100.0))
    path = photo_of(
        *(tmp_path, spanner(x=300, y=270)),
        sheet=(700.0, 600.0),
        tilt=15.0,
        azimuth=70.0,
        shadow=0.3,
        printed=printed,
    )
    report = traced(path, heights_mm=(12.0,), scale=Scale(board=(7, 5, 20.0, 15.0)))
    (tool,) = report.tools
    assert np.median(outline_errors(tool.outline, SPANNER)) < 0.4
