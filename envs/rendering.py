"""Pictures of a simulation: by OpenGL where the machine has it, by a plain drawing where it has not.

A `Picture` holds the whole model of a task (the simulated one is stripped of what only the eye needs), puts a
state into it and draws. OpenGL without a screen comes from EGL or OSMesa; `MUJOCO_GL` (egl, osmesa, glfw, or
disable) overrides the choice.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco takes its names from compiled modules, which pyright cannot read)

import importlib
import warnings

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.drawing import Sketch
from envs.models import load
from envs.opengl import choose_platform
from envs.task import Task

MAX_GEOMS = 1000
CAMERAS = ("view", "track")  # the first of them that a model has is used, else MuJoCo's free camera

NO_OPENGL = (
    "no OpenGL library for drawing without a screen, so frames are plain sketches ({reason}); "
    "for the full picture on Debian or Ubuntu: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri, "
    "then run with MUJOCO_GL=egl"
)


class OpenGL:
    """Drawing by MuJoCo's renderer into an invisible buffer.

    Raises:
        OSError, ImportError, RuntimeError, AttributeError: where the machine cannot do it; which of them
            depends on what is missing.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        platform = choose_platform()
        self._gl = importlib.import_module(f"mujoco.{platform}").GLContext(width, height)
        self._gl.make_current()
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._viewport = mujoco.MjrRect(0, 0, width, height)

    def frame(self, scene: mujoco.MjvScene) -> NDArray[np.uint8]:
        """[height, width, 3] pixels."""
        self._gl.make_current()
        pixels = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._viewport, scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._viewport, self._context)
        return pixels[::-1].copy()  # OpenGL's first row is the lowest


class Picture:
    """Draws states of a task in one size.

    Args:
        task: the task.
        width, height: size in pixels.
    """

    def __init__(self, task: Task, width: int, height: int) -> None:
        self._model, self._pose = load(task.scene), task.pose
        model = self._model
        self._data = mujoco.MjData(model)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        self._camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, self._camera)
        named = {model.camera(i).name: i for i in range(model.ncam)}
        for name in CAMERAS:
            if name in named:
                self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
                self._camera.fixedcamid = named[name]
                break
        self._drawing = drawing(model, width, height)

    def frame(self, qpos: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The picture of positions [nq]: [height, width, 3] pixels."""
        self._pose(self._model, self._data, qpos)
        mujoco.mj_forward(self._model, self._data)
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            mujoco.MjvOption(),
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        return self._drawing.frame(self._scene)


class Pictures:
    """Draws states of a task in any size; what drawing needs is made when it is first asked for."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._sizes: dict[tuple[int, int], Picture] = {}

    def frame(self, qpos: NDArray[np.float64], width: int = 480, height: int = 480) -> NDArray[np.uint8]:
        """The picture of positions [nq]: [height, width, 3] pixels."""
        if (width, height) not in self._sizes:
            self._sizes[width, height] = Picture(self._task, width, height)
        return self._sizes[width, height].frame(qpos)


def drawing(model: mujoco.MjModel, width: int, height: int) -> OpenGL | Sketch:
    """OpenGL if it works here, else a sketch and, once a process, a warning that says how to get OpenGL."""
    try:
        return OpenGL(model, width, height)
    except (OSError, ImportError, RuntimeError, AttributeError, mujoco.FatalError) as error:
        warnings.warn(NO_OPENGL.format(reason=error), stacklevel=2)
        return Sketch(width, height)
