"""Renders photos of tools with known outlines on a sheet of paper, for `benchmark trace` and the
tests.

A tool is an upright prism over its outline. It is drawn through a tilted pinhole camera with its
walls, a soft shadow, texture, highlights, blur, noise and JPEG compression. Lengths are in mm. The
sheet's frame has its origin in the sheet's lower left corner, x to the right, y up and z toward the
camera.
"""

import io
import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from manifold3d import CrossSection, FillRule
from numpy.typing import NDArray
from PIL import ExifTags, Image

from kitting_drake.common.extras import import_extra

Array = NDArray[Any]

_DIAGONAL_35MM = math.hypot(36, 24)
_FOCAL_35MM = 26
_SHADOW_PX_PER_MM = 2.0
_SHADOW_MARGIN_MM = 50.0
_PIECE_MM = 1.2
PAINTS = {
    "black": (0.02, 0.02, 0.022),
    "steel": (0.30, 0.31, 0.33),
    "dark steel": (0.10, 0.10, 0.11),
    "red": (0.45, 0.03, 0.03),
    "yellow": (0.75, 0.42, 0.02),
    "wood": (0.45, 0.26, 0.12),
    "blue": (0.02, 0.08, 0.35),
}
"""Linear reflectances (red, green, blue) of paints, by name."""
GROUNDS = {"dark": (0.16, 0.10, 0.06), "light": (0.55, 0.50, 0.43)}


@dataclass(frozen=True)
class PhotoSpec:
    """The conditions under which a photo is taken."""

    size: tuple[int, int] = (4000, 3000)
    """The width and height, in pixels."""
    sheet: tuple[float, float] = (297.0, 210.0)
    """The size of the sheet along x and y."""
    distance: float = 430.0
    """The distance of the camera from the middle of the sheet."""
    tilt: float = 0.0
    """The angle between the line of sight and the vertical, in degrees."""
    azimuth: float = 0.0
    """The direction from the sheet's middle to the tilted camera, in degrees from x toward y."""
    roll: float = 0.0
    """The rotation about the line of sight, in degrees."""
    ground: str = "dark"
    """The background, a key of `GROUNDS`."""
    shadow: float = 0.5
    """The share of the light that a shadow takes away."""
    light: tuple[float, float] = (0.7, 0.4)
    """The shift of a shadow along x and y per unit of height."""
    softness: float = 0.15
    """The standard deviation of `light` among the lamps. Larger values make softer shadows."""
    falloff: float = 0.25
    """How uneven the light is: roughly the relative change of its strength from the middle of the
    sheet to the edge."""
    blur: float = 1.0
    """The standard deviation of the blur, in pixels."""
    noise: float = 0.006
    """The standard deviation of the noise, for values from 0 to 1."""
    quality: int = 90
    """The quality of the JPEG, from 1 to 100."""
    distortion: float = 0.0
    """The coefficient k1 of the lens's distortion, in OpenCV's model."""
    exif: bool = True
    """Whether the photo states its focal length in its EXIF data."""
    seed: int = 0
    """The seed of textures and noise."""
    shot: int = 0
    """The number of the photo among several photos of the same scene, which differ in noise."""

    def from_side(self, shot: int) -> "PhotoSpec":
        """The conditions of photo number `shot` of the same scene. Photo 1 is taken from the
        opposite side of the sheet, photos 2 and 3 from the sides between."""
        turn = (0, 180, 90, 270)[shot]
        return replace(self, azimuth=self.azimuth + turn, roll=self.roll + turn, shot=shot)


@dataclass(frozen=True)
class PlacedTool:
    """A prism on the sheet: a tool with its paints."""

    outline: CrossSection
    """The outline in the sheet's frame, in mm."""
    height: float
    """The height of the prism, in mm."""
    paints: tuple[str, str] = ("steel", "red")
    """The paints of the tool's two ends, keys of `PAINTS`."""


@dataclass(frozen=True)
class PlacedPrint:
    """A printed picture on the sheet."""

    pixels: Array
    """The gray pixels (rows, columns) of the picture."""
    low: tuple[float, float]
    """The lower left corner (x, y) in the sheet's frame, in mm."""
    size: tuple[float, float]
    """The size along x and y, in mm."""


@dataclass(frozen=True)
class _Camera:
    K: Array
    R: Array
    C: Array

    def project(self, points: Array) -> Array:
        """Projects points (n, 3) to pixels (n, 2)."""
        seen = (np.asarray(points, float) - self.C) @ (self.K @ self.R).T
        return seen[:, :2] / seen[:, 2:]

    def homography(self, z: float) -> Array:
        """Returns the homography (3, 3) from the plane at height z to pixels."""
        M = self.K @ self.R
        return np.column_stack([M[:, 0], M[:, 1], M @ (np.array([0, 0, z]) - self.C)])


def draw_photo(
    tools: list[PlacedTool], spec: PhotoSpec, printed: PlacedPrint | None = None
) -> bytes:
    """Renders a photo of tools on a sheet, as a JPEG."""
    cv2 = import_extra("cv2", purpose="benchmark trace", extra="camera")
    rng = np.random.default_rng(spec.seed)
    camera = _camera(spec)
    picture = _ground(cv2, camera, spec, rng)
    if printed is not None:
        _paint_print(cv2, picture, printed, camera, spec)
    picture *= _light_on_ground(cv2, tools, camera, spec)[..., None]
    for tool in tools:
        _paint_tool(cv2, picture, tool, camera, spec, rng)
    if spec.distortion:
        picture = _distorted(cv2, picture, camera, spec)
    picture = cv2.GaussianBlur(picture, (0, 0), spec.blur)
    coded = _srgb(picture)
    # Draw noise for small tiles, which is faster than for all pixels and looks the same.
    noise_rng = np.random.default_rng([spec.seed, spec.shot]) if spec.shot else rng
    noise = noise_rng.normal(0, spec.noise, (701, 997, 3)).astype(np.float32)
    rows = -(-coded.shape[0] // 701)
    columns = -(-coded.shape[1] // 997)
    coded += np.tile(noise, (rows, columns, 1))[: coded.shape[0], : coded.shape[1]]
    image = Image.fromarray((255 * np.clip(coded, 0, 1) + 0.5).astype(np.uint8))
    exif = Image.Exif()
    if spec.exif:
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = _FOCAL_35MM
    data = io.BytesIO()
    image.save(data, format="JPEG", quality=spec.quality, exif=exif)
    return data.getvalue()


def _camera(spec: PhotoSpec) -> _Camera:
    width, height = spec.size
    f = _FOCAL_35MM / _DIAGONAL_35MM * math.hypot(width, height)
    K = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])
    tilt, azimuth, roll = np.radians([spec.tilt, spec.azimuth, spec.roll])
    target = np.array([spec.sheet[0] / 2, spec.sheet[1] / 2, 0])
    away = np.array(
        [
            math.sin(tilt) * math.cos(azimuth),
            math.sin(tilt) * math.sin(azimuth),
            math.cos(tilt),
        ]
    )
    forward = -away
    right = np.array([math.cos(roll), math.sin(roll), 0])
    right -= forward * (right @ forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return _Camera(K, R, target + spec.distance * away)


def _ground(cv2: Any, camera: _Camera, spec: PhotoSpec, rng: np.random.Generator) -> Array:
    """Draws the desk and the sheet, as linear values."""
    base = np.array(GROUNDS[spec.ground], np.float32)
    # Draw a plank with a grain along x, and specks.
    px_per_mm, reach = 2.0, 450.0
    side = int(2 * reach * px_per_mm)
    grain = cv2.GaussianBlur(rng.normal(0, 1, (side, side)).astype(np.float32), (0, 0), 25, None, 2)
    specks = cv2.GaussianBlur(rng.normal(0, 1, (side, side)).astype(np.float32), (0, 0), 1.0)
    texture = 1 + 0.15 * grain / grain.std() + 0.06 * specks / specks.std()
    desk = base * np.clip(texture, 0.3, 2)[..., None]
    x, y = spec.sheet[0] / 2, spec.sheet[1] / 2
    to_plane = np.array(
        [[1 / px_per_mm, 0, x - reach], [0, -1 / px_per_mm, y + reach], [0, 0, 1.0]]
    )
    picture = cv2.warpPerspective(
        desk, camera.homography(0) @ to_plane, spec.size, borderMode=cv2.BORDER_REFLECT
    )
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * spec.sheet
    mask = _filled(cv2, [camera.project(np.c_[corners, np.zeros(4)])], spec.size)[..., None]
    paper = np.array([0.80, 0.80, 0.78], np.float32)
    return picture * (1 - mask) + paper * mask


def _light_on_ground(cv2: Any, tools: list[PlacedTool], camera: _Camera, spec: PhotoSpec) -> Array:
    """Returns the share of light that reaches the ground at each pixel."""
    low = np.full(2, -_SHADOW_MARGIN_MM)
    columns, rows = ((np.array(spec.sheet) - 2 * low) * _SHADOW_PX_PER_MM).astype(int).tolist()
    hidden = np.zeros((rows, columns), np.float32)
    rng = np.random.default_rng(spec.seed + 1)
    lamps = np.array(spec.light) + spec.softness * rng.normal(0, 1, (24, 2))
    for lamp in lamps:
        mask = np.zeros((rows, columns), np.uint8)
        for tool in tools:
            steps = max(2, int(2 * tool.height * np.linalg.norm(lamp)))
            for share in np.linspace(0, 1, steps):
                moved = tool.outline.translate(tuple(share * tool.height * lamp))
                loops = [(np.asarray(p) - low) * _SHADOW_PX_PER_MM for p in moved.to_polygons()]
                layer = np.zeros_like(mask)
                cv2.fillPoly(layer, [np.round(16 * p).astype(np.int32) for p in loops], 1, 8, 4)
                mask |= layer
        hidden += mask / len(lamps)
    to_plane = np.array(
        [[1 / _SHADOW_PX_PER_MM, 0, low[0]], [0, 1 / _SHADOW_PX_PER_MM, low[1]], [0, 0, 1.0]]
    )
    # Block some of the ambient light close to the tool.
    near = cv2.GaussianBlur((hidden > 0.9).astype(np.float32), (0, 0), 3 * _SHADOW_PX_PER_MM)
    light = (1 - spec.shadow * hidden) * (1 - 0.25 * near)
    across = np.linspace(-1, 1, columns, dtype=np.float32)
    along = np.linspace(-1, 1, rows, dtype=np.float32)
    light *= 1 - spec.falloff * (0.8 * across[None] + 0.6 * along[:, None])
    H = camera.homography(0) @ to_plane
    return cv2.warpPerspective(light, H, spec.size, borderMode=cv2.BORDER_REPLICATE)


def _paint_print(
    cv2: Any, picture: Array, printed: PlacedPrint, camera: _Camera, spec: PhotoSpec
) -> None:
    rows, columns = printed.pixels.shape
    x, y = printed.size[0] / columns, printed.size[1] / rows
    to_plane = np.array(
        [
            [x, 0, printed.low[0] + x / 2],
            [0, -y, printed.low[1] + printed.size[1] - y / 2],
            [0, 0, 1.0],
        ]
    )
    H = camera.homography(0) @ to_plane
    shown = cv2.warpPerspective(printed.pixels.astype(np.float32) / 255, H, spec.size)
    mask = cv2.warpPerspective(np.ones(printed.pixels.shape, np.float32), H, spec.size)
    picture *= (1 - mask)[..., None]
    picture += (0.02 * mask + 0.78 * shown)[..., None]


def _paint_tool(
    cv2: Any,
    picture: Array,
    tool: PlacedTool,
    camera: _Camera,
    spec: PhotoSpec,
    rng: np.random.Generator,
) -> None:
    """Paints a tool's walls and its top over the picture."""
    loops = [np.asarray(p, float) for p in tool.outline.to_polygons()]
    tops = [camera.project(np.c_[p, np.full(len(p), tool.height)]) for p in loops]
    feet = [camera.project(np.c_[p, np.zeros(len(p))]) for p in loops]
    seen = np.concatenate([*tops, *feet])
    low = np.maximum(np.floor(seen.min(axis=0)) - 2, 0).astype(int)
    high = np.minimum(np.ceil(seen.max(axis=0)) + 3, spec.size).astype(int)
    size = tuple((high - low).tolist())
    # Draw at twice the picture's resolution.
    canvas = np.zeros((2 * size[1], 2 * size[0], 4), np.uint8)
    sides = []
    for loop, top, foot in zip(loops, tops, feet, strict=True):
        for i in range(len(loop)):
            j = (i + 1) % len(loop)
            along = loop[j] - loop[i]
            length = float(np.linalg.norm(along))
            if length < 1e-9:
                continue
            normal = np.array([along[1], -along[0]]) / length
            shade = 0.55 + 0.35 * float(normal @ [-0.6, -0.4])
            distance = float(np.linalg.norm(loop[i] - camera.C[:2]))
            # Shade the sides in short, uneven pieces, which gives them a texture.
            cuts = np.linspace(0, 1, max(1, round(length / _PIECE_MM)) + 1)
            for start, end in itertools.pairwise(cuts):
                low_edge = foot[i] + np.outer((start, end), foot[j] - foot[i])
                high_edge = top[i] + np.outer((end, start), top[j] - top[i])
                quad = np.concatenate([low_edge, high_edge])
                sides.append((distance, quad, shade * rng.uniform(0.8, 1.2), loop[i]))
    paints = np.array([PAINTS[name] for name in tool.paints])
    x_low, _, x_high, _ = tool.outline.bounds()
    middle = (x_low + x_high) / 2
    for _, quad, shade, point in sorted(sides, key=lambda side: -side[0]):
        paint = paints[0 if point[0] > middle else 1]
        colour = (255 * np.sqrt(np.clip(shade * paint, 0, 1))).round().tolist()
        cv2.fillPoly(canvas, [_fine(quad - low)], (*colour, 255), 8, 4)
    cover = np.zeros(canvas.shape[:2], np.uint8)
    cv2.fillPoly(cover, [_fine(p - low) for p in tops], 255, 8, 4)
    skin = _skin(cv2, tool, paints, rng, middle, spec)
    shift = np.array([[2, 0, 0.5 - 2 * low[0]], [0, 2, 0.5 - 2 * low[1]], [0, 0, 1.0]])
    to_plane = np.array([[0.5, 0, x_low - 5], [0, 0.5, tool.outline.bounds()[1] - 5], [0, 0, 1.0]])
    warped = cv2.warpPerspective(
        skin, shift @ camera.homography(tool.height) @ to_plane, canvas.shape[1::-1]
    )
    canvas[cover > 0, :3] = warped[cover > 0]
    canvas[cover > 0, 3] = 255
    linear = np.empty(canvas.shape, np.float32)
    linear[..., :3] = (canvas[..., :3] / np.float32(255)) ** 2
    linear[..., 3] = canvas[..., 3] / np.float32(255)
    linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
    part = picture[low[1] : high[1], low[0] : high[0]]
    part[:] = part * (1 - linear[..., 3:]) + linear[..., :3]


def _skin(
    cv2: Any,
    tool: PlacedTool,
    paints: Array,
    rng: np.random.Generator,
    middle: float,
    spec: PhotoSpec,
) -> Array:
    """Draws the colours of a tool's top, as square roots of linear values, at 2 pixels per mm."""
    x_low, y_low, x_high, y_high = tool.outline.bounds()
    width, height = int(2 * (x_high - x_low + 10)), int(2 * (y_high - y_low + 10))
    along = np.arange(width) / 2 + x_low - 5
    colour = paints[np.where(along > middle, 0, 1)][None].repeat(height, axis=0).astype(np.float32)
    streaks = cv2.GaussianBlur(
        rng.normal(0, 1, (height, width)).astype(np.float32), (0, 0), 12, None, 0.7
    )
    colour *= np.clip(1 + 0.25 * streaks / streaks.std(), 0.2, 2)[..., None]
    # Draw a few bright bands, in which metal mirrors a lamp. They move with the camera.
    moved = np.random.default_rng([spec.seed, spec.shot, 1])
    for _ in range(2):
        band = [rng.uniform(x_low, x_high), rng.uniform(2, 6), rng.uniform(0.2, 1.0)]
        if spec.shot:
            band = moved.uniform((x_low, 2, 0.2), (x_high, 6, 1.0)).tolist()
        where, wide, strength = band
        shine = strength * np.exp(-(((along - where) / wide) ** 2))
        metal = np.array(["steel" in name for name in tool.paints])[np.where(along > middle, 0, 1)]
        colour += (shine * np.where(metal, 1.0, 0.1))[None, :, None].astype(np.float32)
    return (255 * np.sqrt(np.clip(colour, 0, 1))).astype(np.uint8)


def _fine(pixels: Array) -> Array:
    """Converts pixel coordinates to those in a picture of twice the resolution, in sixteenths of a
    pixel, as OpenCV's drawing functions expect."""
    return np.round(16 * (2 * pixels + 0.5)).astype(np.int32)


def _filled(cv2: Any, loops: list[Array], size: tuple[int, int]) -> Array:
    """Returns the share of each pixel that lies inside closed loops of pixel coordinates (n, 2)."""
    mask = np.zeros((2 * size[1], 2 * size[0]), np.uint8)
    cv2.fillPoly(mask, [_fine(loop) for loop in loops], 255, 8, 4)
    return cv2.resize(mask, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def _distorted(cv2: Any, picture: Array, camera: _Camera, spec: PhotoSpec) -> Array:
    """Returns the picture through a lens with radial distortion."""
    u, v = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in spec.size))
    points = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    lens = np.array([spec.distortion, 0, 0, 0])
    ideal = cv2.undistortPoints(points, camera.K, lens, P=camera.K)
    ideal = ideal.reshape(*u.shape, 2)
    return cv2.remap(
        picture, ideal[..., 0], ideal[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def _srgb(linear: Array) -> Array:
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def placed_outline(
    outline: CrossSection, spec: PhotoSpec, angle: float, shift: tuple[float, float]
) -> CrossSection:
    """Turns an outline by `angle` degrees and moves the middle of its bounds to the sheet's middle
    plus `shift`, in mm."""
    outline = outline.rotate(angle)
    x_low, y_low, x_high, y_high = outline.bounds()
    x = spec.sheet[0] / 2 + shift[0] - (x_low + x_high) / 2
    y = spec.sheet[1] / 2 + shift[1] - (y_low + y_high) / 2
    return CrossSection(outline.translate((x, y)).to_polygons(), FillRule.EvenOdd)
