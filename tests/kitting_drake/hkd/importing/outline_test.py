from pathlib import Path

import ezdxf
import numpy as np
import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.importer import ImportReport, ImportRequest, import_tool
from kitting_drake.hkd.importing.outline import laid_along_x, read_drawing
from kitting_drake.hkd.tools.tool import load_tool

BAR = '<rect x="5" y="10" width="160" height="20"/>'


def drawing(folder: Path, content: str, size: str = 'width="200mm" height="80mm"') -> Path:
    """Writes an SVG with this content and a viewBox of 200 by 80; returns its path."""
    path = folder / "tool.svg"
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} viewBox="0 0 200 80">{content}</svg>'
    )
    return path


def stadium(folder: Path, units: int, scale: float) -> Path:
    """Writes a DXF of a slot of 160 by 20 mm with a hole of 8 mm; returns its path.

    The slot's lines and arcs are not in the order of the contour.
    """
    document = ezdxf.new(units=units)
    space = document.modelspace()
    space.add_line((0, 0), (140 * scale, 0))
    space.add_arc((0, 10 * scale), 10 * scale, 90, 270)
    space.add_line((140 * scale, 20 * scale), (0, 20 * scale))
    space.add_circle((0, 10 * scale), 4 * scale)
    space.add_text("not an outline")
    space.add_arc((140 * scale, 10 * scale), 10 * scale, -90, 90)
    path = folder / "tool.dxf"
    document.saveas(path)
    return path


def size(path: Path) -> tuple[float, float]:
    x_min, y_min, x_max, y_max = read_drawing(path).outline.bounds()
    return x_max - x_min, y_max - y_min


@pytest.mark.parametrize(
    ("measures", "mm"),
    [
        ('width="200mm" height="80mm"', 1.0),
        ('width="10cm" height="4cm"', 0.5),
        ('width="200" height="80"', 25.4 / 96),
        ('width="200mm"', 1.0),
        ('height="80 mm"', 1.0),
        ('width="200 mm" height="80 mm"', 1.0),
        ('width="200MM" height="80MM"', 1.0),
        ('width="10cm" height="auto"', 0.5),
    ],
)
def test_an_svg_is_measured_by_its_width(measures: str, mm: float, tmp_path: Path):
    assert size(drawing(tmp_path, BAR, measures)) == pytest.approx((160 * mm, 20 * mm), rel=1e-4)


def test_an_unknown_unit_is_rejected(tmp_path: Path):
    with pytest.raises(UserError, match=r"width .*'200um'"):
        read_drawing(drawing(tmp_path, BAR, 'width="200um" height="80um"'))


@pytest.mark.parametrize(
    "unseen",
    [
        '<rect width="190" height="70" visibility="hidden"/>',
        '<rect width="190" height="70" style="visibility:hidden"/>',
        '<symbol id="s"><rect width="190" height="70"/></symbol>',
        '<g><mask id="m"><rect width="190" height="70"/></mask></g>',
        '<marker id="a"><path d="M0 0 L10 5"/></marker>',
    ],
)
def test_hidden_svg_elements_do_not_count(unseen: str, tmp_path: Path):
    assert size(drawing(tmp_path, unseen + BAR)) == pytest.approx((160, 20), rel=1e-4)


def test_a_symbol_counts_where_it_is_used(tmp_path: Path):
    used = f'<symbol id="s">{BAR}</symbol><use href="#s"/>'
    assert size(drawing(tmp_path, used)) == pytest.approx((160, 20), rel=1e-4)


def test_y_points_up_and_transforms_count(tmp_path: Path):
    # As drawn, the triangle has its right angle at the lower left.
    path = drawing(tmp_path, '<path transform="rotate(0) translate(10)" d="M0 70 h150 L0 20 z"/>')
    assert read_drawing(path).outline.bounds() == pytest.approx((10, -70, 160, -20), abs=1e-3)


@pytest.mark.parametrize(
    "transform", ["rotate(90 85 20)", "matrix(0 1 1 0 0 0)", "scale(-1 1) translate(-300)"]
)
def test_rectangles_and_ellipses_keep_their_transforms(transform: str, tmp_path: Path):
    hole = '<ellipse cx="150" cy="20" rx="6" ry="3"/>'
    outline = read_drawing(drawing(tmp_path, f'<g transform="{transform}">{BAR}{hole}</g>')).outline
    assert outline.area() == pytest.approx(160 * 20 - 18 * np.pi, rel=1e-3)


@pytest.mark.parametrize(("units", "scale"), [(4, 1.0), (1, 1 / 25.4), (5, 0.1), (0, 1.0)])
def test_a_dxf_is_measured_by_its_units_and_its_curves_are_joined(
    units: int, scale: float, tmp_path: Path
):
    outline = read_drawing(stadium(tmp_path, units, scale)).outline
    x_min, y_min, x_max, y_max = outline.bounds()
    assert (x_max - x_min, y_max - y_min) == pytest.approx((160, 20), abs=0.02)
    assert outline.area() == pytest.approx(140 * 20 + np.pi * (10**2 - 4**2), rel=1e-3)


def test_hidden_layers_and_dimensions_do_not_count(tmp_path: Path):
    path = stadium(tmp_path, 4, 1.0)
    document = ezdxf.readfile(path)
    document.layers.add("frame").freeze()
    document.layers.add("axes").off()
    space = document.modelspace()
    space.add_lwpolyline(
        [(-50, -50), (250, -50), (250, 90), (-50, 90)], close=True, dxfattribs={"layer": "FRAME"}
    )
    space.add_line((-50, 10), (250, 10), dxfattribs={"layer": "axes"})
    space.add_linear_dim(base=(0, -30), p1=(-10, 10), p2=(150, 10)).render()
    document.saveas(path)
    outline = read_drawing(path).outline
    assert outline.area() == pytest.approx(140 * 20 + np.pi * (10**2 - 4**2), rel=1e-3)


def test_splines_and_blocks_are_read(tmp_path: Path):
    document = ezdxf.new(units=4)
    block = document.blocks.new("TOOL")
    block.add_spline([(0, 0), (60, -8), (160, 0), (165, 12), (60, 14), (-8, 11), (0, 0)])
    document.modelspace().add_blockref("TOOL", (100, 0))
    document.saveas(tmp_path / "tool.dxf")
    x_min, _, x_max, _ = read_drawing(tmp_path / "tool.dxf").outline.bounds()
    assert x_min > 85
    assert 160 < x_max - x_min < 190


@pytest.mark.parametrize(
    ("content", "token"),
    [
        ('<path fill="none" stroke="red" d="M10 10 H170 V30 H10"/>', "20.00 mm"),
        (BAR + '<rect y="50" width="150" height="20"/>', "one tool"),
        ("<text>wrench</text>", "no curves"),
        ('<path d="M0 0 L160 40 V0 L0 40 z"/>', "crosses itself"),
        ('<path d="M0 0 H160 z"/>', "encloses"),
        ("<g>", "SVG"),
    ],
)
def test_an_invalid_svg_is_rejected(content: str, token: str, tmp_path: Path):
    with pytest.raises(UserError, match=token):
        read_drawing(drawing(tmp_path, content))


def test_an_invalid_dxf_is_rejected(tmp_path: Path):
    (tmp_path / "tool.dxf").write_text("no drawing")
    with pytest.raises(UserError, match="DXF"):
        read_drawing(tmp_path / "tool.dxf")
    with pytest.raises(UserError, match=r"none\.dxf"):
        read_drawing(tmp_path / "none.dxf")


def bring(path: Path, **options: float) -> ImportReport:
    request = ImportRequest(path, "bar", output=path.parent / "tools", **options)
    return import_tool(request, time_limit=None)


@pytest.mark.slow
def test_an_outline_becomes_a_tool_of_its_size(tmp_path: Path):
    path = drawing(tmp_path, '<rect width="110" height="14"/><circle cx="8" cy="7" r="3"/>')
    tool = load_tool(str(bring(path, height_mm=12.0).directory))
    # An imported mesh of 110 mm is scaled to its category's length; an outline keeps its size.
    assert (tool.length, tool.width, tool.height) == pytest.approx((0.110, 0.014, 0.012), abs=2e-5)
    assert tool.footprint.area() == pytest.approx(1e-6 * (110 * 14 - 9 * np.pi), rel=1e-2)


@pytest.mark.slow
def test_an_outline_may_be_higher_than_wide(tmp_path: Path):
    path = drawing(tmp_path, '<rect width="150" height="10"/>')
    tool = load_tool(str(bring(path, height_mm=20.0).directory))
    assert (tool.length, tool.width, tool.height) == pytest.approx((0.150, 0.010, 0.020), abs=2e-5)


def test_an_outline_must_be_stable_as_drawn(tmp_path: Path):
    path = drawing(tmp_path, '<rect width="150" height="4"/>')
    with pytest.raises(UserError, match="40 mm high"):
        bring(path, height_mm=40.0)


def test_the_length_does_not_depend_on_the_drawings_rotation(tmp_path: Path):
    # The rotated rectangle's bounding box is 123 mm wide.
    path = drawing(tmp_path, '<rect transform="rotate(45)" width="160" height="14"/>')
    x_min, y_min, x_max, y_max = laid_along_x(read_drawing(path).outline, None, "tool.svg").bounds()
    assert (x_max - x_min, y_max - y_min) == pytest.approx((160, 14), abs=0.05)
    tool = load_tool(str(bring(path, height_mm=12.0, length_mm=100.0).directory))
    expected = (0.100, 0.014 * 100 / 160, 0.012)
    assert (tool.length, tool.width, tool.height) == pytest.approx(expected, abs=5e-5)
    with pytest.raises(UserError, match="9 mm"):
        bring(drawing(tmp_path, '<rect width="9" height="5"/>'), height_mm=12.0)


def test_a_scaled_drawing_still_asks_whether_its_rectangle_is_a_frame(tmp_path: Path):
    # The frame is 950 units long, which is only 190 mm, so it could be a tool.
    path = tmp_path / "tool.svg"
    path.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="200mm" viewBox="0 0 1000 400">'
        '<path d="M25 25h950v300h-950z" fill="none" stroke="#000"/>'
        '<path d="M100 100h800v100h-800z"/></svg>'
    )
    with pytest.raises(UserError, match="--frame page"):
        bring(path, height_mm=12.0, length_mm=150.0)


def test_outlines_need_a_height_and_meshes_must_not_have_one(tmp_path: Path):
    path = drawing(tmp_path, BAR)
    with pytest.raises(UserError, match="--height_mm"):
        bring(path)
    with pytest.raises(UserError, match="--height_mm 60"):
        bring(path, height_mm=60.0)
    with pytest.raises(UserError, match="--height_mm"):
        bring(tmp_path / "tool.stl", height_mm=10.0)
    assert not (tmp_path / "tools").exists()
