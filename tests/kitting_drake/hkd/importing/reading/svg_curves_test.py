from pathlib import Path

import numpy as np
import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.importing.outline import read_drawing

INKSCAPE = 'xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" inkscape:version='
ILLUSTRATOR = "<!-- Generator: Adobe Illustrator 24.0.1, SVG Export Plug-In -->"
# A bar of 160 x 20 mm with a hole of 8 mm.
AREA = 160 * 20 - 16 * np.pi


def bar(unit_mm: float = 1.0, attributes: str = "", x: float = 20.0) -> str:
    k = 1 / unit_mm
    return (
        f'<g {attributes} transform="scale({k})">'
        f'<rect x="{x}" y="10" width="160" height="20"/><circle cx="{x + 10}" cy="20" r="4"/></g>'
    )


def svg(content: str, root: str, before: str = "") -> str:
    return f'{before}<svg xmlns="http://www.w3.org/2000/svg" {root}>{content}</svg>'


MM = 'width="200mm" height="60mm" viewBox="0 0 200 60"'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (svg(bar(), MM), "width and height"),
        (svg(bar(25.4 / 96), 'width="756" height="227"'), "no unit"),
        (
            svg(bar(25.4 / 72), 'width="567px" height="170px" viewBox="0 0 567 170"', ILLUSTRATOR),
            "A",
        ),
        (svg(bar(25.4 / 72), 'viewBox="0 0 567 170"', ILLUSTRATOR), "Adobe Illustrator"),
        (svg(bar(25.4 / 72), 'id="Layer_1" data-name="Layer 1" viewBox="0 0 567 170"'), "1/72"),
        (svg(bar(25.4 / 90), f'{INKSCAPE}"0.48.5 r10040" width="744" height="1052"'), "Inkscape"),
        (svg(bar(25.4 / 90), f'{INKSCAPE}"0.91" width="210mm" height="297mm"'), "1/90"),
        (svg(bar(), f'{INKSCAPE}"0.91" {MM}'), "width and height"),
        (svg(bar(), f'{INKSCAPE}"1.3.2 (091e20e)" {MM}'), "width and height"),
        (svg(bar(25.4 / 96), f'{INKSCAPE}"0.92.4" width="756" height="227"'), "1/96"),
        (svg(bar(), 'width="100%" height="100%" viewBox="0 0 297 210"'), "A4"),
        (svg(bar(25.4 / 300), 'width="100%" viewBox="0 0 2480 3508"'), "A4"),
        (svg(bar(25.4 / 72), 'viewBox="0 0 612 792"'), "Letter"),
        (svg(bar(25.4 / 72), 'width="595" height="842"'), "A4 in units of 1/72 inch"),
        (svg(bar(25.4 / 90), 'width="744.09" height="1052.36" viewBox="0 0 744.09 1052.36"'), "A4"),
        (svg(bar(25.4), 'width="8in" height="2.4in" viewBox="0 0 8 2.4"'), "width and height"),
        # The program rounded the viewBox up to whole units of 1/72 inch.
        (svg(bar(25.4 / 72), 'width="200mm" height="60mm" viewBox="0 0 567 171"'), "width and"),
        (svg(bar(), 'style="width:200mm;height:60mm" viewBox="0 0 200 60"'), "width and height"),
    ],
)
def test_a_drawing_has_the_size_that_its_program_meant(text: str, said: str, tmp_path: Path):
    (tmp_path / "tool.svg").write_text(text)
    drawing = read_drawing(tmp_path / "tool.svg")
    assert drawing.outline.area() == pytest.approx(AREA, rel=2e-3)
    assert said in drawing.measured
    assert not drawing.notes


@pytest.mark.parametrize("root", ["", 'width="100%" height="100%"', 'height="auto"'])
def test_a_drawing_without_a_size_is_refused(root: str, tmp_path: Path):
    path = tmp_path / "tool.svg"
    path.write_text(svg(bar(), f'{root} viewBox="0 0 200 60"'))
    with pytest.raises(
        UserError, match=r"200 mm if a unit is 1 mm, 71 mm .*1/72 inch, 53 mm .*1/96"
    ) as error:
        read_drawing(path)
    assert "--unit" in str(error.value)
    assert read_drawing(path, 1.0).outline.area() == pytest.approx(AREA, rel=2e-3)


@pytest.mark.parametrize(
    ("root", "before", "sizes"),
    [
        # Inkscape 1.2 saved a page from Inkscape 0.91; Illustrator saved a page from Inkscape.
        (f'{INKSCAPE}"1.2" width="744.09" height="1052.36"', "", "278 mm, .* or 297 mm"),
        ('width="793.7" height="1122.52"', ILLUSTRATOR, "396 mm, .* or 297 mm"),
    ],
)
def test_a_page_that_contradicts_its_writer_is_a_question(
    root: str, before: str, sizes: str, tmp_path: Path
):
    path = tmp_path / "tool.svg"
    path.write_text(svg(bar(25.4 / 90), root, before))
    with pytest.raises(UserError, match=sizes):
        read_drawing(path)


def test_a_frame_around_a_tool_with_a_hole_is_left_out(tmp_path: Path):
    frame = '<rect x="5" y="5" width="190" height="50" fill="none" stroke="#000"/>'
    unseen = '<rect x="1" y="1" width="150" height="55" opacity="0"/>'
    (tmp_path / "tool.svg").write_text(svg(frame + unseen + bar(), MM))
    drawing = read_drawing(tmp_path / "tool.svg")
    assert drawing.outline.area() == pytest.approx(AREA, rel=2e-3)
    assert "190 x 50 mm, a frame" in drawing.notes[0]


PAGE = '<rect width="200" height="60" fill="#fff"/>'


@pytest.mark.parametrize(
    ("around", "said"),
    [
        (PAGE, "200 x 60 mm, the page"),
        ('<rect width="100%" height="100%" fill="white"/>', "the page"),
        ('<path d="M0 0H200V60H0z"/>', "the page"),
        ('<rect x="5" y="3" width="190" height="54" fill="none" stroke="#000"/>', "190 x 54"),
        (PAGE + '<rect x="5" y="3" width="190" height="54" fill="none" stroke="#000"/>', "page"),
        ('<rect x="-50" y="-50" width="297" height="210"/>', "A4"),
        ('<rect x="-90" y="-90" width="380" height="380"/>', "frame"),
        ('<rect width="190" height="50" fill="none" stroke="none"/>', None),
        ('<rect width="190" height="50" fill-opacity="0" stroke="none"/>', None),
        ('<g style="display:none"><rect width="190" height="50"/></g>', None),
    ],
)
def test_a_page_or_frame_is_not_the_tool(around: str, said: str | None, tmp_path: Path):
    (tmp_path / "tool.svg").write_text(svg(around + bar(), MM))
    drawing = read_drawing(tmp_path / "tool.svg")
    assert drawing.outline.area() == pytest.approx(AREA, rel=2e-3)
    assert said is None or said in drawing.notes[0]


@pytest.mark.parametrize("page", ['width="160mm" height="20mm" viewBox="0 10 160 20"', MM])
def test_a_rectangular_tool_with_a_hole_is_not_a_page(page: str, tmp_path: Path):
    (tmp_path / "tool.svg").write_text(svg(bar(x=0.0), page))
    drawing = read_drawing(tmp_path / "tool.svg")
    assert drawing.outline.area() == pytest.approx(AREA, rel=2e-3)


def test_filled_paths_are_closed_and_thick_lines_are_not_holes(tmp_path: Path):
    path = tmp_path / "tool.svg"
    path.write_text(svg('<path d="M20 10 H180 V30 H20"/>', MM))
    drawing = read_drawing(path)
    assert drawing.outline.area() == pytest.approx(160 * 20, rel=1e-4)
    assert "20.00 mm" in drawing.notes[0]
    # The outline's stroke was converted to a filled path.
    path.write_text(svg('<path d="M20 10H180V30H20z M21 11V29H179V11z"/>', MM))
    drawing = read_drawing(path)
    assert drawing.outline.area() == pytest.approx(160 * 20, rel=1e-4)
    assert "thick line" in drawing.notes[0]


def test_what_is_clipped_counts_and_is_said(tmp_path: Path):
    clipped = '<clipPath id="c"><rect width="90" height="60"/></clipPath>'
    path = tmp_path / "clipped.svg"
    path.write_text(svg(f'{clipped}<g clip-path="url(#c)">{bar()}</g>', MM))
    drawing = read_drawing(path)
    assert any("clipping" in note for note in drawing.notes)


def test_the_smallest_gap_is_told_with_its_place(tmp_path: Path):
    path = tmp_path / "tool.svg"
    lines = "M20 10 H180 V30 M180 30.3 V30.3 H20 V10"
    path.write_text(svg(f'<path fill="none" stroke="#000" d="{lines}"/>', MM))
    with pytest.raises(UserError, match=r"gap of 0\.30 mm at x = 180\.0, y = 30\.[12]"):
        read_drawing(path)


LINE = 'fill="none" stroke="#000"'
SOLID = '<path fill="#333" d="M20 20h160v20h-160z"/>'


@pytest.mark.parametrize(
    "content",
    [
        # The tool has no holes. The frame around it has sharp corners, has round corners, is as
        # large as the page, or is part of the tool's path.
        f'<rect x="5" y="5" width="190" height="50" {LINE}/>' + SOLID,
        f'<rect x="5" y="5" width="190" height="50" rx="8" {LINE}/>' + SOLID,
        f'<rect width="200" height="60" {LINE}/><path {LINE} d="M20 20h160v20h-160z"/>',
        f'<path {LINE} d="M5 5h190v50h-190z M20 20h160v20h-160z"/>',
    ],
)
def test_a_frame_that_may_be_the_tool_is_a_question(content: str, tmp_path: Path):
    path = tmp_path / "tool.svg"
    path.write_text(svg(content, MM))
    with pytest.raises(UserError, match=r"around a curve of 160 x 20 mm.*--frame page"):
        read_drawing(path)
    drawing = read_drawing(path, frame="page")
    assert drawing.outline.area() == pytest.approx(160 * 20, rel=1e-3)
    assert "left out a rectangle" in drawing.notes[0]
    assert read_drawing(path, frame="tool").outline.num_contour() == 2


@pytest.mark.parametrize(
    "plate",
    [
        # The hole is part of a filled path, is round, or is small.
        '<path fill-rule="evenodd" d="M20 10h120v40h-120z M40 20h80v20h-80z"/>',
        f'<rect x="20" y="10" width="120" height="40" {LINE}/><circle cx="80" cy="30" r="16"/>',
        '<rect x="20" y="10" width="120" height="40"/><rect x="60" y="25" width="20" height="6"/>',
    ],
)
def test_a_plate_with_a_hole_is_the_tool(plate: str, tmp_path: Path):
    (tmp_path / "tool.svg").write_text(svg(plate, MM))
    drawing = read_drawing(tmp_path / "tool.svg")
    assert drawing.outline.bounds() == pytest.approx((20, -50, 140, -10), abs=0.01)
    assert drawing.outline.num_contour() == 2
    assert drawing.notes == []
