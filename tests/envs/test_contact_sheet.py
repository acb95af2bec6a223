"""The picture of all tasks."""

import math

import numpy as np
import pytest

import envs
from envs.contact_sheet import COLUMNS, SIZE, contact_sheet


def test_every_task_has_its_place(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.warns(UserWarning, match="sketches"):
        sheet = np.asarray(contact_sheet())
    rows = math.ceil(len(envs.ALL) / COLUMNS)
    assert sheet.shape == (rows * SIZE, COLUMNS * SIZE, 3)
    tiles = sheet.reshape(rows, SIZE, COLUMNS, SIZE, 3).swapaxes(1, 2).reshape(-1, SIZE, SIZE, 3)
    assert [tile.std() > 1 for tile in tiles] == [place < len(envs.ALL) for place in range(len(tiles))]
