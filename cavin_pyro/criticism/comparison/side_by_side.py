"""The report on two checkpoints: their verdicts and findings beside one another, and paired differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from cavin_pyro.config.commands.episodes import DEFAULT_CHECKPOINT
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.comparison.pairing import load_pair
from cavin_pyro.criticism.comparison.scores import FEATURES, LABELS, better, explained_sites, window_scores
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.loading import Accept
from cavin_pyro.criticism.report import Part, render, write_report
from cavin_pyro.criticism.section import Section, Table
from cavin_pyro.criticism.sections import fingerprint_of, run_sections
from cavin_pyro.criticism.statistics.prior.decoded import Difference, compare_decoded
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.criticism.verdicts.verdict import MINIMUM_EPISODES, MINIMUM_WINDOWS
from cavin_pyro.data.features import geometry_fingerprint
from cavin_pyro.storage.run_directory import check_same_run, write_config
from models.state import Window

SAMPLES = 50  # particles of the bound, and samples of the prediction
EXPLANATION = """
Both checkpoints were checked on the same {windows} windows of {episodes} episodes, which neither was trained on. The
differences are paired by window, and their 95 % intervals are over episodes. A bound on a log density is from {samples}
samples of each model's own guide: a better guide makes it tighter. It is compared only where both programs observe the
same sites{without}.
"""


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


def write_pair(config: DictConfig, names: Sequence[str], folder: Path, accept: Accept | None = None) -> list[Part]:
    """Check both checkpoints, and write a report on both and one on each, in the folders a and b; resumes.

    Args:
        accept: see `cavin_pyro.criticism.loading.load_trained`.

    Raises:
        UserError: see `load_pair`.
    """
    check_same_run(folder, config, ignore=("output", "sections"))
    loaded = load_pair(config, accept)
    write_config(folder, config)
    parts = {}
    for name, (context, about) in loaded.items():
        (folder / name).mkdir(exist_ok=True)
        print(f"checkpoint {name}: {about['checkpoint']}", flush=True)
        parts[name] = run_sections(names, context, config.sizes, folder / name, fingerprint_of(about))
    pair = assess_pair({name: context for name, (context, _) in loaded.items()})
    return write_comparison(folder, {name: about for name, (_, about) in loaded.items()}, parts, pair)


def assess_pair(contexts: Mapping[str, CheckContext], samples: int = SAMPLES) -> Section:
    """Held-out predictive comparison of the contexts `a` and `b`, whose held-out windows are the same."""
    windows: dict[str, Window] = {}
    for name, context in contexts.items():
        windows[name], episodes = context.held_out(len(context.validation.actions))
    one, other = contexts["a"], contexts["b"]
    alike = geometry_fingerprint(one.geometry) == geometry_fingerprint(other.geometry)
    excluded = () if alike else FEATURES
    sites = [explained_sites(context, windows[name]) for name, context in contexts.items()]
    common = sites[0] if sites[0] == sites[1] else ()
    scores = {}
    for name, context in contexts.items():
        with seeded(context.seed):
            scores[name] = window_scores(context, windows[name], sites=common, excluded=excluded, samples=samples)
    found = {
        name: compare_decoded(scores["a"][name], scores["b"][name], episodes)
        for name in LABELS
        if name in scores["a"] and name in scores["b"]
    }
    counted = ", ".join(name for name in common if name not in excluded)
    labels = {name: label.format(sites=counted) for name, (label, _) in LABELS.items()}
    count, groups = len(episodes), len(torch.unique(episodes))
    without = "" if alike else "; features are left out, since the two have different PointNets"
    text = EXPLANATION.format(windows=count, episodes=groups, samples=samples, without=without)
    few = count < MINIMUM_WINDOWS or groups < MINIMUM_EPISODES
    warning = [f"Only {count} windows of {groups} episodes: these differences are no conclusion."] if few else []
    values = {
        name: {
            **{key: part._asdict() for key, part in zip(("a", "b", "difference"), one[:3], strict=True)},
            "better": better(one.difference, LABELS[name][1]),
        }
        for name, one in found.items()
    }
    return Section(
        "comparison",
        "a and b on the same held-out windows",
        " ".join(text.split()),
        [*warning, *(_finding(labels[name], one, LABELS[name][1]) for name, one in found.items())],
        {"windows": count, "episodes": groups, "scores": values},
        [_table(found, labels)],
    )


def _finding(label: str, one: Difference, sign: int) -> str:
    first, second, difference, _ = one
    verdict = better(difference, sign)
    said = f"{verdict} is better" if verdict in ("a", "b") else verdict
    return (
        f"{label[0].upper()}{label[1:]}: a {first.mean:.4g}, b {second.mean:.4g}; a less b {difference.mean:+.4g} "
        f"({difference.low:+.4g} to {difference.high:+.4g}): {said}."
    )


def _table(found: Mapping[str, Difference], labels: Mapping[str, str]) -> Table:
    rows = [
        [labels[name], one.first.mean, one.second.mean, *one.difference, better(one.difference, LABELS[name][1])]
        for name, one in found.items()
    ]
    return Table(["mean over windows", "a", "b", "a less b", "low", "high", "better"], rows)


def verdicts_side_by_side(parts: Mapping[str, Sequence[Part]]) -> Section:
    """A row for each section: the verdicts of `a` and `b`, and what they found."""
    by_name = {name: {part["name"]: part for part in several} for name, several in parts.items()}
    rows = [
        [part["title"], *((by_name[name][section]["verdict"] or {}).get("level") for name in ("a", "b"))]
        for section, part in by_name["a"].items()
    ]
    findings = [
        [part["title"], *("\n".join(by_name[name][section]["findings"]) for name in ("a", "b"))]
        for section, part in by_name["a"].items()
    ]
    differing = [row[0] for row in rows if row[1] != row[2]]
    said = f"The verdicts differ in: {'; '.join(differing)}." if differing else "All verdicts are the same."
    values = {section: {"a": row[1], "b": row[2]} for section, row in zip(by_name["a"], rows, strict=True)}
    tables = [Table(["section", "a", "b"], rows), Table(["section", "a found", "b found"], findings)]
    text = "The whole report of each stands in the folders a and b. Each verdict's rule is in these reports."
    return Section("verdicts", "Verdicts and findings side by side", text, [said], values, tables)


def write_comparison(
    folder: Path, abouts: Mapping[str, dict[str, Any]], parts: Mapping[str, Sequence[Part]], pair: Section
) -> list[Part]:
    """Write the report on both, and one for each in folders of their own. Returns the sections of the first."""
    for name, about in abouts.items():
        write_report(folder / name, about, parts[name])
    both = {
        key: "; ".join(f"{name}: {about[key]}" for name, about in abouts.items())
        for key in ("checkpoint", "weights", "model", "guide", "prior")
    }
    joined = [render(verdicts_side_by_side(parts)), render(pair)]
    write_report(folder, {**abouts["a"], **both, "objective": None, "trained": {}}, joined)
    return joined
