"""Models whose posterior is known, and guides and scales that are wrong by a known amount."""

from __future__ import annotations

from types import SimpleNamespace

import pyro
import pytest
import torch
from pyro import distributions
from pyro.nn import PyroModule
from torch import Tensor

from cavin_pyro.criticism.guide import simulate
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.windows import all_pushes, sampled_values, seeded
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.guides.none import NoGuide
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.dynamics_only import DynamicsModel
from cavin_pyro.models.likelihoods import LikelihoodScales
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.models.state import State, Window

NOISE = 0.5
PRECISION = 1 / NOISE**2


def normal(mean: Tensor, scale: float) -> distributions.TorchDistribution:
    return distributions.Normal(mean, torch.as_tensor(scale, dtype=mean.dtype)).to_event(1)


class SceneModel(PyroModule):
    """c ~ N(10 s, I), s' ~ N(c, 0.25 I), z ~ N(0, I), three pushes ~ N(z, 0.25 I) each; the next states stay at zero.

    s and s' are the centres of one object. `shuffled`: the prior is that of another scene.
    """

    codes = ("effect_code", "motion_code")

    def __init__(self, shuffled: bool = False) -> None:
        super().__init__()
        self.shuffled = shuffled

    def generate(self, window: Window) -> None:
        self(window.initial)

    def forward(self, window: Window) -> None:
        mean = scene_mean(window).roll(int(self.shuffled), 0)
        with pyro.plate("windows", len(mean)):
            c = pyro.sample("effect_code", normal(mean, 1.0))
            last = window.last
            goal = distributions.Normal(c.unsqueeze(-2), NOISE).to_event(2)
            pyro.sample("subgoal_centers", goal, obs=window.observed(last.centers))
            still = distributions.Normal(torch.zeros_like(last.features), 0.1).to_event(2)
            pyro.sample("subgoal_features", still, obs=window.observed(last.features))
            z = pyro.sample("motion_code", normal(torch.zeros_like(window.actions[:, 0]), 1.0))
            pushes = distributions.Normal(z.unsqueeze(-2).expand(*z.shape[:-1], 3, 4), NOISE).to_event(2)
            pyro.sample("actions", pushes, obs=window.observed(window.actions))
        for push in (1, 2, 3):
            pyro.deterministic(f"next_centers_{push}", torch.zeros(len(mean), 1, 3), event_dim=2)
            pyro.deterministic(f"next_features_{push}", torch.ones(len(mean), 1, 2), event_dim=2)


class SceneGuide(PyroModule):
    """The posterior of `SceneModel`, with its deviations multiplied by `stretch`; `blind`: N(10 s + shift, I) for c."""

    def __init__(self, stretch: float = 1.0, *, blind: bool = False, shift: float = 0.0) -> None:
        super().__init__()
        self.stretch, self.blind, self.shift = stretch, blind, shift

    def forward(self, window: Window) -> None:
        mean = scene_mean(window) + self.shift
        after = (mean + PRECISION * window.last.centers[:, 0]) / (1 + PRECISION)
        with pyro.plate("windows", len(mean)):
            q = normal(mean, 1.0) if self.blind else normal(after, self.stretch * (1 + PRECISION) ** -0.5)
            pyro.sample("effect_code", q)
            pushes = PRECISION * window.actions.sum(-2) / (1 + 3 * PRECISION)
            pyro.sample("motion_code", normal(pushes, self.stretch * (1 + 3 * PRECISION) ** -0.5))


def scene_mean(window: Window) -> Tensor:
    return 10 * window.first.centers[:, 0]


def scene_context(guide: PyroModule, *, shuffled: bool = False, batch: int = 600, each: int = 2) -> CheckContext:
    """Windows of `SceneModel`, `each` of an episode, for a model whose prior may be shuffled."""
    generator = torch.Generator().manual_seed(3)
    centers = 0.3 * torch.randn(batch, 1, 1, 3, generator=generator).expand(-1, 4, -1, -1)
    ones = torch.ones(batch, 4, 1, dtype=torch.bool)
    seen = torch.ones(batch, 3, dtype=torch.bool)
    blank = Window(State(centers, torch.ones(batch, 4, 1, 2), ones), torch.zeros(batch, 3, 4), seen, seen[:, 0])
    with seeded(4):
        _, window = simulate(SceneModel(), blank)
    episodes = torch.arange(batch) // each
    return CheckContext(
        SceneModel(shuffled), guide, PointNet(feature_dimension=2), window, window, validation_episodes=episodes
    )


SIZES = {"space": SPACE, "feature_dimension": 4, "width": 8, "maximum_objects": 3}
COUNT = 400


def cascade_of(center: float = 0.01, feature: float = 0.1) -> CascadedModel:
    """A small cascade whose codes matter, with these scales; always the same weights."""
    torch.manual_seed(1)
    scales = LikelihoodScales(SPACE, center=center, feature=feature)
    model = CascadedModel(**SIZES, effect_dimension=2, motion_dimension=2, scales=scales)
    with torch.no_grad():
        model.meta_dynamics.change.head.weight.mul_(5.0)
    return model.requires_grad_(False).eval()


def generated_by(model: CascadedModel, part: str) -> Window:
    """400 windows sampled from the program, whose last states are f's or h's."""
    torch.manual_seed(2)
    mask = torch.ones(COUNT, 4, 3, dtype=torch.bool)
    mask[::3, :, 2] = False
    centers = torch.rand(COUNT, 1, 3, 3).expand(-1, 4, -1, -1) * torch.tensor([0.4, 0.8, 0.05])
    features = torch.nn.functional.normalize(torch.randn(COUNT, 1, 3, 4), dim=-1).expand(-1, 4, -1, -1)
    counts = torch.ones(COUNT, 3, dtype=torch.bool)
    blank = Window(State(centers, features, mask), torch.zeros(COUNT, 3, 4), counts, counts[:, 0])
    values = sampled_values(model.generate, blank)
    after, kinds = (all_pushes(values, site) for site in ("next_centers", "next_features"))
    if part == "h":
        after[:, -1], kinds[:, -1] = values["subgoal_centers"], values["subgoal_features"]
    kinds[:, :-1] = torch.nn.functional.normalize(kinds[:, :-1], dim=-1)  # as f reads them
    states = State(torch.cat((centers[:, :1], after), 1), torch.cat((features[:, :1], kinds), 1), mask)
    return blank._replace(states=states, actions=values["actions"])


def cascade_context(model: CascadedModel, window: Window) -> CheckContext:
    """The model with an untrained guide; the same windows for training and validation."""
    guide = CascadedGuide(cascade_of(), width=8).requires_grad_(False)
    return CheckContext(model, guide, PointNet(), training=window, validation=window, seed=3)


@pytest.fixture(scope="session")
def right() -> SimpleNamespace:
    """A cascade, windows that it has generated itself, and the same cascade with other scales."""
    with torch.no_grad(), pyro.settings.context(module_local_params=True):
        model = cascade_of()
        windows = {part: generated_by(model, part) for part in ("f", "h")}
        alone = DynamicsModel(**SIZES).requires_grad_(False)
        dynamics = CheckContext(alone, NoGuide(alone), PointNet(), windows["f"], windows["f"])
    return SimpleNamespace(context=cascade_context, dynamics=dynamics, make=cascade_of, model=model, windows=windows)


@pytest.fixture(scope="session")
def scenes() -> SimpleNamespace:
    """A known cascade whose prior depends on the state, and what goes with it."""
    return SimpleNamespace(model=SceneModel, guide=SceneGuide, context=scene_context, precision=PRECISION)


@pytest.fixture
def cascade(small: SimpleNamespace) -> CheckContext:
    """An untrained cascade of width 8 with random windows, in float64."""
    parts = small.parts()
    model, guide = parts["model"].double().requires_grad_(False), parts["guide"].double().requires_grad_(False)

    def windows(batch: int) -> Window:
        centers = torch.rand(batch, 4, 5, 3, dtype=torch.float64)
        features = torch.nn.functional.normalize(torch.randn(batch, 4, 5, 64, dtype=torch.float64), dim=-1)
        mask = (torch.arange(5) < torch.randint(2, 5, (batch, 1))).unsqueeze(1).expand(batch, 4, 5)
        actions = 2 * torch.rand(batch, 3, 4, dtype=torch.float64) - 1
        seen = torch.ones(batch, 3, dtype=torch.bool)
        return Window(State(centers, features, mask), actions, seen, seen[:, 0].clone())

    return CheckContext(model, guide, parts["geometry"], windows(12), windows(14))
