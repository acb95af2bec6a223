"""A plain drawing of a scene, for machines without OpenGL.

Every shape that MuJoCo draws here is convex, so its picture is the convex hull of its projected surface
points: project, fill the hull, farthest shape first. No shadows and no textures, but the motion is all there.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

import itertools

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

SKY = (236, 241, 246)
OVERSAMPLING = 2  # drawn larger by this factor, then scaled down: smooth edges
SUN = np.array([-0.35, -0.5, 0.8])  # direction towards the light
GROUND_TILES = 16  # squares along each side of the floor that is drawn
LARGEST_TILE = 1.0  # m
FOCUS = 4.0  # m before the camera lies the middle of the floor that is drawn, if it looks at no floor
FARTHEST_FOCUS = 12.0  # m
TILES = ((226, 228, 226), (214, 216, 214))

Points = NDArray[np.float64]


def _sphere_directions() -> Points:
    """[96, 3] unit vectors on circles of latitude, poles included."""
    latitude, longitude = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 8), np.arange(12) * np.pi / 6)
    ring = np.cos(latitude)
    return np.stack([ring * np.cos(longitude), ring * np.sin(longitude), np.sin(latitude)], -1).reshape(-1, 3)


DIRECTIONS = _sphere_directions()
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
CIRCLE = np.stack([np.cos(np.arange(24) * np.pi / 12), np.sin(np.arange(24) * np.pi / 12), np.zeros(24)], -1)


def surface(kind: int, size: Points) -> Points | None:
    """Points [n, 3] whose hull is the shape, in the shape's own frame, or None if it is not drawn."""
    ends = np.array([[0.0, 0.0, size[2]]])
    match kind:
        case mujoco.mjtGeom.mjGEOM_SPHERE | mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return DIRECTIONS * size
        case mujoco.mjtGeom.mjGEOM_BOX:
            return CORNERS * size
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            cap = DIRECTIONS * size[0]
            return np.concatenate([cap + ends, cap - ends])
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            rim = CIRCLE * size[0]
            return np.concatenate([rim + ends, rim - ends])
    return None


def hull(points: Points) -> Points:
    """Convex hull [k, 2] of points [n, 2], by Andrew's monotone chain."""
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))].tolist()

    def chain(sequence: list[list[float]]) -> list[list[float]]:
        line: list[list[float]] = []
        for x, y in sequence:
            while len(line) > 1 and (
                (line[-1][0] - line[-2][0]) * (y - line[-2][1])
                <= (line[-1][1] - line[-2][1]) * (x - line[-2][0])
            ):
                line.pop()
            line.append([x, y])
        return line[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


class Sketch:
    """Draws scenes of convex shapes in flat colours.

    Args:
        width, height: size in pixels.
    """

    def __init__(self, width: int, height: int) -> None:
        self._size = (width, height)

    def frame(self, scene: mujoco.MjvScene) -> NDArray[np.uint8]:
        """[height, width, 3] pixels."""
        width, height = self._size
        self._look(scene.camera[0])
        image = Image.new("RGB", (width * OVERSAMPLING, height * OVERSAMPLING), SKY)
        canvas = ImageDraw.Draw(image)
        geoms = [geom for geom in scene.geoms[: scene.ngeom] if geom.rgba[3] > 0]
        for geom in sorted(geoms, key=self._distance, reverse=True):
            if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
                self._draw_ground(canvas, geom)
            else:
                self._draw_shape(canvas, geom)
        return np.array(image.resize(self._size, Image.Resampling.LANCZOS))

    def _look(self, camera: mujoco.MjvGLCamera) -> None:
        forward, up = np.array(camera.forward, dtype=float), np.array(camera.up, dtype=float)
        self._eye = np.array(camera.pos, dtype=float)
        self._axes = np.stack([np.cross(forward, up), up, forward])
        self._near = camera.frustum_near
        # Pixels per unit of (height above the axis / depth).
        self._focal = (
            self._size[1] * OVERSAMPLING * camera.frustum_near / (camera.frustum_top - camera.frustum_bottom)
        )

    def _distance(self, geom: mujoco.MjvGeom) -> float:
        """Depth of a shape's middle; ground lies behind everything."""
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            return np.inf
        return float(self._axes[2] @ (np.array(geom.pos) - self._eye))

    def _project(self, points: Points) -> Points | None:
        """Pixels [n, 2] of points [n, 3] in space, or None if some lie behind the eye."""
        x, y, depth = self._axes @ (points - self._eye).T
        if depth.min() <= self._near:
            return None
        middle = np.array(self._size) * OVERSAMPLING / 2
        return middle + self._focal * np.stack([x / depth, -y / depth], axis=-1)

    def _draw_shape(self, canvas: ImageDraw.ImageDraw, geom: mujoco.MjvGeom) -> None:
        size, middle = np.array(geom.size, dtype=float), np.array(geom.pos, dtype=float)
        points = surface(geom.type, size)
        if points is None:
            return
        pixels = self._project(points @ np.array(geom.mat, dtype=float).reshape(3, 3).T + middle)
        if pixels is None:
            return
        outline = hull(pixels)
        colour = np.array(geom.rgba[:3], dtype=float)
        canvas.polygon(_flat(outline), fill=_rgb(colour), outline=_rgb(0.6 * colour), width=OVERSAMPLING)
        if geom.type != mujoco.mjtGeom.mjGEOM_BOX:  # a gleam makes round things round
            radius = self._focal * size[0] / self._distance(geom)
            centre = outline.mean(axis=0) + 0.35 * radius * self._axes[:2] @ SUN * (1, -1)
            canvas.polygon(_flat(centre + 0.5 * (outline - outline.mean(axis=0))), _rgb(0.75 * colour + 0.25))

    def _draw_ground(self, canvas: ImageDraw.ImageDraw, geom: mujoco.MjvGeom) -> None:
        """A chequered floor of fixed tiles around where the camera looks, without those behind the eye."""
        mat, pos = np.array(geom.mat, dtype=float).reshape(3, 3), np.array(geom.pos, dtype=float)
        half = np.array([extent or np.inf for extent in geom.size[:2]], dtype=float)
        tile = min(LARGEST_TILE, half.min() / 6)
        first = np.floor(self._aim(mat, pos) / tile).astype(int) - GROUND_TILES // 2
        lines = (first[:, None] + np.arange(GROUND_TILES + 1)) * tile
        xs, ys = np.clip(lines, -half[:, None], half[:, None])
        for i, j in itertools.product(range(GROUND_TILES), repeat=2):
            square = np.array([(xs[i + a], ys[j + b], 0) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))])
            pixels = self._project(square @ mat.T + pos)
            if pixels is not None and xs[i] < xs[i + 1] and ys[j] < ys[j + 1]:
                canvas.polygon(_flat(pixels), fill=TILES[(first.sum() + i + j) % 2])

    def _aim(self, mat: Points, pos: Points) -> Points:
        """Where on a plane the camera looks, in the plane's coordinates [2]."""
        forward = self._axes[2]
        steepness = forward @ mat[:, 2]
        away = (pos - self._eye) @ mat[:, 2] / steepness if abs(steepness) > 1e-9 else np.inf
        away = away if 0 < away < FARTHEST_FOCUS else FOCUS
        return ((self._eye + away * forward - pos) @ mat)[:2]


def _flat(polygon: Points) -> list[tuple[float, float]]:
    return [(x, y) for x, y in polygon.tolist()]


def _rgb(colour: Points) -> tuple[int, int, int]:
    red, green, blue = (np.clip(colour, 0, 1) * 255).astype(int).tolist()
    return red, green, blue
