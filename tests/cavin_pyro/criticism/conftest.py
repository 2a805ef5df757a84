"""A cascade whose posterior and evidence are known, and guides for it that are wrong by a known amount."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pyro
import pytest
import torch
from pyro import distributions
from pyro.nn import PyroModule
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.inference.simulation import simulate
from cavin_pyro.criticism.statistics.windows import seeded
from models.networks.pointnet import PointNet
from models.state import State, Window

NOISE = 0.5
PRECISION = 1 / NOISE**2
# Orthogonal but for its length, so that the posteriors have diagonal covariances.
COUPLING = 0.8 * torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64)
EFFECT_PRECISION = 1 + PRECISION + 0.64 / (1 + NOISE**2)


def normal(mean: Tensor, scale: float) -> distributions.TorchDistribution:
    return distributions.Normal(mean, torch.as_tensor(scale, dtype=mean.dtype)).to_event(1)


class LinearModel(PyroModule):
    """c ~ N(0, I), x ~ N(c, 0.25 I), z ~ N(0, I), y ~ N(z + A c, 0.25 I), in two dimensions each.

    x and y are the starts and the motions of a window's first push.
    """

    codes = ("effect_code", "motion_code")

    def forward(self, window: Window) -> None:
        x, y = window.actions[:, 0].split(2, -1)
        with pyro.plate("windows", len(x)):
            c = pyro.sample("effect_code", normal(torch.zeros_like(x), 1.0))
            pyro.sample("subgoal_centers", normal(c, NOISE), obs=x)
            z = pyro.sample("motion_code", normal(torch.zeros_like(x), 1.0))
            pyro.sample("actions", normal(z + c @ COUPLING.T, NOISE), obs=y)


class OneCodeModel(PyroModule):
    """c ~ N(0, I), x ~ N(c, 0.25 I)."""

    codes = ("effect_code",)

    def forward(self, window: Window) -> None:
        x = window.actions[:, 0, :2]
        with pyro.plate("windows", len(x)):
            c = pyro.sample("effect_code", normal(torch.zeros_like(x), 1.0))
            pyro.sample("subgoal_centers", normal(c, NOISE), obs=x)


class NoCodeModel(PyroModule):
    """x ~ N(0, 1.25 I)."""

    codes = ()

    def forward(self, window: Window) -> None:
        x = window.actions[:, 0, :2]
        with pyro.plate("windows", len(x)):
            pyro.sample("subgoal_centers", normal(torch.zeros_like(x), math.sqrt(1 + NOISE**2)), obs=x)


class LinearGuide(PyroModule):
    """The posterior, with c moved by `shift` of its deviations and its deviation multiplied by `stretch`."""

    def __init__(self, shift: float = 0.0, stretch: float = 1.0) -> None:
        super().__init__()
        self.shift, self.stretch = shift, stretch

    def forward(self, window: Window) -> None:
        x, y = window.actions[:, 0].split(2, -1)
        mean = (PRECISION * x + y @ COUPLING / (1 + NOISE**2)) / EFFECT_PRECISION
        deviation = EFFECT_PRECISION**-0.5
        with pyro.plate("windows", len(x)):
            c = pyro.sample("effect_code", normal(mean + self.shift * deviation, self.stretch * deviation))
            z_mean = PRECISION * (y - c @ COUPLING.T) / (1 + PRECISION)
            pyro.sample("motion_code", normal(z_mean, (1 + PRECISION) ** -0.5))


class BlindGuide(PyroModule):
    """Codes N(shift, 1), whatever the window."""

    def __init__(self, shift: float = 0.0) -> None:
        super().__init__()
        self.shift = shift

    def forward(self, window: Window) -> None:
        x = window.actions[:, 0, :2]
        with pyro.plate("windows", len(x)):
            for name in ("effect_code", "motion_code"):
                pyro.sample(name, normal(torch.full_like(x, self.shift), 1.0))


class OneCodeGuide(PyroModule):
    """The posterior of `OneCodeModel`."""

    def forward(self, window: Window) -> None:
        x = window.actions[:, 0, :2]
        with pyro.plate("windows", len(x)):
            pyro.sample("effect_code", normal(PRECISION * x / (1 + PRECISION), (1 + PRECISION) ** -0.5))


class NoGuide(PyroModule):
    """Draws nothing."""

    def forward(self, window: Window) -> None: ...


class SceneModel(PyroModule):
    """c ~ N(10 s, I), s' ~ N(c, 0.25 I), z ~ N(0, I), three pushes ~ N(z, 0.25 I) each; the next states stay at zero.

    s and s' are the centres of one object. `shuffled`: the prior is that of another scene.
    """

    codes = ("effect_code", "motion_code")

    def __init__(self, shuffled: bool = False) -> None:
        super().__init__()
        self.shuffled = shuffled

    def forward(self, window: Window, generate: bool = False) -> None:
        mean = scene_mean(window).roll(int(self.shuffled), 0)
        with pyro.plate("windows", len(mean)):
            c = pyro.sample("effect_code", normal(mean, 1.0))
            last = window.last
            after, kind = (None, None) if generate else (last.centers, last.features)
            pyro.sample("subgoal_centers", distributions.Normal(c.unsqueeze(-2), NOISE).to_event(2), obs=after)
            still = torch.zeros_like(last.features)
            pyro.sample("subgoal_features", distributions.Normal(still, 0.1).to_event(2), obs=kind)
            z = pyro.sample("motion_code", normal(torch.zeros_like(window.actions[:, 0]), 1.0))
            pushes = distributions.Normal(z.unsqueeze(-2).expand(*z.shape[:-1], 3, 4), NOISE).to_event(2)
            pyro.sample("actions", pushes, obs=None if generate else window.actions)
        if generate:
            pyro.deterministic("next_centers", torch.zeros(len(mean), 3, 1, 3), event_dim=3)
            pyro.deterministic("next_features", torch.ones(len(mean), 3, 1, 2), event_dim=3)


class SceneGuide(PyroModule):
    """The posterior of `SceneModel`, with its deviations multiplied by `stretch`; `blind`: N(10 s + shift, I) for c."""

    def __init__(self, stretch: float = 1.0, *, blind: bool = False, shift: float = 0.0, reads: float = 0.0) -> None:
        super().__init__()
        self.stretch, self.blind, self.shift, self.reads = stretch, blind, shift, reads

    def forward(self, window: Window) -> None:
        mean = scene_mean(window) + self.shift
        after = (mean + PRECISION * window.last.centers[:, 0]) / (1 + PRECISION)
        after = after + self.reads * window.actions[:, 0, :3]
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


def covariance() -> Tensor:
    """Of (x, y): [4, 4]."""
    eye = torch.eye(2, dtype=torch.float64)
    across = COUPLING.T
    upper = torch.cat(((1 + NOISE**2) * eye, across), 1)
    lower = torch.cat((across.T, (1 + NOISE**2) * eye + COUPLING @ COUPLING.T), 1)
    return torch.cat((upper, lower))


def evidence(window: Window) -> Tensor:
    """log p(x, y) of each window: [B]."""
    zero = torch.zeros(4, dtype=torch.float64)
    return torch.distributions.MultivariateNormal(zero, covariance()).log_prob(window.actions[:, 0])


def linear_windows(batch: int, seed: int = 0) -> Window:
    """Windows `[B]` sampled from `LinearModel`."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(batch, 4, generator=generator, dtype=torch.float64)
    actions = (noise @ torch.linalg.cholesky(covariance()).T).unsqueeze(1).expand(batch, 3, 4)
    state = State(torch.zeros(batch, 4, 1, 3), torch.zeros(batch, 4, 1, 2), torch.ones(batch, 4, 1, dtype=torch.bool))
    seen = torch.ones(batch, 3, dtype=torch.bool)
    return Window(state, actions.clone(), seen, seen[:, 0].clone())


def linear_context(guide: PyroModule, *, model: PyroModule | None = None, batch: int = 200) -> CheckContext:
    pointnet = PointNet(feature_dimension=2)
    return CheckContext(model or LinearModel(), guide, pointnet, linear_windows(batch, 1), linear_windows(batch, 2))


@pytest.fixture(scope="session")
def linear() -> SimpleNamespace:
    """The known cascade and what goes with it."""
    return SimpleNamespace(
        blind=BlindGuide,
        effect_precision=EFFECT_PRECISION,
        evidence=evidence,
        guide=LinearGuide,
        model=LinearModel,
        no_code=lambda: linear_context(NoGuide(), model=NoCodeModel()),
        one_code=lambda: linear_context(OneCodeGuide(), model=OneCodeModel()),
        context=linear_context,
        windows=linear_windows,
    )


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

    return CheckContext(model, guide, parts["pointnet"], windows(12), windows(14))
