import itertools
from collections.abc import Callable
from pathlib import Path

import ezdxf
import numpy as np
import pytest
from ezdxf.layouts import BaseLayout

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.outline import read_drawing

# A slot of 160 x 20 mm with a hole of 8 mm.
AREA = 140 * 20 + np.pi * (100 - 16)


def slot(space: BaseLayout, scale: float = 1.0, **attributes: object) -> None:
    k = scale
    space.add_line((0, 0), (140 * k, 0), attributes)
    space.add_arc((140 * k, 10 * k), 10 * k, -90, 90, dxfattribs=attributes)
    space.add_line((140 * k, 20 * k), (0, 20 * k), attributes)
    space.add_arc((0, 10 * k), 10 * k, 90, 270, dxfattribs=attributes)
    space.add_circle((0, 10 * k), 4 * k, attributes)


def twice(space: BaseLayout) -> None:
    slot(space)
    slot(space, layer="copy")


def twice_backwards(space: BaseLayout) -> None:
    slot(space)
    space.add_line((140, 0), (0, 0))
    space.add_line((0, 20), (140, 20))


def in_pieces(space: BaseLayout) -> None:
    """The slot, and four pieces of it drawn a second time. Two of the pieces are 0.01 mm off."""
    slot(space)
    space.add_line((0, 0.01), (70, 0.01))
    space.add_line((70, 0.01), (140, 0.01))
    space.add_arc((140, 10), 10, -90, 0)
    space.add_lwpolyline([(140, 20), (60, 20)])


def as_polyline_too(space: BaseLayout) -> None:
    slot(space)
    space.add_lwpolyline([(0, 0, 0), (140, 0, 1), (140, 20, 0), (0, 20, 1)], "xyb", close=True)


def on_a_sheet(space: BaseLayout) -> None:
    slot(space)
    space.add_lwpolyline([(-50, -50), (247, -50), (247, 160), (-50, 160)], close=True)


def with_unplotted_layers(space: BaseLayout) -> None:
    slot(space)
    layer = space.doc.layers.add("help")
    layer.dxf.plot = 0
    for name in ("help", "Defpoints"):
        space.add_lwpolyline(
            [(-30, -9), (190, -9), (190, 30), (-30, 30)], close=True, dxfattribs={"layer": name}
        )


def in_short_pieces(space: BaseLayout) -> None:
    """The arcs consist of lines that are shorter than the gaps that the reader closes."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, 400)
    for start, x in ((0, 140), (np.pi, 0)):
        arc = np.c_[x + 10 * np.cos(turn + start), 10 + 10 * np.sin(turn + start)]
        for a, b in itertools.pairwise(arc):
            space.add_line(tuple(a), tuple(b))
    space.add_line((0, 0), (140, 0))
    space.add_line((0, 20), (140, 20))
    space.add_circle((0, 10), 4)


def overshooting(space: BaseLayout) -> None:
    """The ends of lines and arcs cross each other, or stop short."""
    space.add_line((0.03, 0), (140, 0))
    space.add_arc((140, 10), 10, -89.9, 90.1)
    space.add_line((140, 20), (0, 20.03))
    space.add_arc((0, 10), 10, 90, 270)
    space.add_circle((0, 10), 4)


def with_a_layout(space: BaseLayout) -> None:
    slot(space)
    space.doc.layout("Layout1").add_lwpolyline([(0, 0), (297, 0), (297, 210)], close=True)


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        (slot, None),
        (twice, "drawn twice"),
        (twice_backwards, "left out 2 curves that are drawn twice"),
        (in_pieces, "left out 4 curves that are drawn twice"),
        (as_polyline_too, "drawn twice"),
        (on_a_sheet, "A4"),
        (with_unplotted_layers, "2 entities that are hidden or not plotted"),
        (with_a_layout, None),
        (in_short_pieces, None),
        (overshooting, None),
    ],
)
def test_the_outline_is_what_is_plotted_once(
    draw: Callable[[BaseLayout], None], said: str | None, tmp_path: Path
):
    document = ezdxf.new("R12" if draw in (twice, twice_backwards) else "R2018", units=4)
    draw(document.modelspace())
    document.saveas(tmp_path / "tool.dxf")
    drawing = read_drawing(tmp_path / "tool.dxf")
    assert drawing.outline.area() == pytest.approx(AREA, rel=2e-3)
    assert said is None or said in " ".join(drawing.notes)


@pytest.mark.parametrize(
    ("units", "scale", "said"),
    [
        (4, 1, "millimeters"),
        (5, 0.1, "cent"),
        (1, 1 / 25.4, "inches"),
        (6, 0.001, "meters"),
        (9, 1000 / 25.4, "mils"),
        (13, 1000, "microns"),
    ],
)
def test_a_drawing_has_the_unit_that_it_names(units: int, scale: float, said: str, tmp_path: Path):
    document = ezdxf.new(units=units)
    slot(document.modelspace(), scale)
    document.saveas(tmp_path / "tool.dxf")
    drawing = read_drawing(tmp_path / "tool.dxf")
    assert drawing.outline.area() == pytest.approx(AREA, rel=2e-3)
    assert said in drawing.measured


@pytest.mark.parametrize("header", ["", "  0\nSECTION\n  2\nHEADER\n  0\nENDSEC\n"])
def test_a_drawing_without_a_unit_is_in_mm_or_as_asked(header: str, tmp_path: Path):
    corners = [(0, 0), (160, 0), (160, 20), (0, 20)]
    lines = "".join(
        f"  0\nLINE\n  8\n0\n 10\n{a[0]}\n 20\n{a[1]}\n 11\n{b[0]}\n 21\n{b[1]}\n"
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
    )
    path = tmp_path / "tool.dxf"
    path.write_text(f"{header}  0\nSECTION\n  2\nENTITIES\n{lines}  0\nENDSEC\n  0\nEOF\n")
    drawing = read_drawing(path)
    assert drawing.outline.bounds() == pytest.approx((0, 0, 160, 20), abs=1e-6)
    assert "because the file states no unit" in drawing.measured
    assert read_drawing(path, 25.4).outline.area() == pytest.approx(25.4**2 * 3200, rel=1e-6)


def test_a_missing_end_is_not_a_missing_part(tmp_path: Path):
    whole = box(tmp_path / "tool.dxf", 1.0, 1).read_text()
    # One file lacks the end mark; the other has DOS's end-of-file byte after it.
    for text in ("999\nby a program\n" + whole.removesuffix("0\nEOF\n"), whole + "\x1a"):
        (tmp_path / "tool.dxf").write_text(text)
        assert read_drawing(tmp_path / "tool.dxf").outline.area() == pytest.approx(3200, rel=1e-3)
    (tmp_path / "tool.dxf").write_text(whole[: -len("0\nENDSEC\n0\nEOF\n")])
    with pytest.raises(UserError, match="cut short"):
        read_drawing(tmp_path / "tool.dxf")


def test_a_smoothed_polyline_is_its_curve_not_its_control_points(tmp_path: Path):
    document = ezdxf.new("R12")
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ellipse = np.c_[80 * np.cos(turn), 10 * np.sin(turn)]
    line = document.modelspace().add_polyline2d([*(1.5 * ellipse[::8]), *ellipse], close=True)
    line.dxf.flags |= 4
    for vertex in line.vertices[:8]:
        vertex.dxf.flags |= 16
    document.saveas(tmp_path / "tool.dxf")
    drawing = read_drawing(tmp_path / "tool.dxf")
    assert drawing.outline.area() == pytest.approx(800 * np.pi, rel=5e-3)


def test_paper_space_is_named(tmp_path: Path):
    document = ezdxf.new(units=4)
    slot(document.layout("Layout1"))
    document.saveas(tmp_path / "tool.dxf")
    with pytest.raises(UserError, match=r"paper space \('Layout1'\)"):
        read_drawing(tmp_path / "tool.dxf")


def test_the_smallest_gap_is_told_with_its_place(tmp_path: Path):
    document = ezdxf.new(units=4)
    space = document.modelspace()
    space.add_lwpolyline([(0, 0), (160, 0), (160, 20)])
    space.add_lwpolyline([(160, 20.3), (0, 20.3), (0, 0)])
    document.saveas(tmp_path / "tool.dxf")
    with pytest.raises(UserError, match=r"gap of 0\.30 mm at x = 160\.0, y = 20\.[12]"):
        read_drawing(tmp_path / "tool.dxf")


def box(path: Path, scale: float, measurement: int | None = None) -> Path:
    """Writes a box of 160 x 20 mm as DXF R12 without $INSUNITS. Each long side consists of two
    overlapping lines."""
    header = "" if measurement is None else f"9\n$MEASUREMENT\n70\n{measurement}\n"
    text = f"0\nSECTION\n2\nHEADER\n{header}0\nENDSEC\n" if header else ""
    lines = [(0, 0, 0, 20), (160, 0, 160, 20)]
    lines += [line for y in (0, 20) for line in ((0, y, 100, y), (160, y, 60, y))]
    text += "0\nSECTION\n2\nENTITIES\n"
    for line in lines:
        codes = zip((10, 20, 11, 21), line, strict=True)
        text += "0\nLINE\n8\n0\n" + "".join(f"{code}\n{scale * x}\n" for code, x in codes)
    path.write_text(text + "0\nENDSEC\n0\nEOF\n")
    return path


@pytest.mark.parametrize(
    ("unit_mm", "measurement", "said"),
    [
        (1.0, None, "in mm"),
        (1.0, 0, "in mm"),
        (1.0, 1, "in mm"),
        (25.4, 0, "in inches"),
        (10.0, 1, None),
        (1000.0, None, "in m,"),
    ],
)
def test_a_drawing_that_names_no_unit_has_the_only_possible_one(
    unit_mm: float, measurement: int | None, said: str | None, tmp_path: Path
):
    path = box(tmp_path / "tool.dxf", 1 / unit_mm, measurement)
    if said is None:
        with pytest.raises(UserError, match=r"16 mm \(in mm\) or 160 mm \(in cm\)"):
            read_drawing(path)
        assert read_drawing(path, unit_mm).outline.area() == pytest.approx(3200, rel=1e-3)
        return
    drawing = read_drawing(path)
    assert drawing.outline.area() == pytest.approx(3200, rel=1e-3)
    assert said in drawing.measured


def test_inches_and_centimetres_without_a_unit_are_a_question(tmp_path: Path):
    with pytest.raises(UserError, match=r"162\.6 mm \(in inches\) or 64 mm \(in cm\)"):
        read_drawing(box(tmp_path / "tool.dxf", 0.04))
