"""Meshcat shows the room before the simulation starts."""

from pydrake.geometry import MeshcatParams

from kitting_drake.station.visualization import start_meshcat


def test_the_first_view_has_a_floor_and_a_table_on_legs():
    meshcat = start_meshcat(MeshcatParams(host="localhost"))
    for name in ("floor", "leg_00", "leg_01", "leg_10", "leg_11"):
        assert meshcat.HasPath(f"/room/{name}")
    assert len(meshcat.StaticHtml()) > 1_000_000
