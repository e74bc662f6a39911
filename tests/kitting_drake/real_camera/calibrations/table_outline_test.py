"""Tests the table's outline: its reading and writing, and its effect on o_t and on the checks."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import (
    Calibration,
    calibration_digest,
    calibration_record,
    read_calibration,
    write_calibration,
)
from kitting_drake.real_camera.calibrations.table_outline import TableOutline
from kitting_drake.real_camera.checking.check import check_cameras
from kitting_drake.real_camera.checking.table_check import check_table
from kitting_drake.real_camera.checking.views import check_frames, observe, seen_share
from kitting_drake.real_camera.frames import Frame
from kitting_drake.scenario.schema import Scenario
from tests.kitting_drake.real_camera.frames import calibration_of, cast

TRUE = calibration_of(Scenario())
LEFT = [[0.2, -0.6], [0.8, -0.6], [0.8, 0.1], [0.2, 0.1]]
BASE = [[0.2, -0.2], [0.35, -0.2], [0.35, 0.0]]


def read(folder: Path, **fields: object) -> Calibration:
    path = folder / "calibration.yaml"
    path.write_text(yaml.safe_dump({**calibration_record(TRUE), **fields}))
    return read_calibration(path)


def test_polygons_make_the_region(tmp_path: Path):
    found = read(tmp_path, region=LEFT, ignore=[BASE])
    xy = np.array([[0.4, -0.4], [0.4, 0.2], [0.34, -0.15], [0.26, -0.05], [0.9, 0.0]])
    assert found.contains(xy).tolist() == [True, False, False, True, False]
    row, col = np.rint(found.grid.to_pixel(xy[0])).astype(int)
    assert found.region.shape == found.grid.shape and found.region[row, col]
    area = found.region.sum() * found.grid.resolution**2
    assert area == pytest.approx(0.5 * 0.6 - 0.0133, abs=1e-3)
    assert TRUE.region is None and TRUE.contains(xy).tolist() == [True] * 4 + [False]


def test_an_outline_survives_writing(tmp_path: Path):
    image = np.zeros(TRUE.grid.shape, np.uint8)
    image[:, 40:] = 255
    Image.fromarray(image).save(tmp_path / "mask.png")
    found = read(tmp_path, region=LEFT, ignore=[BASE], region_mask="mask.png")
    assert not found.region[:, :40].any() and found.region[:, 45].any()
    (tmp_path / "elsewhere").mkdir()
    write_calibration(tmp_path / "elsewhere" / "written.yaml", found)
    again = read_calibration(tmp_path / "elsewhere" / "written.yaml")
    assert again.outline == found.outline and hash(again.outline) == hash(found.outline)
    np.testing.assert_array_equal(again.region, found.region)
    assert yaml.safe_load((tmp_path / "elsewhere" / "written.yaml").read_text())["region"] == LEFT
    digests = [
        calibration_digest(item)
        for item in (TRUE, found, again, read(tmp_path, region=LEFT, ignore=[BASE]))
    ]
    assert digests[1] == digests[2] and len(set(digests)) == 3
    # Without an outline, a record has no fields for it.
    assert set(calibration_record(TRUE)) == {"table_height", "workspace", "cameras"}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"region": LEFT[:2]}, "region has 2 corners, but a polygon has at least 3"),
        ({"region": [[0, 0], [1, float("nan")], [1, 0]]}, r"region\[1\] must be a finite number"),
        ({"region": [[0, 0, 0]] * 3}, r"region\[0\] must be a corner \[x, y\]"),
        ({"region": {"x": 1}}, "region must be a polygon"),
        ({"ignore": LEFT[0]}, r"ignore\[0\] must be a polygon"),
        ({"ignore": [LEFT, BASE[:2]]}, r"ignore\[1\] has 2 corners"),
        ({"region": (1e3 * np.array(LEFT) + 1e4).tolist()}, "region covers no pixel.* metres"),
        ({"ignore": [(np.array(BASE) - 1).tolist()]}, r"ignore\[0\] covers no pixel of the work"),
        ({"region": BASE, "ignore": [LEFT]}, "together leave no pixel of the workspace"),
        ({"region_mask": "small.png"}, "has 10 rows and 20 columns, but the workspace has 160"),
        ({"region_mask": "nowhere.png"}, "cannot read .*nowhere.png: No such file"),
        ({"region_mask": "calibration.yaml"}, "it is not an image"),
        ({"region_mask": "data:image/png;base64,@@"}, "cannot read the image in it"),
        ({"region_mask": 3}, "region_mask must be the name of an image"),
        ({"regoin": LEFT}, "did you mean 'region'"),
    ],
)
def test_invalid_outlines_are_refused(tmp_path: Path, fields: dict[str, object], message: str):
    Image.new("L", (20, 10)).save(tmp_path / "small.png")
    with pytest.raises(UserError, match=message) as raised:
        read(tmp_path, **fields)
    assert "\n" not in str(raised.value)


def beside_a_drop() -> tuple[dict[str, Frame], Calibration]:
    """A camera's frame of a table that ends at y = 0.1, beside a surface that is 60 mm higher."""
    front = Calibration(TRUE.cameras[:1], TRUE.grid)
    low = cast(front)["front"]
    grid = dataclasses.replace(TRUE.grid, z_min=0.06)
    high = cast(dataclasses.replace(front, grid=grid))["front"].depth
    rays = front.cameras[0].rays
    points = np.stack([rays.u * high, rays.v * high, high], axis=-1)
    y = (points @ front.cameras[0].X_BC[:3, :3].T + front.cameras[0].X_BC[:3, 3])[..., 1]
    return {"front": Frame(low.color, np.where(y > 0.1, high, low.depth))}, front


OUTLINE = TableOutline(tuple(map(tuple, LEFT)))


def test_only_the_region_is_observed():
    frames, front = beside_a_drop()
    outlined = dataclasses.replace(front, outline=OUTLINE, verified=True)
    checked = check_frames(frames, outlined)
    observation = observe(checked, outlined)
    assert observation.height.max() < 1e-4 < 0.05 < observe(checked, front).height.max()
    assert not (observation.valid | observation.in_view)[~outlined.region].any()
    assert seen_share(observation) > 0.9
    assert check_table(checked, dataclasses.replace(outlined, verified=True)) == []


def test_only_the_region_is_measured():
    frames, front = beside_a_drop()
    outlined = dataclasses.replace(front, outline=OUTLINE)
    found = check_cameras(frames, outlined)
    assert found.cameras["front"].table.holes < 0.01
    assert np.nanmax(found.heights[""]) < 0.001
    assert found.corrected.outline == outlined.outline
