import io
import itertools
import json
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import ezdxf
import numpy as np
import pytest

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.fabrication.export import export_kit
from kitting_drake.hkd.fabrication.foam_sheet import (
    FoamSheet,
    SheetKit,
    fill_sheet,
    moved,
    sheet_dxf,
    sheet_layers,
    sheet_svg,
)
from kitting_drake.hkd.fabrication.kit_request import KitRequest, SheetRequest

L_SHAPE = np.array([(5, 5), (30, 5), (30, 10), (10, 10), (10, 20), (5, 20)], dtype=float)


def kit(name: str, length: float, width: float, height: float = 50.0) -> SheetKit:
    block = np.array([(0, 0), (length, 0), (length, width), (0, width)], dtype=float)
    layers = {"BLOCK": [block], "CAVITIES_17.00_MM_DEEP": [L_SHAPE]}
    return SheetKit(name, (length, width), height, layers)


def boxes(sheet: FoamSheet) -> np.ndarray:
    corners = []
    for place in sheet.places:
        a, b = moved(np.array([[0.0, 0.0], sheet.kits[place.kit].size]), place, sheet)
        corners.append([*np.minimum(a, b), *np.maximum(a, b)])
    return np.array(corners)


def assert_apart(sheet: FoamSheet) -> None:
    found = boxes(sheet)
    assert (found[:, :2] >= sheet.margin - 1e-6).all()
    assert (found[:, 2:] <= np.array(sheet.size) - sheet.margin + 1e-6).all()
    for a, b in itertools.combinations(found, 2):
        gaps = np.maximum(a[:2] - b[2:], b[:2] - a[2:])
        assert gaps.max() >= sheet.gap - 1e-6


@pytest.mark.parametrize(
    ("size", "kit_size", "count"),
    [
        ((600.0, 400.0), (190.0, 120.0), 10),
        # Two columns of upright kits and one of turned kits hold more than columns of one kind.
        ((100.0, 60.0), (30.0, 20.0), 10),
        # Four kits fit only if they are arranged like a pinwheel.
        ((50.0, 50.0), (30.0, 20.0), 4),
    ],
)
def test_as_many_kits_as_fit(size: tuple[float, float], kit_size: tuple[float, float], count: int):
    sheet = fill_sheet(size, 0.0, 0.0, [kit("one", *kit_size)], None)
    assert len(sheet.places) == count
    assert_apart(sheet)
    assert not sheet.notes


def test_margins_gaps_and_several_kits():
    kits = [kit("small", 60.0, 40.0), kit("large", 200.0, 120.0)]
    sheet = fill_sheet((400.0, 300.0), 10.0, 5.0, kits, None)
    assert_apart(sheet)
    assert {place.kit for place in sheet.places} == {0, 1}
    assert len(sheet.places) > 6


def test_what_finds_no_room_is_said():
    kits = [kit("small", 60.0, 40.0), kit("large", 200.0, 120.0, 40.0)]
    sheet = fill_sheet((250.0, 200.0), 10.0, 5.0, kits, 3)
    counts = [sum(place.kit == index for place in sheet.places) for index in (0, 1)]
    assert counts == [3, 1]
    assert sheet.notes[0] == "2 of 3 copies of 'large' find no room on the sheet"
    assert "different heights: 40 and 50 mm" in sheet.notes[1]
    with pytest.raises(UserError, match="'large' of 200 by 120 mm does not fit"):
        fill_sheet((210.0, 150.0), 10.0, 5.0, kits, None)


def test_drawings_have_each_outline_at_its_place():
    sheet = fill_sheet((112.0, 60.0), 2.0, 1.0, [kit("one", 40.0, 25.0)], None)
    assert any(place.turned for place in sheet.places)
    layers = sheet_layers(sheet)
    assert len(layers["BLOCK"]) == len(layers["CAVITIES_17.00_MM_DEEP"]) == len(sheet.places)
    for outline in layers["CAVITIES_17.00_MM_DEEP"]:
        x, y = outline.T
        area = (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
        # The area is positive: outlines are turned, but never mirrored.
        assert area == pytest.approx(175.0)
    document = ezdxf.read(io.StringIO(sheet_dxf(sheet)))
    assert not document.audit().errors
    drawn = list(document.modelspace().query("LWPOLYLINE"))
    assert all(line.closed for line in drawn)
    assert {line.dxf.layer for line in drawn} == set(layers)
    svg = ElementTree.fromstring(sheet_svg(sheet).encode())
    assert svg.get("viewBox") == "0 0 112 60"
    paths = [len(group.findall("{*}path")) for group in svg.iterfind("{*}g")]
    assert paths == [len(loops) for loops in layers.values()]


def test_a_sheet_with_another_kit(tmp_path: Path):
    export_kit(KitRequest(("disc_35x10",), tmp_path / "discs"))
    wanted = SheetRequest((300.0, 200.0), others=(tmp_path / "discs",))
    made = export_kit(KitRequest(("rod_80x14",), tmp_path / "rods", sheet=wanted))
    sheet = made.sheet
    assert sheet is not None
    assert_apart(sheet)
    assert {sheet.kits[place.kit].name for place in sheet.places} == {"rods", "discs"}
    record = json.loads((tmp_path / "rods" / "kit.json").read_text())
    assert len(record["sheet"]["kits"]) == len(sheet.places)
    document = ezdxf.readfile(tmp_path / "rods" / "sheet.dxf")
    assert not document.audit().errors
    cavities = [
        np.array(line.get_points("xy"))
        for line in document.modelspace().query("LWPOLYLINE")
        if line.dxf.layer.startswith("CAVITIES")
    ]
    discs = [c for c in cavities if np.ptp(c, axis=0).max() < 45]
    expected = sum(sheet.kits[place.kit].name == "discs" for place in sheet.places)
    assert len(discs) == expected
    for disc in discs:
        x, y = disc.T
        area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
        assert area == pytest.approx(math.pi * 19.5**2, rel=0.02)
    for file in ("sheet.svg", "sheet.png"):
        assert file in record["files"]
