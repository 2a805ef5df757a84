"""What Pyro costs in training: `python benchmarks/training.py [batch sizes]`.

One step of the cascade (loss, gradients, clipping, Adam) as `train` does it, against the same networks and the same
loss in hand-written torch, in turn, so that whatever else the machine does falls on both. CPU time, one thread.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import pyro
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor, nn

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.networks.layers import SCALE_FLOOR
from cavin_pyro.models.state import State, Window
from cavin_pyro.training.objectives import Objective
from cavin_pyro.training.trainer import unchecked_programs

PAIRS = 60  # of steps per batch size
OBJECTS, FEATURES, SEGMENT = 5, 64, 3


def random_windows(count: int, seed: int = 0) -> Window:
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(count, SEGMENT + 1, OBJECTS, 3, generator=generator)
    features = torch.randn(count, SEGMENT + 1, OBJECTS, FEATURES, generator=generator)
    real = torch.arange(OBJECTS) < torch.randint(1, OBJECTS + 1, (count, 1, 1), generator=generator)
    states = State(centers, nn.functional.normalize(features, dim=-1), real.expand(count, SEGMENT + 1, OBJECTS))
    actions = 2 * torch.rand(count, SEGMENT, 4, generator=generator) - 1
    counted = torch.rand(count, generator=generator) < 0.6
    return Window(states, actions, torch.ones(count, SEGMENT, dtype=torch.bool), counted)


def hand_written_loss(model: CascadedModel, guide: CascadedGuide, window: Window) -> Tensor:
    """-ELBO summed over the windows, as somebody would write it who needs this one loss and no other."""
    states, first, last, scales = window.states, window.first, window.last, model.scales
    before, after = states.step(slice(0, -1)), states.step(slice(1, None))
    encoded = model.encoder(before)

    q_h, q_g = guide.effect_inference, guide.motion_inference
    c_mean, c_scale = moments(q_h, (first, last))
    c = c_mean + c_scale * torch.randn_like(c_mean)
    z_mean, z_scale = moments(q_g, (encoded[:, 0], first, window.actions, c))
    z = z_mean + z_scale * torch.randn_like(z_mean)

    effect = model.meta_dynamics.effect(encoded[:, 0], c)
    subgoal = model.meta_dynamics(first, effect)
    pushes = model.action_generator(effect, first, z)
    outcome = model.dynamics(before, encoded, window.actions)

    real = first.mask & last.mask
    sequence = kl(c_mean, c_scale, c) + kl(z_mean, z_scale, z)
    sequence = sequence + state_loss(subgoal, last, real, scales.center, scales.feature).sum(-1)
    start, motion = scales.action
    action_scale = pushes.new_tensor((start, start, motion, motion))
    error = ((window.actions - pushes) / action_scale).square()
    sequence = sequence + (0.5 * error + action_scale.log() + 0.5 * math.log(2 * math.pi)).sum((-2, -1))
    counted = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
    transitions = state_loss(outcome, after, counted, scales.center, scales.feature)
    return sequence.where(window.sequence_mask, 0.0).sum() + transitions.sum()


def moments(network: Any, arguments: tuple) -> tuple[Tensor, Tensor]:
    """Mean and scale of an inference network, without the distribution that it returns around them."""
    kept: list[Tensor] = []
    head = network.code.head
    gaussian, network.code.forward = network.code.forward, lambda feature: kept.append(head(feature))
    try:
        network(*arguments)
    finally:
        network.code.forward = gaussian
    mean, scale = kept[0].chunk(2, -1)
    return mean, nn.functional.softplus(scale) + SCALE_FLOOR


def kl(mean: Tensor, scale: Tensor, value: Tensor) -> Tensor:
    """log q - log p at a sampled code: [B]."""
    return (0.5 * value.square() - 0.5 * ((value - mean) / scale).square() - scale.log()).sum(-1)


def state_loss(mean: State, observed: State, real: Tensor, center: Any, feature: Any) -> Tensor:
    """Negative log density of each object's center and feature: [..., M]."""
    loss = 0.5 / center**2 * (observed.centers - mean.centers).square().sum(-1)
    loss = loss + 0.5 / feature**2 * (observed.features - mean.features).square().sum(-1)
    constant = 3 * math.log(center) + FEATURES * math.log(feature) + 0.5 * (3 + FEATURES) * math.log(2 * math.pi)
    return (loss + constant).where(real, 0.0)


def stepper(loss: Callable[[], Tensor], parameters: list[nn.Parameter], count: int) -> Callable[[], None]:
    optimizer = torch.optim.Adam(parameters, lr=1e-4, fused=True)

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        (loss() / count).backward()
        nn.utils.clip_grad_norm_(parameters, 250.0)
        optimizer.step()

    return step


def seconds(step: Callable[[], None]) -> float:
    start = time.process_time()
    step()
    return time.process_time() - start


def main() -> None:
    torch.set_num_threads(1)
    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    for count in [int(argument) for argument in sys.argv[1:]] or [64, 256, 512]:
        torch.manual_seed(0)
        model = CascadedModel(space=SPACE)
        guide, window = CascadedGuide(model), random_windows(count)
        bound = Objective(Trace_ELBO(max_plate_nesting=1)).loss(model, guide)
        torch.manual_seed(1)
        ours = bound(window, 0).item()
        torch.manual_seed(1)
        theirs = hand_written_loss(model, guide, window).item()
        assert math.isclose(ours, theirs, rel_tol=1e-5), (ours, theirs)
        parameters = list(bound.parameters())
        pyro_step = stepper(partial(bound, window, 0), parameters, count)
        torch_step = stepper(partial(hand_written_loss, model, guide, window), parameters, count)
        with unchecked_programs():
            for _ in range(5):
                pyro_step(), torch_step()
            times = [(seconds(pyro_step), seconds(torch_step)) for _ in range(PAIRS)]
        mine, hand = (statistics.median(column) for column in zip(*times, strict=True))
        ratio = statistics.median(one / other for one, other in times)
        print(
            f"batch {count}: Pyro {1e3 * mine:.1f} ms, hand-written torch {1e3 * hand:.1f} ms, "
            f"ratio {ratio:.3f} (median of {PAIRS} pairs), {count / mine:.0f} windows per second with Pyro"
        )


if __name__ == "__main__":
    main()
