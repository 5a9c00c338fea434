"""A task that runs while people, or a policy, drive it: its state, without any viewer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from queue import SimpleQueue
from typing import Any

import torch
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from nht.recipes.live.commands import Commands
from nht.recipes.live.interfaces import Interface
from nht.recipes.live.pilot import Pilot
from nht.recipes.live.recording import Recorder

PERSON, POLICY = "person", "policy"
RUNNING, SUCCESS, FAILED, OVER = "running", "success", "failed", "time is up"


class Session:
    """One copy of a task, driven through one of several interfaces by a person or a policy.

    Other threads change it by ``post`` and ``commands`` only; all else belongs to the thread that steps.

    Args:
        base: the task itself, of batch size ``[1]``.
        interfaces: through which it can be driven, by name, the first one at the start.
        recorder: keeps what is done, if it is on.
        pilot: the policy that may drive; None is none.

    Attributes:
        observed: raw observations of the state, ``(1,)``.
        interface: through which a person drives.
        driver: who drives while nobody's hand is on the pad, ``"person"`` or ``"policy"``.
        driving: who drove the last step.
        action: of the last step, ``(1, k)``, through the interface of whoever drove.
        actuation: what the motors got in the last step, ``(1, n)``.
        steps: of the episode.
        episode: how many have begun.
        succeeded, failed: whether the state is a success; whether the episode has ever failed.
        ended: whether the episode has ended; the task then waits for a reset or the next goal.
        paused: whether the task stands still.
        speed: as a multiple of real time.
        goes_on: whether the next episode begins by itself, after an end or at the goal.
        message: what was last done or went wrong, for people to read.
        commands: what people ask for.
    """

    def __init__(
        self,
        base: EnvBase,
        interfaces: Mapping[str, Interface],
        recorder: Recorder,
        pilot: Pilot | None = None,
    ) -> None:
        self._base, self.interfaces, self.recorder, self.pilot = base, dict(interfaces), recorder, pilot
        self._posted: SimpleQueue[Callable[[Session], object]] = SimpleQueue()
        self.interface = next(iter(self.interfaces.values()))
        self.driver = self.driving = PERSON
        self.paused, self.goes_on, self.speed, self.episode, self.message = False, True, 1.0, 0, ""
        self.commands = Commands(self.interface.action_dim)
        self.next_goal()

    @property
    def task(self) -> Any:
        """The simulation behind the environment, see ``nht.envs.simulation``."""
        return self._base.task

    @property
    def base(self) -> EnvBase:
        """The task itself."""
        return self._base

    @property
    def seconds(self) -> float:
        """Simulated time of the episode [s]."""
        return self.steps * float(self.task.time_per_step)

    @property
    def outcome(self) -> str:
        """How the episode stands, in a word or three."""
        if self.failed:
            return FAILED
        if self.succeeded:
            return SUCCESS
        return OVER if self.ended else RUNNING

    @property
    def at_rest(self) -> bool:
        """Whether there is nothing left to do: the episode has ended, or the task is done."""
        return self.ended or (self.succeeded and not self.failed)

    def post(self, change: Callable[[Session], object]) -> None:
        """Let the thread that steps make a change before its next step."""
        self._posted.put(change)

    def settle(self) -> None:
        """Make the changes that were posted; what cannot be done becomes the message."""
        while not self._posted.empty():
            try:
                self._posted.get()(self)
            except (ValueError, OSError, RuntimeError, KeyError) as error:
                self.message = str(error.args[0] if isinstance(error, KeyError) else error)

    # What people ask for.

    def next_goal(self) -> None:
        """Begin an episode with a start and a goal of its own."""
        self.recorder.end_episode()
        self.observed = self._base.reset()
        self._start = (self.observed.clone(), self.task.state_dict() if self.task.can_resume else None)
        self._begin()

    def reset(self) -> None:
        """Begin the episode again, with the same start and goal where the task can be saved."""
        observed, state = self._start
        if state is None:
            return self.next_goal()
        self.recorder.end_episode()
        self._base.reset()  # clears what an adapter remembers of the episode
        self.task.load_state_dict(state)
        self.observed = observed.clone()
        self._begin()

    def _begin(self) -> None:
        self.steps, self.succeeded, self.failed, self.ended = 0, False, False, False
        self.reward = 0.0
        self.action = torch.zeros(1, self.interface.action_dim)
        self.actuation = self._base.action_spec.zero().reshape(1, -1)
        self.episode += 1

    def choose(self, name: str) -> None:
        """Drive through another interface from now on; the arm stays where it is.

        Raises:
            KeyError: if there is none of that name.
        """
        if name not in self.interfaces:
            raise KeyError(f"there is no interface {name!r}: choose from {list(self.interfaces)}.")
        self.interface = self.interfaces[name]
        self.commands.resize(self.interface.action_dim)
        if self.driving == PERSON:
            self.action = torch.zeros(1, self.interface.action_dim)

    def drive(self, driver: str) -> None:
        """Let a person or the policy drive; a person's hand takes over at any time.

        Raises:
            ValueError: if there is no policy, or no such driver.
        """
        if driver not in (PERSON, POLICY):
            raise ValueError(f"driver must be {PERSON} or {POLICY}, got {driver!r}.")
        if driver == POLICY and self.pilot is None:
            raise ValueError("there is no policy: start with run=FOLDER of a finished run.")
        self.driver = driver

    def record(self, on: bool) -> None:
        """Begin or stop to keep what is done; stopping ends the episode that is kept."""
        if not on:
            self.recorder.end_episode()
        self.recorder.on = on

    def save(self) -> None:
        """Write what was recorded to a folder of demonstrations."""
        self.recorder.end_episode()
        folder = self.recorder.save()
        self.message = f"saved in {folder}: python -m nht.recipes.train_map demos.path={folder}"

    # What time does.

    @torch.no_grad()
    def step(self) -> None:
        """Let one step of time pass, unless the task is paused or its episode has ended."""
        if self.paused or self.ended:
            return
        asked = self.commands.latest()
        self.driving = POLICY if self.driver == POLICY and not self.commands.held else PERSON
        if self.driving == POLICY and self.pilot is not None:
            through, self.action = self.pilot.interface, self.pilot.action(self.observed)
        else:
            through, self.action = self.interface, asked
        self.actuation = through.decode(self.action, self.observed)
        self.commands.reached()
        stepped = self._base.step(self.observed.clone(recurse=False).set("action", self.actuation))
        outcome = stepped["next"]
        self.recorder.add(self.observed, self.actuation, outcome)
        self.observed = step_mdp(stepped)
        self.steps += 1
        self.reward = float(outcome["reward"])
        self.succeeded = bool(outcome["success"].any())
        self.failed |= bool(outcome["failure"].any())
        self.ended = bool(outcome["done"].any())

    def value(self) -> float | None:
        """The return that the run's critic expects of the last action; None without a critic.

        What was done through another interface than the run's is valued as the run's map projects it.
        """
        if self.pilot is None or self.pilot.critic is None:
            return None
        own = self.pilot.interface
        action = own.map.encode(self.actuation, own.context(self.observed)).clamp(-1.0, 1.0)
        return self.pilot.critic.value(self.observed, action.float())

    def close(self) -> None:
        """Keep what is recorded and not saved yet, and release the simulator."""
        self.recorder.end_episode()
        if self.recorder.episodes:
            self.save()
            print(self.message)
        if not self._base.is_closed:
            self._base.close()
