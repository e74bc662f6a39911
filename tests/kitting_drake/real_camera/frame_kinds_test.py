"""Frames are read from every kind of file, by the conventions of the tool that writes it."""

import base64
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import BenchCamera, Calibration, ColorLens
from kitting_drake.real_camera.calibrations.layouts import Intrinsics
from kitting_drake.real_camera.frames import Frame, read_frames
from systems.signals import PixelGrid

W, H = 8, 6
COL, ROW = np.meshgrid(np.arange(W), np.arange(H))
DEPTH = (0.7 + 0.005 * (COL + W * ROW)).astype(np.float32)
COLOR = np.stack([5 * (COL + W * ROW), 255 - 20 * COL, 40 * ROW], axis=-1).astype(np.uint8)
LENS = Intrinsics((W, H), (10.0, 10.0), (3.5, 2.5))
CAMERA = BenchCamera("front", LENS, np.eye(4))
POINTS = np.stack([(COL - 3.5) / 10 * DEPTH, (ROW - 2.5) / 10 * DEPTH, DEPTH], -1).reshape(-1, 3)
ORGANISED_HEADER = (
    "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\n"
    "TYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 8\nHEIGHT 6\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 48\n"
)
# Written by Open3D 0.20 from POINTS and COLOR.
COMPRESSED_PCD = (
    b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\n"
    b"TYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 48\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 48\n"
    b"DATA binary_compressed\n"
) + base64.b85decode(
    b"{Q>|000RI3A4lPOzTtW_zN{SDy_aqhy}fi3JyN*dJxJj?K1Q~KJ|Cu=guYU^KE7sV=Doh38olGC8$ApH>pi$0MLt"
    b"L2iasBx#*4ng^+>)Uu=2g;&?3DG*CRd0OZPn~Tu(kq43a({s_~M(Gc!}Z+xh;z3<4{?F$gR@!O8(XnweQXOgEW63"
    b"alKOzNBznzRRHnASWL)y;wOkJ)Z9eJ_^@kK2BnwKCVZhz7(!!zNp3vzFK4vJH3BuJUx394nBJnZaz?rr#>JvV80K"
    b"K!Zp4<3OBy&Q8>PunK`~7zYM<iC_KLSQ{%la-Q>MMzXqP~=e^Z<=^%#`>%BvZ?7eyv?!9)tAHAH!AicrLA;7;NF9"
    b";;PRO2PRdFdt~GYBU=!u2RU=ldxj_W>(CK)(W34lN*q4K6*P8ZSMR7z92q-2^@$zX(2NW(Gb2D+fM6zXmz92tL(#"
    b"2_O>zW<DUl4?e^7Xg+a0YCa!@Yd+1)Y+%0vDO_(rzW_fWe*ixqzW_fVzW_fVzW_fVzW_fVzW_fVzXU&|a6LaEe-J"
    b"+a06;&kM?pVak3v5R*F!%ce+WNjW=200u17y1e-J-$JxV_xg-bup%uGLf6iz=Oe+xg?qfkGE>rp>5GgBaA08}7j0"
    b"97Dk09PPm09YVn09hbo09qhp09+tr09_zs0A3(t0AL_v0AV0w0Ae6x0AnCy0A(O!0A?U#0B0a$0B9g%0BRs(0Bay"
    b")0Bj&*0B#^-A8$VZ{{R30>jeM+*9rgt!w&!euM_|Pn;8HAhaLa`a~~rBDE}w`DC;c%DAzIoD8n}ZD6c#KD4Rh5D2"
    b"GM>D03f608sx>08r~y08rOj08qnU08p=F08pE008oc+08n!ua{ze%cmR0oeE@jZf&h5KhX8o5i~x9>kpOsymH>Ej"
    b"ADaN6|DXV%>!kpo*Qx-Z!><6Kue1Q5o4Ej>hrR%yb05P1$p6Ry$m`7j$k);U$ivqF$gkW0$eZB+$cN?t$a4Yf00"
)


def read(*paths: Path, camera: BenchCamera = CAMERA, time: float | None = None) -> Frame:
    calibration = Calibration((camera,), PixelGrid())
    return read_frames(paths, calibration, time=time)["front"]


def png(folder: Path) -> Path:
    Image.fromarray(COLOR).save(folder / "color.png")
    return folder / "color.png"


def steps(scale: float = 1000) -> NDArray[np.uint16]:
    return np.rint(scale * DEPTH).astype(np.uint16)


def packed() -> NDArray[np.uint32]:
    r, g, b = (COLOR.reshape(-1, 3).astype(np.uint32)[:, i] for i in range(3))
    return r << 16 | g << 8 | b


def write_npz(folder: Path) -> None:
    np.savez_compressed(folder / "front.npz", color=COLOR, depth=DEPTH)


def write_float_tiff(folder: Path) -> None:
    png(folder)
    Image.fromarray(DEPTH).save(folder / "depth.tiff", compression="tiff_lzw")


def write_opencv_tiff(folder: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    png(folder)
    assert cv2.imwrite(str(folder / "depth.tif"), DEPTH)


def write_16_bit_tiff(folder: Path) -> None:
    png(folder)
    Image.fromarray(steps()).save(folder / "depth.tif")


def write_exr(folder: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    png(folder)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, {"Depth.V": DEPTH}).write(str(folder / "depth.exr"))


def write_grey_exr(folder: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    png(folder)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, {"RGB": np.dstack([DEPTH] * 3)}).write(str(folder / "depth.exr"))


def write_text_ply(folder: Path) -> None:
    """Writes an ASCII PLY file as Open3D does."""
    rows = (
        f"{x:.9g} {y:.9g} {z:.9g} {r} {g} {b}"
        for (x, y, z), (r, g, b) in zip(POINTS, COLOR.reshape(-1, 3), strict=True)
    )
    head = "ply\nformat ascii 1.0\ncomment Created by Open3D\nelement vertex 48\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    (folder / "front.ply").write_text(head + "end_header\n" + "\n".join(rows) + "\n")


def write_binary_ply(folder: Path) -> None:
    """Writes a binary PLY file as Open3D does."""
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 48\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    table = np.zeros(48, [("p", "<f8", 3), ("c", "u1", 3)])
    table["p"], table["c"] = POINTS, COLOR.reshape(-1, 3)
    (folder / "cloud.ply").write_bytes(head.encode() + b"end_header\n" + table.tobytes())


def write_text_pcd(folder: Path) -> None:
    rows = (f"{x:.9g} {y:.9g} {z:.9g} {c}" for (x, y, z), c in zip(POINTS, packed(), strict=True))
    text = ORGANISED_HEADER.replace("F F F F", "F F F U") + "DATA ascii\n" + "\n".join(rows) + "\n"
    (folder / "front.pcd").write_text(text)


def write_binary_pcd(folder: Path) -> None:
    """Writes an organised cloud as PCL does, with colours packed into the bits of a float."""
    table = np.column_stack([POINTS.astype("<f4"), packed().view("<f4")])
    data = (ORGANISED_HEADER + "DATA binary\n").encode() + table.astype("<f4").tobytes()
    (folder / "front.pcd").write_bytes(data)


def write_compressed_pcd(folder: Path) -> None:
    (folder / "front.pcd").write_bytes(COMPRESSED_PCD)


def write_cloud_and_image(folder: Path) -> None:
    png(folder)
    write_compressed_pcd(folder)
    (folder / "front.pcd").rename(folder / "depth.pcd")


@pytest.mark.parametrize(
    ("write", "error"),
    [
        (write_npz, 0),
        (write_float_tiff, 0),
        (write_opencv_tiff, 0),
        (write_16_bit_tiff, 5.01e-4),
        (write_exr, 0),
        (write_grey_exr, 0),
        (write_text_ply, 1e-6),
        (write_binary_ply, 1e-6),
        (write_text_pcd, 1e-6),
        (write_binary_pcd, 1e-6),
        (write_compressed_pcd, 1e-6),
        (write_cloud_and_image, 1e-6),
    ],
)
def test_kinds(tmp_path: Path, write: Callable[[Path], None], error: float):
    write(tmp_path)
    for frame in (read(tmp_path), read(*sorted(tmp_path.iterdir()))):
        np.testing.assert_allclose(frame.depth, DEPTH, atol=error, rtol=0)
        assert frame.depth.dtype == np.float32
        np.testing.assert_array_equal(frame.color, COLOR)


def test_steps_of_16_bits_have_the_calibrated_scale(tmp_path: Path):
    png(tmp_path)
    Image.fromarray(steps(1e4)).save(tmp_path / "depth.tif")
    camera = dataclasses.replace(CAMERA, depth_scale=1e-4)
    np.testing.assert_allclose(read(tmp_path, camera=camera).depth, DEPTH, atol=5.1e-5)


def test_an_unorganised_cloud_is_projected(tmp_path: Path):
    """The cloud lacks points and is shuffled; of two points on a ray, the nearer one is seen."""
    order = np.random.default_rng(0).permutation(48)[:40]
    points = np.vstack([POINTS[order], 1.5 * POINTS[order[:5]]])
    colors = np.vstack([COLOR.reshape(-1, 3)[order], np.zeros((5, 3), np.uint8)])
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 45\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    table = np.zeros(45, [("p", "<f4", 3), ("c", "u1", 3)])
    table["p"], table["c"] = points, colors
    (tmp_path / "front.ply").write_bytes(head.encode() + b"end_header\n" + table.tobytes())
    lens = dataclasses.replace(LENS, distortion=(0.0, 0.0, 0.0, 0.0, 1e-6))
    for camera in (CAMERA, dataclasses.replace(CAMERA, intrinsics=lens)):
        frame = read(tmp_path, camera=camera)
        kept = np.isin(np.arange(48), order).reshape(H, W)
        np.testing.assert_allclose(frame.depth, np.where(kept, DEPTH, 0), atol=1e-6)
        np.testing.assert_array_equal(frame.color, np.where(kept[..., None], COLOR, 0))


def test_colour_of_another_lens_is_registered(tmp_path: Path):
    """The colour camera is 40 mm to the right and has twice the resolution; a plane is at 0.8 m."""
    lens = Intrinsics((16, 12), (20.0, 20.0), (7.75, 5.5))
    X_KC = np.eye(4)
    X_KC[0, 3] = -0.04
    camera = dataclasses.replace(CAMERA, color=ColorLens(lens, X_KC))
    large = np.zeros((12, 16, 3), np.uint8)
    large[..., 0], large[..., 1] = 10 + 16 * np.arange(16), 20 * np.arange(12)[:, None]
    Image.fromarray(large).save(tmp_path / "color.png")
    depth = np.full((H, W), 0.8, np.float32)
    depth[0, 3] = 0
    np.save(tmp_path / "depth.npy", depth)
    frame = read(tmp_path, camera=camera)
    # Depth column c sees the point at x = 0.08 (c - 3.5), which is in colour column 2 c - 0.25.
    columns = np.rint(20 * (0.08 * (np.arange(W) - 3.5) - 0.04) / 0.8 + 7.75).astype(int)
    assert columns.tolist() == [0, 2, 4, 6, 8, 10, 12, 14]
    np.testing.assert_array_equal(frame.color[3, :, 0], 10 + 16 * columns)
    assert not frame.color[0, 3].any()
    with pytest.raises(UserError, match=r"color.png is 16x12 pixels.*describe it under .color."):
        read(tmp_path)


def cut(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


def truncated(write: Callable[[Path], None], share: float = 0.6) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        write(folder)
        for path in folder.iterdir():
            if path.name != "color.png":
                cut(path, share)

    return change


def written(name: str, text: str = "") -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        png(folder)
        (folder / name).write_text(text)

    return change


def edited(
    write: Callable[[Path], None], name: str, old: bytes, new: bytes
) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        write(folder)
        content = (folder / name).read_bytes()
        assert old in content
        (folder / name).write_bytes(content.replace(old, new))

    return change


def npz(**arrays: NDArray[np.generic]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        np.savez(folder / "front.npz", **arrays)  # type: ignore[arg-type]

    return change


def moved_cloud(folder: Path) -> None:
    write_binary_pcd(folder)
    table = np.column_stack([POINTS + [0.3, 0, 0], packed().view("<f4")])
    data = (ORGANISED_HEADER + "DATA binary\n").encode() + table.astype("<f4").tobytes()
    (folder / "front.pcd").write_bytes(data)


def scaled_cloud(scale: float) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        table = np.column_stack([POINTS * scale, packed().view("<f4")])
        data = (ORGANISED_HEADER + "DATA binary\n").encode() + table.astype("<f4").tobytes()
        (folder / "front.pcd").write_bytes(data)

    return change


def colourless(folder: Path) -> None:
    header = ORGANISED_HEADER.replace("x y z rgb", "x y z i")
    table = np.column_stack([POINTS, POINTS[:, 2]]).astype("<f4")
    (folder / "front.pcd").write_bytes((header + "DATA binary\n").encode() + table.tobytes())


def double_tiff(folder: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    png(folder)
    assert cv2.imwrite(str(folder / "depth.tif"), DEPTH.astype(float))


def two_page_tiff(folder: Path) -> None:
    png(folder)
    page = Image.fromarray(DEPTH)
    page.save(folder / "depth.tif", save_all=True, append_images=[page])


def colour_exr(folder: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    png(folder)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, {"RGB": np.dstack([DEPTH, 2 * DEPTH, DEPTH])}).write(
        str(folder / "depth.exr")
    )


def both_kinds(folder: Path) -> None:
    png(folder)
    write_npz(folder)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (truncated(write_npz), "front.npz: it is not a complete"),
        (truncated(write_float_tiff), "depth.tiff"),
        (truncated(write_exr), "depth.exr: it is not a complete EXR image"),
        (truncated(write_text_ply), "front.ply: it is not a complete PLY file"),
        (truncated(write_binary_ply), "cloud.ply: it is not a complete PLY file"),
        (truncated(write_text_pcd), "front.pcd: it is not a complete PCD file"),
        (truncated(write_binary_pcd), "front.pcd: it is not a complete PCD file"),
        (truncated(write_compressed_pcd), "front.pcd: it is not a complete PCD file"),
        (truncated(write_compressed_pcd, 0.1), "front.pcd: it is not a complete PCD file"),
        (npz(depth=DEPTH), "must hold the arrays color and depth, not depth"),
        (npz(color=COLOR.astype(float), depth=DEPTH), "must be bytes of shape .* of float64"),
        (npz(color=COLOR, depth=DEPTH[None]), "front.npz: depth must have one channel, not 8"),
        (npz(color=COLOR[:3], depth=DEPTH), "front.npz is 8x3 pixels, but camera front was"),
        (both_kinds, "has both front.npz and color.png: keep only one of them"),
        (double_tiff, "it is not an image of 8 or 16 bits, or of 32-bit floats"),
        (two_page_tiff, "depth.tif holds 2 images"),
        (colour_exr, "has the channels .*: write depth alone, in the channel Z"),
        (moved_cloud, "the points are 4 pixels from where camera front would see them"),
        (scaled_cloud(1000), "save them in metres, not millimetres"),
        (scaled_cloud(-1), "has most points behind the camera"),
        (colourless, "front.pcd has no colours"),
        (edited(write_text_pcd, "front.pcd", b"HEIGHT 6", b"HEIGHT 3"), "PCD file|is 8x3 points"),
        (edited(write_text_pcd, "front.pcd", b"x y z", b"x y h"), "front.pcd has no field z"),
        (
            edited(write_binary_pcd, "front.pcd", b"POINT 0 0 0 1", b"POINT 0 0 1 1"),
            "VIEWPOINT other than 0",
        ),
        (written("depth.raw"), "depth.raw cannot be read: save it by numpy.save"),
        (written("depth.zdf"), "depth.zdf cannot be read: save it as .ply by Zivid"),
        (written("depth.klg"), "depth.klg cannot be read: write its frames as PNG"),
        (written("depth.png", "hello"), "depth.png: it is not an image"),
    ],
)
def test_frames_that_cannot_be_read_are_refused(
    tmp_path: Path, write: Callable[[Path], None], message: str
):
    write(tmp_path)
    with pytest.raises(UserError, match=message) as raised:
        read(tmp_path)
    assert "\n" not in str(raised.value)


def test_a_time_needs_a_recording(tmp_path: Path):
    write_npz(tmp_path)
    with pytest.raises(UserError, match="--time needs a recording"):
        read(tmp_path, time=1.0)
    with pytest.raises(UserError, match=r"x.klg cannot be read: write its frames"):
        (tmp_path / "x.klg").touch()
        read(tmp_path / "x.klg")
