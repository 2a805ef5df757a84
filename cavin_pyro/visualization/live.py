"""The loop behind the live view: `rollout`, whose goal and planner change between plans. It knows no browser."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from omegaconf import DictConfig

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.factory import make_runner, planner_of
from cavin_pyro.evaluation.rollout import EpisodeCallback
from cavin_pyro.models.state import State
from cavin_pyro.planning import Plan
from cavin_pyro.storage.checkpoint import load

AS_GIVEN = "as given"  # the planner of the command, beside the presets
UNLIMITED = 10**6  # steps: success, failure and the person at the page alone end an episode


class NextScene(BaseException):  # no error, and none of what `rollout` refuses
    """Ends an episode because another scene was asked for."""


class LiveLoop(EpisodeCallback):
    """Episode after episode. Another thread asks for changes with `ask`; the next plan follows them.

    It is the planner of its own rollouts: before each plan it waits while paused, and does what was asked.

    `config`: of the command `plan`. `say`: told in a line what happens. `plans`: to make before the first pause.
    """

    def __init__(self, config: DictConfig, *, say: Callable[[str], None] = print, plans: float = 0) -> None:
        self.config, self.say, self.seed, self.plans = copy.deepcopy(config), say, int(config.seed), plans
        self.runner = make_runner(copy.deepcopy(config), render=True)
        self.world, self.planner = self.runner.env, self.runner.planner
        self.segment_length = self.planner.segment_length
        self.world.maximum_steps = UNLIMITED
        self._model = None if config.planner.get("model_free") else load(config.checkpoint, trust=config.trust).model
        self._given, self._reward = config.planner, None  # no reward: the goal has moved since
        self.chosen = AS_GIVEN  # of `planner=`
        self._asked: dict[str, Any] = {}
        self._changed = threading.Condition()

    def ask(self, **changes: Any) -> None:
        """Any of: goals [n, 2 or 3], planner (name of a preset), samples, plans (to make; inf: go on), scene (seed)."""
        with self._changed:
            self._asked.update(changes)
            self._changed.notify_all()

    def run(self, *callbacks: EpisodeCallback) -> None:
        """Run until interrupted. An episode that ended goes on from where it ended once its goal is moved."""
        runner, self._observation = replace(self.runner, planner=self), None
        while True:
            self._reward, start = None, self._observation
            try:
                episode = runner.rollout(self.seed, callbacks=[self, *callbacks], start=start)
                self.say(f"{episode.outcome}: move the goal, or take the next scene")
                while "goals" not in self._take(wait=True):
                    pass
            except NextScene:
                self._observation = None
                self.say("next scene")

    def on_observation(self, observation: Any) -> None:
        """Keep it, to go on from there."""
        self._observation = observation

    def plan(self, state: State, **given: Any) -> Plan:
        """See `cavin_pyro.planning.Planner`; the reward is that of the goal where it lies now."""
        self._take()
        while self.plans < 1:
            self._take(wait=True)
        self.plans -= 1
        self._reward = self._reward or self.world.goal(self.runner.device)
        return self.planner.plan(state, **{**given, "reward": self._reward, "steps_left": None})

    def _take(self, *, wait: bool = False) -> set[str]:
        """Do what was asked, and return the names of what was done. Errors are said, and change nothing."""
        with self._changed:
            while wait and not self._asked:
                self._changed.wait(0.2)  # seconds, so that Ctrl-C is heard
            asked, self._asked, done = self._asked, {}, set[str]()
        self.plans = asked.pop("plans", self.plans)
        if "scene" in asked:
            self.seed = int(asked["scene"])
            raise NextScene
        for names, change in (({"goals"}, self._move), ({"planner", "samples"}, self._choose)):
            if given := {name: asked[name] for name in names & set(asked)}:
                try:
                    self.say(change(**given))
                    done |= set(given)
                except (UserError, ValueError) as error:
                    self.say(str(error))
        return done

    def _move(self, goals: Any) -> str:
        self.world.move_goals(np.asarray(goals, dtype=np.float64))
        self._reward = None
        return "goal moved: the next plan goes there"

    def _choose(self, planner: str | None = None, samples: int | None = None) -> str:
        """Another planner for the checkpoint at hand, or another number of its samples."""
        config = copy.deepcopy(self.config)
        if planner is not None:
            config.planner = self._given if planner == AS_GIVEN else compose("plan", planner=planner).planner
        if "samples" in config.planner:
            config.planner.samples = int(samples or self.config.planner.get("samples", config.planner.samples))
        actions = self.world.space.actions
        self.planner = planner_of(config, self._model, self.runner.device, action_dimension=actions)
        self.config, self.chosen = config, planner or self.chosen
        return f"{type(self.planner).__name__}, {config.planner.get('samples', 'no')} samples, from the next plan on"
