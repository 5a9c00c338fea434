"""Every task by its Gymnasium id.

Gymnasium knows them after ``import nht.envs``, or where an id names the module: ``"nht.envs:nht/WAMWipe-v0"``.
"""

from __future__ import annotations

from gymnasium.envs.registration import register as register_env
from gymnasium.envs.registration import registry

from nht.envs.registry import TASKS


def gymnasium_id(task: str) -> str:
    """Gymnasium's id of a task: ``"pour_tea"`` is ``"nht/PourTea-v0"``, unless our table says otherwise."""
    own = TASKS.own(task)
    if own is not None and own.gymnasium_id is not None:
        return own.gymnasium_id
    return f"nht/{''.join(word.capitalize() for word in task.split('_'))}-v0"


def register() -> None:
    """Make every task of the table known to ``gymnasium.make`` and ``gymnasium.make_vec``, with its time limit.

    Tasks of installed packages are imported only when they are made; their limit is the task's own.
    """
    for task in TASKS:
        if (name := gymnasium_id(task)) in registry:
            continue
        own = TASKS.own(task)
        limit = None if own is None else own.max_episode_steps
        register_env(
            name,
            entry_point="nht.envs.gymnasium_env:GymnasiumEnv",
            vector_entry_point="nht.envs.gymnasium_vector:GymnasiumVectorEnv",
            kwargs={"task": task} | ({"max_episode_steps": None} if limit is None else {}),
            max_episode_steps=limit,
        )
