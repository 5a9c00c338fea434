"""Moving the tasks' arms about: by a step, to a posture, and as an expert does."""

import numpy as np

from nht.envs.wam_kinematics import damped_solve, forward_kinematics, tool_pose
from nht.envs.wam_wipe import DOWN, START_POSTURE

STILL = np.zeros(7)


def step(task, actuation=STILL):
    return task.step(np.broadcast_to(actuation, (task.num_envs, 7)))


def posture_at(position, normal=DOWN):
    """A posture with the tool face at ``position`` and its normal along ``normal``, by Newton's method."""
    posture = START_POSTURE[None]
    for _ in range(50):
        pose = forward_kinematics(posture)
        error = np.concatenate([position - pose.position, (normal - pose.normal)[:, :2]], axis=1)
        jacobian = np.concatenate([pose.linear_jacobian(), pose.normal_jacobian()[:, :2]], axis=1)
        posture = posture + damped_solve(jacobian, error)
    reached = tool_pose(posture)
    np.testing.assert_allclose(reached[0][0], position, atol=1e-9)
    np.testing.assert_allclose(reached[1][0], normal, atol=1e-9)
    return posture


def drive(task, expert):
    """Until every copy has been at its goal or failed: whether it succeeded, failed, and after how many steps."""
    succeeded, failed = np.zeros((2, task.num_envs), dtype=bool)
    length = np.zeros(task.num_envs)
    for _ in range(task.max_episode_steps):
        length += ~succeeded
        outcome = task.step(expert(task.observe()))
        succeeded |= outcome.success
        failed |= outcome.failure
        if (succeeded | failed).all():
            break
    return succeeded, failed, length
