"""The ELBOs of all programs a second time, in a plain computation that shares no code with them but the weights.

States are lists of objects, layers are matrices, relations are loops over pairs, contexts are repeated and
concatenated, densities are written out. Everything is in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from pyro import poutine
from torch import Tensor, nn

from cavin_pyro.models.state import State, Window

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


def effects(w: Weights, trunk: str, encoded: list[Tensor], context: Tensor | None) -> list[Tensor]:
    if context is None:
        return [w.relu(f"{trunk}.second.0", w.relu(f"{trunk}.from_state", own)) for own in encoded]
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


def pushes(w: Weights, effect: list[Tensor], z: Tensor | None) -> Tensor:
    read = pool(w, "action_generator.pool.score", effect)
    if z is not None:
        mean, scale = w.linear("action_generator.transform", read).chunk(2)
        read = mean + softplus(scale) * z
    raw = {
        part: w.linear(f"action_generator.{part}.1", w.relu(f"action_generator.{part}.0.0", read))
        for part in ("starts", "motions")
    }
    starts, motions = 5 * torch.tanh(raw["starts"].view(3, 2) / 5), torch.tanh(raw["motions"].view(3, 2))
    return torch.cat([starts, motions], 1)


def q_h(w: Weights, s: Scene, goal: Scene, actions: Tensor | None = None) -> tuple[Tensor, Tensor]:
    total = torch.zeros(8, dtype=torch.float64)
    for center, feature, later, turned in zip(*s, *goal, strict=True):
        parts = [(center - TABLE) / 0.1, feature, (later - center) / 0.1, turned - feature]
        hidden = w.relu("effect_inference.objects.0.0", torch.cat(parts))
        total = total + w.relu("effect_inference.objects.1.0", hidden)
    if actions is not None:
        total = torch.cat([total, *(w.relu("effect_inference.pushes.0.0", action) for action in actions)])
    feature = w.relu("effect_inference.scene.0", total)
    mean, scale = w.linear("effect_inference.code.head", feature).chunk(2)
    return mean, softplus(scale) + 1e-6


def q_g(w: Weights, encoded: list[Tensor], actions: Tensor, c: Tensor | None) -> tuple[Tensor, Tensor]:
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


def log_pushes(observed: Tensor, mean: Tensor) -> Tensor:
    return log_normal(observed, mean, torch.tensor([0.077, 0.077, 0.245, 0.245], dtype=torch.float64))


def divergence(code: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """log q(code) - log N(code; 0, I)."""
    return log_normal(code, mean, scale) - log_normal(code, torch.zeros_like(code), 1.0)


class Example:
    """One window that counts for the codes, with the objects that are real where it matters."""

    def __init__(self, window: Window, b: int) -> None:
        states = [State(*(field[b, t] for field in window.states)) for t in (0, -1)]
        self.here, self.both = states[0].mask, states[0].mask & states[1].mask
        self.actions = window.actions[b]
        self.s = scene(states[0], self.here)
        self.s_of_both, self.goal = scene(states[0], self.both), scene(states[1], self.both)

    def log_subgoal(self, w: Weights, effect: list[Tensor]) -> Tensor:
        subgoal = change(w, "meta_dynamics.change.head", self.s, effect, 0.5)
        return log_state(self.goal, only(subgoal, self.here, self.both))


def log_transitions(w: Weights, window: Window) -> Tensor:
    """J_f: the log-density of the states after each push that counts, summed over windows."""
    total = torch.zeros((), dtype=torch.float64)
    for b, t in window.transition_mask.nonzero().tolist():
        before, after = (State(*(field[b, step] for field in window.states)) for step in (t, t + 1))
        both = before.mask & after.mask
        s = scene(before, before.mask)
        effect = effects(w, "dynamics.trunk", encode(w, s), window.actions[b, t])
        predicted = change(w, "dynamics.change.head", s, effect, 0.15)
        total = total + log_state(scene(after, both), only(predicted, before.mask, both))
    return total


def log_weight(
    w: Weights, q: Weights, x: Example, c_noise: Tensor, z_noise: Tensor, *, of_actions: bool, of_effect: bool
) -> Tensor:
    """Of the cascade: log p(s', a, c, z | s) - log q(c, z | s, s', a) for one draw of a window's codes.

    `of_actions`: whether q(c) reads the actions. `of_effect`: whether q(z) reads c.
    """
    encoded = encode(w, x.s)
    c_mean, c_scale = q_h(q, x.s_of_both, x.goal, x.actions if of_actions else None)
    c = c_mean + c_scale * c_noise
    effect = effects(w, "meta_dynamics.trunk", encoded, c)
    j_h = x.log_subgoal(w, effect) - divergence(c, c_mean, c_scale)
    z_mean, z_scale = q_g(q, encoded, x.actions, c if of_effect else None)
    z = z_mean + z_scale * z_noise
    return j_h + log_pushes(x.actions, pushes(w, effect, z)) - divergence(z, z_mean, z_scale)


def loss_of(elbo: Callable[..., Tensor], model: nn.Module, guide: nn.Module, window: Window, *noise: Tensor) -> Tensor:
    """-J_f and, for windows that count, minus what `elbo(w, q, example, *noise)` says of their codes.

    `w` and `q` are the weights of model and guide, `noise: [B, D]` the standard normal samples of each code.
    """
    w, q = Weights(model), Weights(guide)
    total = log_transitions(w, window)
    for b in window.sequence_mask.nonzero().flatten().tolist():
        total = total + elbo(w, q, Example(window, b), *(one[b] for one in noise))
    return -total


def noise_of(guide: nn.Module, window: Window) -> list[Tensor]:
    """What the guide's codes were made of: (code - mean) / scale, replayed from a trace."""
    traced = poutine.trace(guide).get_trace(window)
    sites = [traced.nodes[name] for name in ("effect_code", "motion_code") if name in traced.nodes]
    normals = [site["fn"].base_dist for site in sites]
    return [((site["value"] - normal.loc) / normal.scale).detach() for site, normal in zip(sites, normals, strict=True)]


def gradients(loss: Tensor, *programs: nn.Module) -> dict[str, Tensor]:
    named = {f"{n}.{k}": p for n, program in enumerate(programs) for k, p in program.named_parameters()}
    return dict(zip(named, torch.autograd.grad(loss, list(named.values())), strict=True))


def assert_same(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    """Every gradient is there, is not zero, and is the same to six digits."""
    assert ours.keys() == theirs.keys()
    for name, gradient in ours.items():
        size = theirs[name].abs().max()
        assert size > 0, name
        assert (gradient - theirs[name]).abs().max() <= 1e-6 * size, name
