"""Films of a run's policy, on the way and at its end; they change nothing of the training."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import GlobalRNGState
from torchrl.envs import EnvBase

from nht.recipes.agents.stacking import of_learner
from nht.recipes.agents.table import find_algorithm, name_of
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.folder import VIDEO_FILE, RunFolder
from nht.recipes.run.population import PopulationFolder
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.video import record_video

VIDEO_EPISODES = 3
FILMS = "films"
"""In a run's folder: where the films on the way are, named after the number of environment steps."""


class Filming:
    """Films the policy of every learner of a run.

    Args:
        folder: of the run.
        ranks: the processes that learn together; the first one films.
        envs: the run's environments.
    """

    def __init__(self, folder: RunFolder | PopulationFolder, ranks: Ranks, envs: RunEnvs) -> None:
        self._folder, self._ranks, self._envs = folder, ranks, envs
        self._every = folder.config.evaluation.video_every

    def on_the_way(self, policy: TensorDictModuleBase, frames: int) -> None:
        """Film if it is time; random numbers are drawn afterwards as if nobody had watched."""
        last = frames >= self._folder.config.algo.total_frames  # the film at the end shows it
        if self._every is None or frames % self._every or last or not self._ranks.first:
            return
        begun = time.perf_counter()
        for learner, member in self._folder.finished():  # all that have not been given up
            self._film(learner, member, policy, member.path / FILMS / f"{frames:012d}.mp4", frames)
        for member in self._folder.members:
            member.leave_out(time.perf_counter() - begun)

    def at_the_end(self, learner: int, member: RunFolder, policy: TensorDictModuleBase, frames: int) -> None:
        """Film the final policy of a learner, if its configuration says so."""
        if self._ranks.first and member.config.evaluation.video:
            self._film(learner, member, policy, member.path / VIDEO_FILE, frames)

    def _film(
        self, learner: int, member: RunFolder, policy: TensorDictModuleBase, path: Path, frames: int
    ) -> None:
        with undisturbed():
            env = self._envs.filmed(member.config, member.map, VIDEO_EPISODES)
            try:
                record_video(env, self._own(learner, member, policy, env), path)
                member.film(frames, path)
            except RuntimeError as error:  # a machine without OpenGL trains all the same
                print(f"no video: {error}")
                self._every = None
            finally:
                env.close()

    def _own(
        self, learner: int, member: RunFolder, policy: TensorDictModuleBase, env: EnvBase
    ) -> TensorDictModuleBase:
        """The policy of one learner."""
        if len(self._folder.members) == 1:
            return policy
        own = find_algorithm(name_of(type(member.config))).policy(env, member.config.algo)
        own.load_state_dict(of_learner(policy.state_dict(), learner))
        return own.to(self._ranks.device)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Within, random numbers may be drawn: those of torch, NumPy and Python are as before afterwards."""
    generators = GlobalRNGState()
    before = generators.state_dict()
    try:
        yield
    finally:
        generators.load_state_dict(before)
