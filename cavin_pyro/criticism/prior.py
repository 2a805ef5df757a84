"""Is the prior the aggregate posterior, given the state? A classifier two-sample test of (s, c, z).

Lopez-Paz and Oquab, "Revisiting classifier two-sample tests", 2017. Rows come in pairs: codes from the guide and codes
from the prior at the same state; a network judges every pair that it did not learn from.
"""

from __future__ import annotations

from typing import Any

import torch
from matplotlib.figure import Figure
from pyro import poutine
from torch import Tensor, nn

from cavin_pyro.criticism.codes import Codes, sample_guide, unsuitable_codes
from cavin_pyro.criticism.estimates import Interval, mean_interval
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.pushing import pair_distances, path_distances, start_distances
from cavin_pyro.criticism.section import INSPECT, Section, conclude, grade, not_applicable
from cavin_pyro.criticism.windows import GeneratedWindow, generated, seeded
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.models.model import Model
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State, Window
from cavin_pyro.training.elbo import Program, substitute

GOOD, BAD = 0.6, 0.7  # AUC
SOURCES = {"prior": "the prior", "control": "the prior of another scene"}
COLORS = {"guide": "#D55E00", "prior": "#0072B2", "control": "#9A9A9A"}
FAR = 2.0  # ranges of a step; distances that are larger (or infinite) count as this
OBJECT_FEATURES = 8  # numbers of the mean geometric feature that are kept
FOLDS = 5
WIDTH = 64
STEPS = 40
LEARNING_RATE = 6e-3
DECAY = 1.0  # of AdamW
DROPOUT = 0.5  # of the inputs, against overfitting

EXPLANATION = (
    "A planner samples codes from the prior at the state that it sees, so the prior must agree with the codes that "
    "the guide infers from what really happened, state by state. For each of {windows} held-out windows of "
    "{episodes} episodes, one pair (c, z) is taken from either. A network, cross-validated by episode, reads the "
    "state, the codes, their place in the prior, and the subgoal and pushes that they decode to. Its AUC is the "
    "share of held-out pairs that it orders correctly. The control takes the prior's codes of another scene: a test "
    "that cannot see that, cannot see a prior that ignores the state."
)


@torch.no_grad()
def assess_prior(context: CheckContext, *, windows: int = 1000) -> Section:
    """AUC of a classifier that tells the guide's codes from the prior's, on held-out windows.

    `windows`: held-out windows, at most.
    """
    window, episodes = context.held_out(windows)
    if reason := unsuitable_codes(context, window):
        return not_applicable(reason)
    if len(episodes.unique()) < 2:
        return not_applicable("All held-out windows are of one episode: collect more transitions.")
    with seeded(context.seed):
        inferred, prior = (sample_guide(program, window, 1) for program in (context.guide, context.model))
        codes = {"guide": {name: value[0] for name, value in inferred.items()}}
        codes["prior"] = {name: prior[name][0] for name in inferred}
        elsewhere = other_episodes(episodes)
        codes["control"] = {name: value[elsewhere] for name, value in codes["prior"].items()}
        rows = {source: describe(context.model, window, values) for source, values in codes.items()}
        logits = {source: held_out_logits(rows["guide"], rows[source], episodes, context.seed) for source in SOURCES}
    areas = {source: area_under_curve(*pair, episodes) for source, pair in logits.items()}
    auc = areas["prior"]
    return Section(
        EXPLANATION.format(windows=len(episodes), episodes=len(episodes.unique())),
        conclude(
            grade(auc.low, auc.high, good=GOOD, bad=BAD) if auc.mean == auc.mean else INSPECT,
            f"AUC of a classifier of the guide's codes against the prior's: good if its 95 % interval over episodes "
            f"ends below {GOOD:g}, bad if it begins above {BAD:g}.",
            "Have the planner choose among many samples instead of trusting one; train with prior=mixture, or for "
            "longer, and check again.",
            episodes,
        ),
        [
            f"A classifier of (s, c, z) orders {auc.percent()} of held-out pairs correctly (50 % by chance), and "
            f"{areas['control'].percent()} when the prior's codes are those of another scene."
        ],
        {"windows": len(episodes), "auc": areas},
        "AUC of a classifier, guide against prior",
        auc,
        figure=_figure(logits),
        caption="Held-out log odds that a pair (c, z) is the guide's, for codes of either source: the further the two "
        "curves of one colour are apart, the easier they are told apart.",
    )


def other_episodes(episodes: Tensor) -> Tensor:
    """For each window of `episodes: [B]`, a window of another episode, if none has more than half of them: `[B]`."""
    order = episodes.argsort(stable=True)
    other = torch.empty_like(order)
    other[order] = order.roll(int(torch.unique(episodes, return_counts=True)[1].max()))
    return other


def area_under_curve(first: Tensor, second: Tensor, episodes: Tensor) -> Interval:
    """Share of pairs whose `first: [N]` logit is higher than the `second: [N]`, ties counted half."""
    return mean_interval((first > second).double() + 0.5 * (first == second).double(), episodes)


@torch.no_grad()
def describe(model: Program, window: Window, codes: Codes) -> Tensor:
    """Rows `[B, P]` of the first states of windows `[B]` with codes `[B, D]`: the state, the codes, and what they mean.

    All columns are functions of (s, c, z), so that a test of rows is a test of (s, c, z) jointly: the state's moments;
    the codes; their standardised residuals and log densities under the model's own prior; and, for our models, the
    subgoal, the pushes and the distances between pushes and objects.
    """
    columns = [state_summary(window.first), *codes.values(), prior_residuals(model, window, codes)]
    if isinstance(model, Model):
        columns.append(decoded_summary(generated(model, window, codes=codes, means=tuple(codes)), model.space))
    return torch.cat([column.float() for column in columns], -1)


def state_summary(state: State) -> Tensor:
    """Number of objects, mean and spread of their centres, and some of their mean feature: `[B, 7 + 8]`."""
    real = state.mask.unsqueeze(-1)
    count = real.sum(-2).clamp(min=1)
    mean = (state.centers * real).sum(-2) / count
    spread = (((state.centers - mean.unsqueeze(-2)) * real).square().sum(-2) / count).sqrt()
    features = (state.features * real).sum(-2) / count
    return torch.cat((count.to(mean), mean, spread, features[..., :OBJECT_FEATURES]), -1)


def prior_residuals(model: Program, window: Window, codes: Codes) -> Tensor:
    """Codes `[B, D]` standardised by their prior, where it is Gaussian, and the log density of each code: `[B, R]`."""
    trace = poutine.trace(substitute(model, codes)).get_trace(window)
    trace.compute_log_prob(site_filter=lambda name, _: name in codes)
    columns = []
    for name, value in codes.items():
        site: Any = trace.nodes[name]
        columns.append(site["log_prob"].unsqueeze(-1))
        normal = getattr(site["fn"], "base_dist", site["fn"])
        if isinstance(normal, torch.distributions.Normal):
            columns.append((value - normal.loc) / normal.scale)
    return torch.cat(columns, -1)


def decoded_summary(outcome: GeneratedWindow, space: Space) -> Tensor:
    """Actions, how the subgoal moves what, and on the table how near pushes come to objects: `[B, R]`."""
    pushes = outcome.chosen and space == SPACE
    centers, mask = outcome.first.centers, outcome.first.mask
    columns = []
    if outcome.chosen:
        columns.append(outcome.actions.flatten(-2))
    if pushes:
        columns += [path_distances(outcome).amin(-1), start_distances(outcome).amin(-1)]
    if outcome.subgoal is not None:
        change = (outcome.subgoal - centers) * mask.unsqueeze(-1)
        moves = change.norm(dim=-1)
        columns += [change.sum(-2), moves.amax(-1, True), moves.sum(-1, True)]
        columns.append(pair_distances(outcome.subgoal, mask).amin((-2, -1)).unsqueeze(-1))
        if pushes:  # whether the first push goes for what the subgoal moves
            target = moves.argmax(-1, keepdim=True)
            columns.append(path_distances(outcome)[:, 0].gather(-1, target))
            columns.append(start_distances(outcome)[:, 0].gather(-1, target))
    ends = outcome.steps[:, -1] - centers
    columns.append((ends * mask.unsqueeze(-1)).norm(dim=-1).amax(-1, True))
    return torch.cat([column.clamp(max=FAR * space.step_range) for column in columns], -1)


def held_out_logits(first: Tensor, second: Tensor, episodes: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Log odds of being of the first sample, for both rows `[N, P]` of each pair, by a network of other episodes.

    `episodes`: of the pairs `[N]`, at least two. Returns `[N]` each.
    """
    names, which = torch.unique(episodes, return_inverse=True)
    folds = min(FOLDS, len(names))
    fold = (torch.randperm(len(names), generator=torch.Generator().manual_seed(seed)) % folds)[which]
    rows = torch.stack((first, second)).float()  # [2, N, P]
    logits = torch.empty(2, len(first))
    with seeded(seed):
        for number in range(folds):
            logits[:, fold == number] = fit_classifier(rows[:, fold != number])(rows[:, fold == number]).detach()
    return logits[0], logits[1]


class Classifier(nn.Module):
    """Logits of rows: a quadratic and a small network side by side."""

    def __init__(self, rows: Tensor) -> None:
        """`rows: [..., P]`, by which inputs are standardised."""
        super().__init__()
        flat = rows.flatten(0, -2)
        self.mean, self.scale = flat.mean(0), flat.std(0).clamp(min=1e-6)
        count = 2 * flat.shape[-1]
        self.network = nn.Sequential(nn.Dropout(DROPOUT), nn.Linear(count, WIDTH), nn.GELU(), nn.Linear(WIDTH, 1))
        self.direct = nn.Linear(count, 1)
        nn.init.zeros_(self.direct.weight)

    def forward(self, rows: Tensor) -> Tensor:
        scaled = ((rows - self.mean) / self.scale).clamp(-5.0, 5.0)
        inputs = torch.cat((scaled, scaled.square() - 1), -1)
        return (self.network(inputs) + self.direct(inputs)).squeeze(-1)


@torch.enable_grad()
def fit_classifier(rows: Tensor) -> Classifier:
    """Train on `rows: [2, N, P]`, the first of which are to get logits above 0."""
    classifier = Classifier(rows)
    target = torch.tensor([1.0, 0.0]).unsqueeze(-1).expand(rows.shape[:-1])
    optimizer = torch.optim.AdamW(classifier.parameters(), lr=LEARNING_RATE, weight_decay=DECAY)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1 - step / STEPS)
        optimizer.zero_grad()
        nn.functional.binary_cross_entropy_with_logits(classifier(rows), target).backward()
        optimizer.step()
    return classifier.eval()


def _figure(logits: dict[str, tuple[Tensor, Tensor]]) -> Figure:
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    panel = figure.subplots()
    for source, (guide, other) in logits.items():
        panel.ecdf(guide.numpy(), color=COLORS[source], linestyle="--", label=f"guide, against {SOURCES[source]}")
        panel.ecdf(other.numpy(), color=COLORS[source], label=SOURCES[source])
    panel.set(xlabel="log odds of the guide", ylabel="share of windows")
    panel.legend(fontsize=8, frameon=False)
    return figure
