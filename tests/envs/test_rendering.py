"""Pictures, with OpenGL and without: right size, and showing what moved."""

import math
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

import envs
from envs import opengl


def opengl_works() -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            envs.make("pendulum-swingup").render()
        except UserWarning:
            return False
    return True


@pytest.fixture(params=["opengl", "sketch"])
def path(request, monkeypatch):
    """Each way of drawing in turn; OpenGL only where the machine has it."""
    if request.param == "sketch":
        monkeypatch.setenv("MUJOCO_GL", "disable")
        warnings.simplefilter("ignore")
    elif not opengl_works():
        pytest.skip("no OpenGL on this machine")
    return request.param


def picture(θ: float, **size: int) -> torch.Tensor:
    env = envs.make("pendulum-swingup", num_envs=2)
    env.place(torch.tensor([[[0.0], [θ]]]).double(), torch.zeros(1, 2, 1).double())
    return env.render(env=1, **size)


def red_centre(frame: torch.Tensor) -> tuple[float, float]:
    """Mean row and column of the pixels of the red bob."""
    red, green, blue = frame.int().unbind(-1)
    rows, columns = ((red > green + 60) & (red > blue + 60)).nonzero(as_tuple=True)
    return rows.double().mean().item(), columns.double().mean().item()


def test_a_frame_has_the_size_asked_for(path):
    frame = picture(1.0, width=160, height=120)
    assert frame.shape == (120, 160, 3)
    assert frame.dtype == torch.uint8


@pytest.mark.parametrize(("θ", "up", "right"), [(0.0, 1, 0), (math.pi, -1, 0), (math.pi / 2, 0, 1)])
def test_the_bob_is_drawn_where_it_is(path, θ, up, right):
    row, column = red_centre(picture(θ, width=200, height=200))
    pivot_row = np.mean([red_centre(picture(x, width=200, height=200))[0] for x in (0.0, math.pi)])
    assert np.sign(round((pivot_row - row) / 20)) == up
    assert np.sign(round((column - 100) / 20)) == right


def test_without_opengl_one_warning_names_what_to_install(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.warns(UserWarning, match="apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"):
        picture(0.0)


def test_missing_libraries_lead_to_a_sketch(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(opengl, "LIBRARIES", {"egl": "libNothing.so.1"})
    with pytest.warns(UserWarning, match="libNothing"):
        assert picture(0.0).float().std() > 1


def test_a_choice_of_opengl_that_is_not_there_does_not_break_the_import():
    """MuJoCo's own import fails where MUJOCO_GL names a library that is missing."""
    program = "import envs; e = envs.make('crane'); e.reset(); print(e.render(width=32, height=32).shape)"
    environment = os.environ | {"MUJOCO_GL": "osmesa", "PYTHONPATH": str(Path(envs.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "torch.Size([32, 32, 3])", done.stderr
