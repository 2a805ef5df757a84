"""Paired comparison of two evaluations on the same scenes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.options import flat_options
from cavin_pyro.evaluation.rollout import OUTCOMES
from cavin_pyro.evaluation.rows import Row, violation
from cavin_pyro.evaluation.statistics import mcnemar
from cavin_pyro.models.checks import check_choice, check_number
from cavin_pyro.storage.run_directory import stored_options

# Options, or sections of them.
SAME_SCENES = ("task", "layout", "tiles", "generated", "criterion", "objects", "maximum_steps", "env")


@dataclass(frozen=True)
class Comparison:
    """Numbers of scenes that both methods solve, only the one, only the other, or neither, and a test.

    p_value: of the exact two-sided McNemar test on the scenes that only one method solves.
    """

    both: int
    one_alone: int
    other_alone: int
    neither: int
    p_value: float

    @property
    def episodes(self) -> int:
        """Scenes in the comparison."""
        return self.both + self.one_alone + self.other_alone + self.neither


Evaluation = str | Path | Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""The folder of a finished evaluation, what `evaluate` has returned, or its rows `per_episode`."""


def compare(one: Evaluation, other: Evaluation) -> Comparison:
    """Compare two evaluations scene by scene, where both have the seed.

    cavin_pyro.compare("runs/evaluate/one", "runs/evaluate/other").p_value

    Raises:
        UserError: they have no seed in common, a folder holds no finished evaluation, or scenes of folders differ.
    """
    (mine, here), (theirs, there) = _opened(one), _opened(other)
    if here is not None and there is not None:
        _check_same_scenes(here, there, other)
    solved = {row["seed"]: row["outcome"] == "success" for row in theirs}
    if len(solved) < len(theirs) or len({row["seed"] for row in mine}) < len(mine):
        raise UserError("an evaluation has a seed twice: give each scene once")
    pairs = [(row["outcome"] == "success", solved[row["seed"]]) for row in mine if row["seed"] in solved]
    if not pairs:
        raise UserError("the two evaluations have no seed in common: give both the same seed=")
    counts = {kind: pairs.count(kind) for kind in ((True, True), (True, False), (False, True), (False, False))}
    alone, others = counts[True, False], counts[False, True]
    return Comparison(counts[True, True], alone, others, counts[False, False], mcnemar(alone, others))


def earlier_rows(folder: Path, config: DictConfig) -> list[Row]:
    """The episodes of another evaluation, whose scenes and rules must be those of `config`, or a `UserError`."""
    rows, theirs = _finished(folder)
    _check_same_scenes(flat_options(OmegaConf.to_container(config, resolve=True)), theirs, folder)
    return rows


def _opened(evaluation: Evaluation) -> tuple[Sequence[Mapping[str, Any]], Row | None]:
    """The rows of an evaluation, and its options if it is a folder."""
    if isinstance(evaluation, str | Path):
        return _finished(Path(evaluation))
    with user_input(where="these rows are no evaluation"):
        rows = evaluation["per_episode"] if isinstance(evaluation, Mapping) else evaluation
        for row in rows:
            check_choice("outcome", row["outcome"], OUTCOMES)
            check_number("seed", row["seed"], whole=True)
    return rows, None


def _finished(folder: Path) -> tuple[list[Row], Row]:
    """The rows and the options of a finished evaluation."""
    try:
        rows = json.loads((folder / "results.json").read_text(encoding="utf-8"))["per_episode"]
        theirs = stored_options(folder / "config.yaml")
    except OSError as error:
        name = Path(error.filename or folder).name
        raise UserError(f"compare={folder} is no finished evaluation: {name}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, RecursionError, OmegaConfBaseException, YAMLError) as error:
        raise UserError(f"compare={folder} holds no results of evaluate, or damaged ones: evaluate it again") from error
    wrong = next(filter(None, map(violation, rows)), None) if isinstance(rows, list) else "no list of episodes"
    if wrong:
        raise UserError(f"compare={folder} holds damaged results ({wrong}): evaluate it again")
    return rows, theirs


def _check_same_scenes(mine: Row, theirs: Row, folder: object) -> None:
    for name in sorted(set(mine) | set(theirs)):
        if name.partition(".")[0] in SAME_SCENES and mine.get(name) != theirs.get(name):
            raise UserError(f"compare={folder} has {name}={theirs.get(name)}, not {mine.get(name)}: its scenes differ")


def sentences(result: Comparison, other: Path) -> str:
    """The comparison for people."""
    share = [100 * (result.both + alone) / result.episodes for alone in (result.one_alone, result.other_alone)]
    return (
        f"success in the {result.episodes} scenes of both: {share[0]:.1f} % here, {share[1]:.1f} % in {other}\n"
        f"both solve {result.both}, this one alone {result.one_alone}, the other alone {result.other_alone}, "
        f"neither {result.neither}; exact McNemar test p = {result.p_value:.3g}"
    )
