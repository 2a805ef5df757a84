"""The ELBO of the cascade against a second, plain computation that shares no code with it but the weights.

States are lists of objects, layers are matrices, relations are loops over pairs, contexts are repeated and
concatenated, densities are written out. Everything is in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from pyro import poutine
from pyro.infer import Trace_ELBO
from torch import Tensor

from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.state import State, Window

TABLE = torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)
Scene = tuple[list[Tensor], list[Tensor]]  # centers and features of the real objects


class Weights:
    """Layers by name."""

    def __init__(self, module: torch.nn.Module) -> None:
        self.named = dict(module.named_parameters())

    def linear(self, name: str, x: Tensor) -> Tensor:
        return self.named[f"{name}.weight"] @ x + self.named[f"{name}.bias"]

    def relu(self, name: str, x: Tensor) -> Tensor:
        return self.linear(name, x).clamp(min=0)

    def relu_of_two(self, first: str, second: str, x: Tensor, y: Tensor) -> Tensor:
        matrix = torch.cat([self.named[f"{first}.weight"], self.named[f"{second}.weight"]], 1)
        bias = self.named[f"{first}.bias" if f"{first}.bias" in self.named else f"{second}.bias"]
        return (matrix @ torch.cat([x, y]) + bias).clamp(min=0)


def encode(w: Weights, scene: Scene) -> list[Tensor]:
    encoded = []
    for i, (center, feature) in enumerate(zip(*scene, strict=True)):
        relation = torch.zeros(8, dtype=torch.float64)
        for j, other in enumerate(scene[0]):
            if j != i:
                hidden = w.relu("encoder.difference", (other - center) / 0.1)
                relation = relation + w.relu("encoder.relation.0", hidden)
        spatial = w.relu("encoder.spatial.0", (center - TABLE) / 0.1)
        encoded.append(torch.cat([spatial, w.relu("encoder.geometric.0", feature), relation]))
    return encoded


def effects(w: Weights, trunk: str, encoded: list[Tensor], context: Tensor) -> list[Tensor]:
    repeated = w.relu(f"{trunk}.context.0", context)
    hidden = [w.relu_of_two(f"{trunk}.from_state", f"{trunk}.from_context", own, repeated) for own in encoded]
    return [w.relu(f"{trunk}.second.0", own) for own in hidden]


def change(w: Weights, head: str, scene: Scene, effect: list[Tensor], reach: float) -> Scene:
    centers, features = [], []
    for center, feature, own in zip(*scene, effect, strict=True):
        numbers = w.linear(head, own)
        gate = 1 / (1 + torch.exp(-numbers[0]))
        centers.append(center + gate * reach * torch.tanh(numbers[1:4]))
        turned = feature + gate * numbers[4:]
        features.append(turned / turned.pow(2).sum().sqrt())
    return centers, features


def pool(w: Weights, name: str, effect: list[Tensor]) -> Tensor:
    scores = [torch.exp(w.named[f"{name}.weight"] @ own) for own in effect]
    return sum(score * own for score, own in zip(scores, effect, strict=True)) / sum(scores)


def softplus(x: Tensor) -> Tensor:
    return torch.log1p(torch.exp(x))


def pushes(w: Weights, effect: list[Tensor], z: Tensor) -> Tensor:
    mean, scale = w.linear("action_generator.transform", pool(w, "action_generator.pool.score", effect)).chunk(2)
    transformed = mean + softplus(scale) * z
    raw = {
        part: w.linear(f"action_generator.{part}.1", w.relu(f"action_generator.{part}.0.0", transformed))
        for part in ("starts", "motions")
    }
    starts, motions = 5 * torch.tanh(raw["starts"].view(3, 2) / 5), torch.tanh(raw["motions"].view(3, 2))
    return torch.cat([starts, motions], 1)


def q_h(w: Weights, s: Scene, goal: Scene) -> tuple[Tensor, Tensor]:
    total = torch.zeros(8, dtype=torch.float64)
    for center, feature, later, turned in zip(*s, *goal, strict=True):
        parts = [(center - TABLE) / 0.1, feature, (later - center) / 0.1, turned - feature]
        hidden = w.relu("effect_inference.objects.0.0", torch.cat(parts))
        total = total + w.relu("effect_inference.objects.1.0", hidden)
    feature = w.relu("effect_inference.scene.0", total)
    mean, scale = w.linear("effect_inference.code.head", feature).chunk(2)
    return mean, softplus(scale) + 1e-6


def q_g(w: Weights, encoded: list[Tensor], actions: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    effect = effects(w, "motion_inference.trunk", encoded, c)
    pooled = pool(w, "motion_inference.pool.score", effect)
    each = torch.cat([w.relu("motion_inference.pushes.0.0", action) for action in actions])
    name = "motion_inference"
    feature = w.relu_of_two(f"{name}.from_pooled", f"{name}.from_pushes", pooled, each)
    mean, scale = w.linear("motion_inference.code.head", feature).chunk(2)
    return mean, softplus(scale) + 1e-6


def log_normal(x: Tensor, mean: Tensor, scale: Tensor | float) -> Tensor:
    scale = torch.as_tensor(scale, dtype=torch.float64)
    return (-((x - mean) ** 2) / (2 * scale**2) - torch.log(scale) - math.log(2 * math.pi) / 2).sum()


def log_state(observed: Scene, mean: Scene) -> Tensor:
    total = torch.zeros((), dtype=torch.float64)
    for center, feature, mean_center, mean_feature in zip(*observed, *mean, strict=True):
        total = total + log_normal(center, mean_center, 0.01) + log_normal(feature, mean_feature, 0.1)
    return total


def scene(state: State, kept: Tensor) -> Scene:
    numbers = kept.nonzero().flatten().tolist()
    return [state.centers[i] for i in numbers], [state.features[i] for i in numbers]


def only(values: Scene, here: Tensor, kept: Tensor) -> Scene:
    """Of the objects `here`, those in `kept`."""
    chosen = kept[here.nonzero().flatten()].tolist()
    return tuple([value for value, keep in zip(part, chosen, strict=True) if keep] for part in values)


def hand_written_loss(
    model: CascadedModel, guide: CascadedGuide, window: Window, c_noise: Tensor, z_noise: Tensor
) -> Tensor:
    """-(J_f + J_h + J_g) with the paper's J of opposite sign: the negative ELBO, summed over windows."""
    w, q = Weights(model), Weights(guide)
    elbo = torch.zeros((), dtype=torch.float64)
    for b, actions in enumerate(window.actions):
        states = [State(*(field[b, t] for field in window.states)) for t in range(4)]
        for t in range(3):  # J_f
            if window.transition_mask[b, t]:
                here, both = states[t].mask, states[t].mask & states[t + 1].mask
                s = scene(states[t], here)
                effect = effects(w, "dynamics.trunk", encode(w, s), actions[t])
                predicted = change(w, "dynamics.change.head", s, effect, 0.15)
                elbo = elbo + log_state(scene(states[t + 1], both), only(predicted, here, both))
        if not window.sequence_mask[b]:
            continue
        here, both = states[0].mask, states[0].mask & states[3].mask
        s, goal = scene(states[0], here), scene(states[3], both)
        encoded = encode(w, s)
        mean, scale = q_h(q, scene(states[0], both), goal)
        c = mean + scale * c_noise[b]
        effect = effects(w, "meta_dynamics.trunk", encoded, c)
        subgoal = change(w, "meta_dynamics.change.head", s, effect, 0.5)
        elbo = elbo + log_state(goal, only(subgoal, here, both))  # J_h
        elbo = elbo - (log_normal(c, mean, scale) - log_normal(c, torch.zeros_like(c), 1.0))
        mean, scale = q_g(q, encoded, actions, c)
        z = mean + scale * z_noise[b]
        scales = torch.tensor([0.077, 0.077, 0.245, 0.245], dtype=torch.float64)
        elbo = elbo + log_normal(actions, pushes(w, effect, z), scales)  # J_g
        elbo = elbo - (log_normal(z, mean, scale) - log_normal(z, torch.zeros_like(z), 1.0))
    return -elbo


@pytest.fixture
def programs() -> tuple[CascadedModel, CascadedGuide]:
    model = CascadedModel(effect_dimension=5, motion_dimension=4, feature_dimension=6, width=8).double()
    return model, CascadedGuide(model, width=8).double()


@pytest.fixture
def window(random_window: Callable[..., Window]) -> Window:
    window = random_window().map(lambda x: x.double() if x.is_floating_point() else x)
    assert not window.transition_mask.all() and not window.sequence_mask.all()
    assert not window.states.mask.all()
    return window


def noise_of(guide: CascadedGuide, window: Window) -> list[Tensor]:
    """What the guide's codes were made of: (code - mean) / scale, replayed from a trace."""
    traced = poutine.trace(guide).get_trace(window)
    sites = [traced.nodes[name] for name in ("effect_code", "motion_code")]
    normals = [site["fn"].base_dist for site in sites]
    return [((site["value"] - normal.loc) / normal.scale).detach() for site, normal in zip(sites, normals, strict=True)]


def gradients(loss: Tensor, programs: tuple[CascadedModel, CascadedGuide]) -> dict[str, Tensor]:
    named = {f"{n}.{k}": p for n, program in enumerate(programs) for k, p in program.named_parameters()}
    return dict(zip(named, torch.autograd.grad(loss, list(named.values())), strict=True))


def test_trace_elbo_equals_the_hand_written_loss_and_its_gradients(
    programs: tuple[CascadedModel, CascadedGuide], window: Window
) -> None:
    torch.manual_seed(11)
    noise = noise_of(programs[1], window)
    torch.manual_seed(11)
    loss = Trace_ELBO()(*programs)(window)
    expected = hand_written_loss(*programs, window, *noise)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)

    ours, theirs = gradients(loss, programs), gradients(expected, programs)
    assert ours.keys() == theirs.keys() and len(ours) > 50
    for name, gradient in ours.items():
        size = theirs[name].abs().max()
        assert size > 0, name
        assert (gradient - theirs[name]).abs().max() <= 1e-6 * size, name


def test_each_mask_takes_its_terms_out(programs: tuple[CascadedModel, CascadedGuide], window: Window) -> None:
    none = window._replace(
        transition_mask=torch.zeros_like(window.transition_mask),
        sequence_mask=torch.zeros_like(window.sequence_mask),
    )
    loss = Trace_ELBO()(*programs)
    assert loss(none).item() == 0
    only_dynamics = gradients(loss(window._replace(sequence_mask=none.sequence_mask)), programs)
    for name, gradient in only_dynamics.items():
        assert (gradient.abs().max() > 0) == name.startswith(("0.encoder", "0.dynamics")), name


def test_vectorised_particles_give_the_mean_of_single_ones(
    programs: tuple[CascadedModel, CascadedGuide], window: Window
) -> None:
    torch.manual_seed(11)
    loss = Trace_ELBO(num_particles=8, vectorize_particles=True, max_plate_nesting=1)(*programs)(window)
    torch.manual_seed(11)
    c_noise, z_noise = torch.randn(8, 4, 5, dtype=torch.float64), torch.randn(8, 4, 4, dtype=torch.float64)
    single = [hand_written_loss(*programs, window, *noise) for noise in zip(c_noise, z_noise, strict=True)]
    expected = torch.stack(single).mean()
    assert torch.stack(single).std() > 1
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    ours, theirs = gradients(loss, programs), gradients(expected, programs)
    for name, gradient in ours.items():
        assert torch.allclose(gradient, theirs[name], rtol=1e-6, atol=1e-6 * theirs[name].abs().max()), name
