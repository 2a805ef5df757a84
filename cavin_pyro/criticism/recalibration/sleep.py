"""The sleep phase of wake-sleep: a guide learns the codes of windows that its own model generates.

Hinton, Dayan, Frey and Neal, "The wake-sleep algorithm for unsupervised neural networks", 1995; Bornschein and Bengio,
"Reweighted wake-sleep", 2015. E log q(codes | window) over the model's joint is largest where q is the posterior, and
a guide that is too narrow loses most. The ELBO, on real windows, prefers too narrow to too wide.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from pyro import poutine
from torch import Tensor, nn

from cavin_pyro.config.commands.training import TrainerConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.statistics.inference.simulation import simulate
from cavin_pyro.storage.progress import progress_bar
from cavin_pyro.training.elbo import Program, elbo_terms, substitute
from models.state import Window

REPORTS = 10  # rows of losses that a run returns


def sleep_loss(model: Program, guide: Program, window: Window) -> Tensor:
    """-log q(codes | simulated window), in nats, mean over windows simulated from the first states of windows `[B]`."""
    codes, simulated = simulate(model, window)
    trace: poutine.Trace = poutine.trace(substitute(guide, codes)).get_trace(simulated)
    return -torch.as_tensor(trace.log_prob_sum()) / len(window.actions)


def wake_loss(model: Program, guide: Program, window: Window) -> Tensor:
    """-ELBO of windows `[B]`, in nats, mean over windows."""
    return torch.stack(list(elbo_terms(model, guide, window).values())).sum() / len(window.actions)


def sleep(
    model: nn.Module,
    guide: nn.Module,
    batch: Callable[[], Window],
    *,
    steps: int = 1500,
    learning_rate: float = 3e-3,
    wake_weight: float = 0.03,
) -> list[dict[str, float]]:
    """Fit a guide by Adam, with training's cosine schedule and clipping of gradients; the model stays as it is.

    Args:
        batch: gives real windows `[B]`, other ones for each step. wake_weight: of -ELBO on these, beside the sleep
            loss on windows that are simulated from their first states.

    Returns:
        Mean losses of each tenth of the run: step, sleep, and wake if it counts.

    Raises:
        UserError: a loss that is not finite.
    """
    model.requires_grad_(False)
    guide.requires_grad_(True)
    optimizer = torch.optim.Adam(guide.parameters(), lr=learning_rate)
    as_training = TrainerConfig(steps=steps, learning_rate=learning_rate, schedule="cosine")
    rows: list[dict[str, float]] = []
    sums, since = {"sleep": 0.0, "wake": 0.0}, 0
    with progress_bar("sleeping", total=steps) as bar:
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = as_training.rate(step)
            window = batch()
            losses = {"sleep": sleep_loss(model, guide, window)}
            if wake_weight:
                losses["wake"] = wake_loss(model, guide, window)
            total = losses["sleep"] + wake_weight * losses.get("wake", 0.0)
            if not math.isfinite(total.item()):
                raise UserError(f"calibration stopped after step {step}: the loss is not finite: lower learning_rate")
            optimizer.zero_grad(set_to_none=True)
            total.backward()
            nn.utils.clip_grad_norm_(guide.parameters(), as_training.clip_norm)
            optimizer.step()
            sums = {name: sums[name] + loss.item() for name, loss in losses.items()}
            bar.update()
            if (step + 1) * REPORTS // steps > step * REPORTS // steps:
                rows.append({"step": step + 1} | {name: value / (step + 1 - since) for name, value in sums.items()})
                sums, since = dict.fromkeys(sums, 0.0), step + 1
    guide.requires_grad_(False)
    return rows
