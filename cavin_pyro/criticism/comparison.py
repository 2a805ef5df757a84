"""Two checkpoints on the same held-out windows: their verdicts side by side, and paired differences in predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from cavin_pyro.config.commands import DEFAULT_CHECKPOINT
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.elbo import terms_by_window
from cavin_pyro.criticism.estimates import Interval, mean_interval
from cavin_pyro.criticism.loading import (
    Accept,
    CheckContext,
    Loaded,
    compare_data,
    context_of,
    load_trained,
    unmasked_windows,
)
from cavin_pyro.criticism.report import Part, render, write_report
from cavin_pyro.criticism.section import NONE, Section, Table, Verdict, conclude
from cavin_pyro.criticism.sections import fingerprint_of, run_sections
from cavin_pyro.criticism.windows import seeded
from cavin_pyro.data.collection import collecting_world
from cavin_pyro.storage.run_directory import check_same_run, write_config

BATCH = 256  # windows that are computed at once
EXPLANATION = (
    "Both checkpoints were checked on the same {windows} windows of {episodes} episodes, which neither was trained on. "
    "Differences of the terms of -ELBO are paired by window, with 95 % intervals over episodes; smaller is better. "
    "Terms of the same name are compared: each model's guide gives its own bound. Densities of features are no numbers "
    "of one kind where the two have different PointNets."
)


def check_pair(config: DictConfig) -> bool:
    """Whether the options `a` and `b` ask for a comparison.

    Raises:
        UserError: only one of them is given, or a third checkpoint, or an export, which is of one checkpoint.
    """
    if config.a is None and config.b is None:
        return False
    if config.a is None or config.b is None:
        raise UserError("a= and b= name the two checkpoints of a comparison: give both")
    if config.checkpoint != DEFAULT_CHECKPOINT:
        raise UserError(f"checkpoint={config.checkpoint} is not read beside a= and b=: leave it, or leave these")
    if config.export is not None:
        raise UserError("export= writes the samples of one checkpoint: give it with checkpoint=, without a= and b=")
    return True


def load_pair(config: DictConfig, accept: Accept | None = None) -> dict[str, tuple[CheckContext, dict[str, Any]]]:
    """Read what the options `a` and `b` name, as `load_context` does for `checkpoint`.

    Both have the same held-out windows: those that neither was trained on.

    Raises:
        UserError: see `load_context`; or their windows are not of the same data, or none is held out by both.
    """
    world = collecting_world(config.env)
    both = {name: load_trained(config, config[name], accept) for name in ("a", "b")}
    choices = [
        (loaded.checkpoint.model.segment_length, list(loaded.selection.held_out_objects)) for loaded in both.values()
    ]
    if choices[0] != choices[1]:
        raise UserError(
            "a and b cannot be compared on the same windows: they have segments of "
            f"{' and '.join(str(length) for length, _ in choices)} pushes and hold out the objects "
            f"{' and '.join(str(objects) for _, objects in choices)}"
        )
    starts = [loaded.table.starts[unmasked_windows(loaded.table, _unseen(loaded))] for loaded in both.values()]
    common = starts[0][torch.isin(starts[0], starts[1])].sort().values
    if not len(common):
        raise UserError("no window was held out by both a and b: give other data=, on which neither was trained")
    contexts = {}
    for name, loaded in both.items():
        order = loaded.table.starts.argsort()
        indices = order[torch.searchsorted(loaded.table.starts[order], common)]
        contexts[name] = context_of(config, loaded, world, indices)
    return contexts


def _unseen(loaded: Loaded) -> Tensor:
    """Indices of the windows that a model was not trained on: the held-out ones, or all of other data."""
    table, trained = loaded.table, loaded.checkpoint.provenance
    if all(compare_data(folder, trained)["same"] is False for folder in loaded.folders):
        return torch.cat((table.training, table.validation))
    return table.validation


def write_pair(config: DictConfig, names: Sequence[str], folder: Path, accept: Accept | None = None) -> list[Part]:
    """Check both checkpoints, and write a report on both and one on each, in the folders a and b; resumes.

    For `accept` and errors see `load_pair`.
    """
    check_same_run(folder, config, ignore=("output", "sections"))
    loaded = load_pair(config, accept)
    write_config(folder, config)
    parts = {}
    for name, (context, about) in loaded.items():
        (folder / name).mkdir(exist_ok=True)
        print(f"checkpoint {name}: {about['checkpoint']}", flush=True)
        parts[name] = run_sections(names, context, config.sizes, folder / name, fingerprint_of(about))
        write_report(folder / name, about, parts[name])
    abouts = {name: about for name, (_, about) in loaded.items()}
    both = {
        key: "; ".join(f"{name}: {about[key]}" for name, about in abouts.items())
        for key in ("checkpoint", "weights", "model", "guide", "prior")
    }
    pair = assess_pair({name: context for name, (context, _) in loaded.items()})
    joined = [render(verdicts_side_by_side(parts)), render(pair)]
    write_report(folder, {**abouts["a"], **both, "heading": "Comparison of a and b", "trained": {}}, joined)
    return joined


def verdicts_side_by_side(parts: Mapping[str, Sequence[Part]]) -> Section:
    """A row for each section: the verdicts of `a` and `b`."""
    pairs = list(zip(parts["a"], parts["b"], strict=True))
    levels = {part["name"]: {"a": part["verdict"]["level"], "b": other["verdict"]["level"]} for part, other in pairs}
    differing = [part["title"] for part, _ in pairs if levels[part["name"]]["a"] != levels[part["name"]]["b"]]
    return Section(
        "verdicts",
        "Verdicts side by side",
        "The whole report of each stands in the folders a and b, with each verdict's rule.",
        Verdict(NONE, ""),
        [f"The verdicts differ in: {'; '.join(differing)}." if differing else "All verdicts are the same."],
        levels,
        tables=[Table(["section", "a", "b"], [[part["title"], *levels[part["name"]].values()] for part, _ in pairs])],
    )


def assess_pair(contexts: Mapping[str, CheckContext], samples: int = 16) -> Section:
    """Paired differences of the terms of -ELBO of the contexts `a` and `b`, whose held-out windows are the same.

    `samples`: of each guide for each window.
    """
    terms = {}
    for name, context in contexts.items():
        window, episodes = context.held_out(len(context.validation.actions))
        with seeded(context.seed):
            terms[name] = terms_by_window(context.model, context.guide, window, samples, BATCH)
    differences = {
        term: mean_interval(first - terms["b"][term], episodes)
        for term, first in terms["a"].items()
        if term in terms["b"]
    }
    return Section(
        "comparison",
        "a and b on the same held-out windows",
        EXPLANATION.format(windows=len(episodes), episodes=len(episodes.unique())),
        conclude(NONE, "A difference counts if its 95 % interval excludes 0.", "", episodes),
        [
            f"{term}: a minus b {difference.text()} nats per window: {better(difference)}."
            for term, difference in differences.items()
        ],
        {term: {**difference._asdict(), "better": better(difference)} for term, difference in differences.items()},
    )


def better(difference: Interval) -> str:
    """Which of two is better, by the interval of the first's loss minus the second's."""
    if difference.high < 0:
        return "a is better"
    return "b is better" if difference.low > 0 else "no difference shown"
