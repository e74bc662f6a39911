"""Writes the files of a trace: outlines as SVG and DXF in millimetres, and a picture.

The picture shows the photo from above, silhouettes, outlines, rulers and a scale bar.
"""

from typing import Any

import numpy as np
from manifold3d import CrossSection
from numpy.typing import NDArray

from kitting_drake.hkd.fabrication.closed_lines import add_layer, new_dxf, svg_path, text_of
from kitting_drake.hkd.tracing.plane_view import RectifiedPhoto

_MARGIN_MM = 5.0


def _loops(outline: CrossSection) -> list[NDArray[np.float64]]:
    return [np.asarray(loop, float) for loop in outline.to_polygons()]


def outlines_svg(outlines: dict[str, CrossSection]) -> str:
    """Draws outlines in mm as an SVG in units of 1 mm, with one path for each outline and its
    holes."""
    bounds = np.array([outline.bounds() for outline in outlines.values()])
    low, high = bounds[:, :2].min(axis=0) - _MARGIN_MM, bounds[:, 2:].max(axis=0) + _MARGIN_MM
    width, height = high - low
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" version="1.1" width="{width:.4f}mm" '
        f'height="{height:.4f}mm" viewBox="0 0 {width:.4f} {height:.4f}">',
        "  <desc>1 unit is 1 mm.</desc>",
    ]
    for name, outline in outlines.items():
        path = " ".join(
            svg_path(np.column_stack([loop[:, 0] - low[0], high[1] - loop[:, 1]]))
            for loop in _loops(outline)
        )
        lines.append(
            f'  <path id="{name}" fill="#0b5fa5" fill-opacity="0.12" fill-rule="evenodd" '
            f'stroke="#0b5fa5" stroke-width="0.1" d="{path}"/>'
        )
    return "\n".join([*lines, "</svg>", ""])


def outlines_dxf(outlines: dict[str, CrossSection]) -> str:
    """Draws outlines as a DXF of release 2010 in mm, with closed polylines on one layer per
    outline.

    Raises:
        MachineError: ezdxf is not installed.
    """
    document = new_dxf()
    for name, outline in outlines.items():
        add_layer(document, name.upper(), 5, _loops(outline))
    return text_of(document)


_LONG_SIDE = 1500
_SILHOUETTE, _OUTLINE, _INK = (255, 0, 200), (0, 150, 60), (20, 20, 20)
_DOUBT, _DOUBT_PX = (230, 20, 20), 28
_EDGE = 46
"""The width of the rulers, in pixels."""
_BAR_MM = 50


def trace_png(
    cv2: Any,
    photo: RectifiedPhoto,
    silhouette: CrossSection,
    outlines: dict[str, CrossSection],
    doubts: list[tuple[float, float]],
    caption: str,
) -> bytes:
    """Draws the picture of a trace as a PNG.

    The rulers along its sides show the coordinates in mm that the file of `--points` uses.

    Args:
        cv2: OpenCV.
        photo: the plane from above.
        silhouette: the part of the plane that the tools hide, in mm.
        outlines: the outline of each tool by its name, in mm.
        doubts: places, in mm, where an outline may be wrong.
        caption: a line above the picture.
    """
    scale = _LONG_SIDE / max(photo.shape)
    resized = cv2.resize(photo.pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    image = cv2.copyMakeBorder(
        resized, 2 * _EDGE, _EDGE, _EDGE, 8, cv2.BORDER_CONSTANT, value=(255, 255, 255)
    )

    def place(points: Any) -> NDArray[np.float64]:
        return (photo.to_px(np.asarray(points)) + 0.5) * scale - 0.5 + (_EDGE, 2 * _EDGE)

    def draw(area: CrossSection, colour: tuple[int, int, int]) -> None:
        for loop in area.to_polygons():
            line = np.round(16 * place(loop)).astype(np.int32)
            cv2.polylines(image, [line], True, colour, 1, cv2.LINE_AA, 4)

    def write(text: str, where: tuple[int, int], size: float = 0.45) -> None:
        cv2.putText(image, text, where, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)

    draw(silhouette, _SILHOUETTE)
    for name, outline in outlines.items():
        draw(outline, _OUTLINE)
        x_low, _, _, y_high = outline.bounds()
        u, v = np.round(place([(x_low, y_high)])[0]).astype(int).tolist()
        write(name, (u, v - 6), 0.55)
    for point in doubts:
        u, v = np.round(place([point])[0]).astype(int).tolist()
        cv2.circle(image, (u, v), _DOUBT_PX, _DOUBT, 3, cv2.LINE_AA)
    _draw_rulers(cv2, image, photo, place, write)
    bottom = image.shape[0] - _EDGE - 16
    start, end = place([(photo.low[0] + 10, 0), (photo.low[0] + 10 + _BAR_MM, 0)])[:, 0]
    start, end = round(float(start)), round(float(end))
    cv2.rectangle(image, (start - 6, bottom - 22), (end + 6, bottom + 10), (255, 255, 255), -1)
    cv2.rectangle(image, (start, bottom), (end, bottom + 5), _INK, -1)
    write(f"{_BAR_MM} mm", (start, bottom - 6), 0.5)
    write(caption, (_EDGE, 24), 0.55)
    legend = "pink: the edge seen in the photo; green: the outline"
    write(legend + ("; red: not clear" if doubts else ""), (_EDGE, 48), 0.5)
    _, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return data.tobytes()


def _draw_rulers(cv2: Any, image: Any, photo: RectifiedPhoto, place: Any, write: Any) -> None:
    bottom = image.shape[0] - _EDGE
    low, high = np.ceil(photo.low / 10) * 10, photo.high
    for x in np.arange(low[0], high[0], 10):
        u = round(float(place([(x, photo.low[1])])[0, 0]))
        long = x % 50 == 0
        cv2.line(image, (u, bottom), (u, bottom + (10 if long else 5)), _INK, 1)
        if long:
            write(f"{x:.0f}", (u - 10, bottom + 26))
    for y in np.arange(low[1], high[1], 10):
        v = round(float(place([(photo.low[0], y)])[0, 1]))
        long = y % 50 == 0
        cv2.line(image, (_EDGE - (10 if long else 5), v), (_EDGE, v), _INK, 1)
        if long:
            write(f"{y:.0f}", (4, v + 4))
