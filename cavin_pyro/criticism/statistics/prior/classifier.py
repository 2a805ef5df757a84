"""A classifier two-sample test of paired rows, cross-validated and permuted by episode.

Lopez-Paz and Oquab, "Revisiting classifier two-sample tests", 2017. The rows are of (s, c, z) jointly: one with codes
from the guide and one with codes from the prior at the same state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from cavin_pyro.criticism.statistics.clusters import Interval, mean_interval, sums_by_episode

FOLDS = 5
WIDTH = 64
STEPS = 40
LEARNING_RATE = 6e-3
DECAY = 1.0  # of AdamW
NEWTON_STEPS = 12
RIDGE = 1.0  # keeps log odds finite where all rows are told apart
DROPOUT = 0.5  # of the inputs, against overfitting


class ClassifierTest(NamedTuple):
    """Outcome of a test."""

    auc: Interval  # share of held-out pairs whose row from the first sample gets the higher logit; 0.5 by chance
    accuracy: Interval  # of single rows; 0.5 by chance
    p_value: float  # of the share, with the two rows of all pairs of an episode exchanged at once
    divergence: Interval  # nats; a lower bound on KL(first | second), given what both have in common


def classifier_test(
    first: Tensor, second: Tensor, episodes: Tensor, *, permutations: int = 999, seed: int = 0
) -> ClassifierTest:
    """Test whether rows `first: [N, P]` and `second: [N, P]`, paired, come from the same distribution.

    What the rows of a pair have in common (the state) may be among the columns. Every pair is judged by a network that
    learned from other episodes.

    Args:
        episodes: of the pairs `[N]`.

    Raises:
        ValueError: samples of different shape, or fewer than two episodes.
    """
    if first.shape != second.shape or first.dim() != 2:
        raise ValueError(f"rows [N, P] of one shape are wanted, not {[*first.shape]} and {[*second.shape]}")
    logits = held_out_logits(first, second, episodes, seed=seed)
    difference = logits[0] - logits[1]
    apart = (difference > 0).double() + 0.5 * (difference == 0).double()
    correct = ((logits[0] > 0).double() + (logits[1] < 0).double()) / 2
    # Under the null hypothesis the pairs of an episode may be exchanged, which turns a share into 1 - share.
    sums = sums_by_episode(apart - 0.5, episodes)
    signs = torch.randint(0, 2, (permutations, len(sums)), generator=torch.Generator().manual_seed(seed)) * 2.0 - 1
    exchanged = (signs.double() @ sums).abs()
    p_value = (1 + (exchanged >= sums.sum().abs() - 1e-9).sum().item()) / (permutations + 1)
    interval = mean_interval(apart, episodes)
    return ClassifierTest(interval, mean_interval(correct, episodes), p_value, divergence_bound(*logits, episodes))


def divergence_bound(first: Tensor, second: Tensor, episodes: Tensor) -> Interval:
    """A lower bound on KL(first | second) from held-out logits `[N]` of both, in nats.

    1 + E_first T - E_second exp T (Nguyen, Wainwright and Jordan, 2010) is a lower bound for any function T that was
    not fitted to these rows; where both samples have a common state, on the mean divergence given the state.
    """
    return mean_interval(1 + first - second.exp(), episodes)


def held_out_logits(first: Tensor, second: Tensor, episodes: Tensor, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Log odds of being of the first sample, for both rows of each pair, by a network of other episodes: `[N]` each."""
    names, which = torch.unique(episodes, return_inverse=True)
    if len(names) < 2:
        raise ValueError("a cross-validated classifier needs windows of two episodes at least")
    generator = torch.Generator().manual_seed(seed)
    folds = min(FOLDS, len(names))
    fold = (torch.randperm(len(names), generator=generator) % folds)[which]
    rows = torch.stack((first, second)).float()  # [2, N, P]
    logits = torch.empty(2, len(first), dtype=torch.float64)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for number in range(folds):
            learning, judged = fold != number, fold == number
            aside = fold[learning] == (number + 1) % folds if folds > 2 else torch.arange(int(learning.sum())) % 4 == 0
            logits[:, judged] = _fit(rows[:, learning], aside)(rows[:, judged]).double()
    return logits[0], logits[1]


class _Classifier(nn.Module):
    """Logits of rows: a quadratic and a small network side by side, then shrunk by what a part of the rows supports."""

    def __init__(self, rows: Tensor) -> None:
        super().__init__()
        flat = rows.flatten(0, -2)
        self.mean, self.scale = flat.mean(0), flat.std(0).clamp(min=1e-6)
        count = 2 * flat.shape[-1]
        self.network = nn.Sequential(nn.Dropout(DROPOUT), nn.Linear(count, WIDTH), nn.GELU(), nn.Linear(WIDTH, 1))
        self.direct = nn.Linear(count, 1)
        nn.init.zeros_(self.direct.weight)
        self.slope, self.offset = 1.0, 0.0

    def inputs(self, rows: Tensor) -> Tensor:
        scaled = ((rows - self.mean) / self.scale).clamp(-5.0, 5.0)
        return torch.cat((scaled, scaled.square() - 1), -1)

    def raw(self, inputs: Tensor) -> Tensor:
        return (self.network(inputs) + self.direct(inputs)).squeeze(-1)

    def forward(self, rows: Tensor) -> Tensor:
        return self.slope * self.raw(self.inputs(rows)) + self.offset


def _fit(rows: Tensor, aside: Tensor) -> _Classifier:
    """Train on `rows: [2, N, P]`, the first of which are to get logits above 0.

    Pairs in `aside: [N]` tell by how much the logits must shrink to be log odds (Platt, 1999).
    """
    with torch.enable_grad():
        classifier = _Classifier(rows[:, ~aside])
        network = [*classifier.network.parameters(), *classifier.direct.parameters()]
        inputs = classifier.inputs(rows)
        learning = inputs[:, ~aside]
        _descend(network, lambda: classifier.raw(learning))
    classifier.eval().requires_grad_(False)
    classifier.slope, classifier.offset = _log_odds(classifier.raw(inputs[:, aside]))
    return classifier


def _log_odds(logits: Tensor) -> tuple[float, float]:
    """Slope and offset of the logistic regression on logits `[2, N]`, the first of which are to be above 0."""
    inputs = torch.stack((logits.flatten(), torch.ones(logits.numel())), -1).double()
    target = torch.tensor([1.0, 0.0], dtype=torch.float64).unsqueeze(-1).expand(logits.shape).flatten()
    weights, ridge = torch.zeros(2, dtype=torch.float64), RIDGE * torch.eye(2, dtype=torch.float64)
    for _ in range(NEWTON_STEPS):
        chance = (inputs @ weights).sigmoid()
        gradient = inputs.T @ (chance - target) + ridge @ weights
        curvature = inputs.T @ (inputs * (chance * (1 - chance)).unsqueeze(-1)) + ridge
        weights = weights - torch.linalg.solve(curvature, gradient)
    slope, offset = weights.tolist()
    return slope, offset


def _descend(parameters: list[nn.Parameter], logits: Callable[[], Tensor]) -> None:
    """Minimise the cross-entropy of logits `[2, N]`, the first of which are to be above 0."""
    optimizer = torch.optim.AdamW(parameters, lr=LEARNING_RATE, weight_decay=DECAY)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1 - step / STEPS)
        optimizer.zero_grad()
        found = logits()
        target = torch.tensor([1.0, 0.0]).unsqueeze(-1).expand(found.shape)
        nn.functional.binary_cross_entropy_with_logits(found, target).backward()
        optimizer.step()
