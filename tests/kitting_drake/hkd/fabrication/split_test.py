import json
from pathlib import Path

import pytest
from manifold3d import CrossSection, Manifold

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.fabrication.export import export_kit
from kitting_drake.hkd.fabrication.kit_request import KitRequest
from kitting_drake.hkd.fabrication.outside import foot_sections
from kitting_drake.hkd.fabrication.splitting.opening import (
    LEAST_WALL,
    Opening,
    corner_area,
    thin_parts,
)
from kitting_drake.hkd.fabrication.splitting.pieces import Split, fits, split_block
from tests.kitting_drake.hkd.fabrication.rebuilding import assembled, assert_rebuilds

HEIGHT = 40.0
PLAY = 0.1


def box(x: float, y: float, length: float, width: float) -> CrossSection:
    return CrossSection.square((length, width)).translate((x, y))


def block(length: float, width: float, openings: list[Opening]) -> Manifold:
    solid = Manifold.cube((length, width, HEIGHT))
    for opening in openings:
        cutter = Manifold.extrude(opening.outline, HEIGHT).translate((0, 0, opening.floor))
        solid -= cutter
    return solid


def split(
    length: float, width: float, openings: list[Opening], bed: tuple[float, float]
) -> tuple[Manifold, Split]:
    whole = block(length, width, openings)
    found = split_block(whole, openings, bed, PLAY)
    assert found is not None
    for piece in found.pieces:
        assert fits(tuple(piece.size[:2]), bed)
        assert len(piece.body.decompose()) == 1
    return whole, found


def thin(shape: CrossSection) -> list[CrossSection]:
    parts = thin_parts(shape, LEAST_WALL).decompose()
    return [part for part in parts if part.area() > corner_area(LEAST_WALL)]


def test_pieces_rebuild_the_block():
    openings = [Opening(box(20, 20, 260, 30), 12.0), Opening(box(60, 80, 40, 120), 25.0)]
    whole, found = split(300.0, 220.0, openings, (180.0, 150.0))
    assert len(found.pieces) == 4
    assert_rebuilds(whole, [piece.body for piece in found.pieces], found)
    for z in (1.0, 20.0, 35.0):
        assert not [part for piece in found.pieces for part in thin(piece.body.slice(z))]
    # The pieces can be assembled in their order, each lowered onto those before it.
    assert all(joint.owner < joint.other for joint in found.joints)
    pairs = {(joint.owner, joint.other) for joint in found.joints}
    assert {(0, 1), (2, 3)} <= pairs
    assert not found.notes


def test_a_cut_passes_between_cavities():
    openings = [Opening(box(10, 10, 110, 80), 10.0), Opening(box(132, 10, 110, 80), 10.0)]
    _, found = split(252.0, 100.0, openings, (160.0, 160.0))
    assert len(found.pieces) == 2
    regions = [piece.region for piece in found.pieces]
    for opening in openings:
        assert any((opening.outline - region).is_empty() for region in regions)


def test_a_cut_crosses_a_cavity_rather_than_a_thin_wall():
    """The shortest cut would halve a wall of 2 mm, and a wall of 1 mm is too thin."""
    openings = [Opening(box(5, 5, 120, 90), 10.0), Opening(box(127, 5, 120, 90), 10.0)]
    _, found = split(252.0, 100.0, openings, (160.0, 160.0))
    for piece in found.pieces:
        assert not thin(piece.body.slice(20.0))


def test_a_dovetail_below_a_cavity_leaves_its_floor():
    openings = [Opening(box(4, 4, 242, 92), 14.0)]
    whole, found = split(250.0, 100.0, openings, (150.0, 150.0))
    assert found.joints
    for joint in found.joints:
        assert joint.height == pytest.approx(12.0)
    above = [piece.body ^ block(250.0, 100.0, []).translate((0, 0, 14.0)) for piece in found.pieces]
    kept = sum(part.volume() for part in above)
    assert kept == pytest.approx((whole ^ block(250.0, 100.0, []).translate((0, 0, 14.0))).volume())


def test_pieces_without_room_for_a_dovetail_are_reported():
    openings = [Opening(box(4, 4, 242, 92), 3.0)]
    _, found = split(250.0, 100.0, openings, (150.0, 150.0))
    assert not found.joints
    assert found.notes[0].startswith("pieces 1 and 2 have no room for a dovetail")


def test_the_bed_may_be_turned_and_a_small_block_stays_whole():
    assert split_block(block(150.0, 90.0, []), [], (90.0, 150.0), PLAY) is None
    _, found = split(280.0, 90.0, [], (90.0, 150.0))
    assert len(found.pieces) == 2


def test_a_bed_that_is_too_small():
    with pytest.raises(UserError, match=r"--bed 20 200 is too small"):
        split_block(block(300.0, 300.0, []), [], (20.0, 200.0), PLAY)


def test_cuts_go_between_feet_or_straight_through_them():
    """The second block has a cavity whose wall is too near to the line between the feet."""
    size, bed = (251.5, 83.5), (150.0, 150.0)
    feet = foot_sections(size)
    for openings in ([], [Opening(box(126.3, 10, 100, 60), 10.0)]):
        found = split_block(block(*size, openings), openings, bed, PLAY, feet)
        assert found is not None
        assert len(found.pieces) == 2
        for piece in found.pieces:
            assert not thin(piece.body.slice(20.0))
            assert not thin(piece.body.slice(1.0) ^ feet[0])
            is_between = (piece.region ^ feet[0]).area() == pytest.approx(6 * 35.6**2, rel=0.01)
            assert is_between or openings


def test_the_files_of_the_pieces(tmp_path: Path):
    made = export_kit(
        KitRequest(("plate_120x40x8", "rod_110x14"), tmp_path / "kit", bed_mm=(100.0, 90.0))
    )
    record = json.loads((tmp_path / "kit" / "kit.json").read_text())
    assert made.split is not None
    parts = assembled(tmp_path / "kit")
    assert len(parts) > 1
    for number, piece in enumerate(record["pieces"], 1):
        assert sorted(piece["size"][:2]) <= [90.0, 100.0]
        assert (tmp_path / "kit" / f"piece_{number}.3mf").is_file()
    assert (tmp_path / "kit" / "pieces.png").is_file()
    assert_rebuilds(made.block, parts, made.split)
