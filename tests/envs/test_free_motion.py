"""Laws of turns, and a tumbling body against MuJoCo's own Runge-Kutta step."""

import mujoco
import numpy as np
import pytest

from nht.envs.free_motion import moved, stage_velocity

BODY = """
<mujoco><option integrator="RK4" timestep="0.02"/><worldbody>
  <body pos="0 0 5"><freejoint/><geom type="box" size=".1 .2 .4"/></body>
</worldbody></mujoco>
"""


def some(count=20, turns=3.0):
    generator = np.random.default_rng(0)
    q = generator.normal(size=(count, 7))
    q[:, 3:] /= np.linalg.norm(q[:, 3:], axis=1, keepdims=True)
    return q, *(generator.normal(size=(2, count, 6)) * turns)


@pytest.mark.parametrize("turns", [1e-6, 1e-4, 1.0, 3.0])
def test_to_turn_on_is_to_change_the_turn_by_the_stages_velocity(turns):
    q, way, v = some(turns=turns)
    v *= 1 / turns
    step, time = 1e-6, 0.5
    ends = [
        moved(moved(q, way, time), v, sign * step)
        - moved(q, way + stage_velocity(v, way, time, True) * sign * step / time, time)
        for sign in (1, -1)
    ]
    np.testing.assert_allclose((ends[0] - ends[1])[:, 3:] / step, 0, atol=1e-8)


def test_uncorrected_it_is_the_velocity():
    _, way, v = some()
    assert stage_velocity(v, way, 0.1, False) is v


def test_a_tumbling_body_moves_as_in_mujoco():
    model = mujoco.MjModel.from_xml_string(BODY)
    data, step = mujoco.MjData(model), model.opt.timestep

    def acceleration(q, v):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        return data.qacc[None].copy()

    for q, v_1, _ in zip(*some(turns=8.0), strict=True):
        q, v_1 = q[None], v_1[None]
        v_2 = v_1 + step / 2 * acceleration(q, v_1)
        w_2 = stage_velocity(v_2, v_1, step / 2)
        v_3 = v_1 + step / 2 * acceleration(moved(q, v_1, step / 2), v_2)
        w_3 = stage_velocity(v_3, w_2, step / 2)
        v_4 = v_1 + step * acceleration(moved(q, w_2, step / 2), v_3)
        w_4 = stage_velocity(v_4, w_3, step)
        data.qpos[:], data.qvel[:] = q, v_1
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(
            moved(q, (v_1 + 2 * w_2 + 2 * w_3 + w_4) / 6, step)[0], data.qpos, atol=1e-13
        )
