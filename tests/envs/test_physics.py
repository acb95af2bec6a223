"""The simulators: what they remember, and that stripping a model changes nothing."""

import mujoco
import numpy as np

from envs import pendulum
from envs.models import stripped
from envs.physics import MujocoPhysics


def test_a_step_returns_the_state_before_it():
    physics = MujocoPhysics(stripped(pendulum.MODEL), copies=3, substeps=2, threads=1)
    physics.place(np.arange(3), *np.random.default_rng(0).random((2, 3, 1)))
    qpos, qvel = physics.qpos.copy(), physics.qvel.copy()
    physics.control.fill(1)
    before = physics.advance()
    np.testing.assert_array_equal(before.qpos, qpos)
    np.testing.assert_array_equal(before.qvel, qvel)
    assert (physics.qvel != qvel).all()


def test_the_stripped_model_moves_as_the_whole_one_bit_for_bit():
    whole = mujoco.MjModel.from_xml_path(str(pendulum.MODEL))
    batch = MujocoPhysics(stripped(pendulum.MODEL), copies=1, substeps=1, threads=1)
    data = mujoco.MjData(whole)
    batch.place(np.arange(1), np.ones((1, 1)), np.zeros((1, 1)))
    data.qpos[:] = 1
    for step in range(500):
        control = np.sin(step)
        batch.control.fill(control)
        batch.advance()
        data.ctrl[:] = control
        mujoco.mj_step(whole, data)
    assert batch.qpos.item() == data.qpos[0]
    assert batch.qvel.item() == data.qvel[0]
