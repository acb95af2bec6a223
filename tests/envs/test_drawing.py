"""The plain drawing's geometry."""

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from envs.drawing import hull, surface

SHAPES = {  # shape -> how far it reaches if its size is (0.3, 0.3, 0.7)
    mujoco.mjtGeom.mjGEOM_SPHERE: (0.3, 0.3, 0.3),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: (0.3, 0.3, 0.7),
    mujoco.mjtGeom.mjGEOM_BOX: (0.3, 0.3, 0.7),
    mujoco.mjtGeom.mjGEOM_CAPSULE: (0.3, 0.3, 1.0),
    mujoco.mjtGeom.mjGEOM_CYLINDER: (0.3, 0.3, 0.7),
}


@pytest.mark.parametrize("size", [3, 4, 10, 200])
def test_a_hull_is_scipys(size):
    points = np.random.default_rng(size).normal(size=(size, 2))
    expected = points[ConvexHull(points).vertices]
    assert {tuple(point) for point in hull(points)} == {tuple(point) for point in expected}


@pytest.mark.parametrize(("shape", "reach"), SHAPES.items())
def test_surface_points_reach_as_far_as_the_shape(shape, reach):
    # A sphere's third size says nothing; MuJoCo repeats the radius.
    size = np.array(reach) if shape == mujoco.mjtGeom.mjGEOM_SPHERE else np.array([0.3, 0.3, 0.7])
    points = surface(int(shape), size)
    # Circles are drawn as polygons, which fall short of them by a few per cent.
    np.testing.assert_allclose(np.abs(points).max(axis=0), reach, rtol=0.05)


def test_a_plane_has_no_surface_points():
    assert surface(int(mujoco.mjtGeom.mjGEOM_PLANE), np.ones(3)) is None
