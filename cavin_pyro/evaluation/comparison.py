"""Methods compared scene by scene: success, intervals and paired tests, in a table and as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Number
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf.errors import OmegaConfBaseException
from statsmodels.stats.multitest import multipletests
from yaml import YAMLError

from cavin_pyro.config.errors import UserError, one_line, user_input
from cavin_pyro.evaluation.rollout import OUTCOMES
from cavin_pyro.evaluation.rows import Row, violation
from cavin_pyro.evaluation.statistics import hierarchical_interval, mcnemar, wilson
from cavin_pyro.storage.files import atomic_write, read_json
from cavin_pyro.storage.run_directory import stored_options

# Options, or sections of them.
SAME_SCENES = ("task", "layout", "tiles", "generated", "criterion", "objects", "maximum_steps", "env", "world")
COLUMNS = ("method", "training", "seed", "success", "steps")
READERS = {".csv": pd.read_csv, ".parquet": pd.read_parquet}
PAGE = """<!doctype html><meta charset="utf-8"><title>Comparison</title>
<style>body {{ font: 16px sans-serif; margin: 2em }} td, th {{ padding: 0.3em 0.8em; text-align: right }}
th:first-child {{ text-align: left }} tr:nth-child(even) {{ background: #f2f2f2 }}</style>
<h1>Success, scene by scene</h1>{table}
<p>Intervals are at 95 %: Wilson's over episodes; over trainings the bootstrap of trainings first and of their episodes
then. p: exact sign test of the scenes that the first method or this one solves more often over its trainings (with one
training each McNemar's), and with Holm's correction. Detectable: the difference that so many scenes would show with a
probability of 80 %.</p>"""

Evaluation = str | Path | Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""The folder of a finished evaluation, what `evaluate` has returned, its rows `per_episode`, or a table of episodes."""


def compare(*evaluations: Evaluation, **methods: Sequence[Evaluation]) -> pd.DataFrame:
    """Compare methods with the first, in the scenes that both have: a row per method.

    table = cavin_pyro.compare("runs/one", "runs/other")
    table = cavin_pyro.compare("runs/one", mine=["runs/seed-0", "runs/seed-1", "runs/seed-2"])  # three trainings

    Args:
        evaluations: one for each method. A table, FILE.csv or FILE.parquet of any program, has a row per episode with
            `seed`, `success` and perhaps `steps`, `method` and `training`. methods: by name, evaluations that differ
            in the training of their model.

    Returns:
        `episodes`, `trainings`, `success` and its `interval` in per cent, that `over trainings`, the share `solved at
        the start`; `scenes` of both, `first better`, `this better`, `p`, `p, Holm`, and the `detectable` difference.

    Raises:
        UserError: an evaluation that cannot be read or has a scene twice, other scenes, or none in common.
    """
    paths = (str, Path)
    given: list[tuple[str, Any]] = [
        (str(one) if isinstance(one, paths) else f"method {number}", [one]) for number, one in enumerate(evaluations, 1)
    ]
    given += [(name, runs if isinstance(runs, list | tuple) else [runs]) for name, runs in methods.items()]
    if not given or not all(runs for _, runs in given):
        raise UserError("there is nothing to compare: give at least one evaluation of each method")
    options: list[Row] = []
    found = [
        _rows(run, name, training, options).assign(**({"method": name} if name in methods else {}))
        for name, runs in given
        for training, run in enumerate(runs)
    ]
    own = [name for rows in found[: len(evaluations)] for name in rows["method"].unique()]
    if shared := [name for name in own if own.count(name) > 1]:
        raise UserError(f"two evaluations are of a method {shared[0]}: give its trainings as --method NAME RUN RUN")
    episodes = pd.concat(found, ignore_index=True)
    if (twice := episodes.duplicated(["method", "training", "seed"])).any():
        name, seed = episodes.loc[twice.idxmax(), ["method", "seed"]]
        raise UserError(f"{name} has seed {seed} twice: give each scene once, or a column training")
    groups = dict(iter(episodes.groupby("method", sort=False)))
    (first, reference), *others = groups.items()
    table = pd.DataFrame.from_dict({name: _rate(own) for name, own in groups.items()}, orient="index")
    if others:
        tests = {name: _test(reference, own, f"{name} and {first}") for name, own in others}
        compared = pd.DataFrame.from_dict(tests, orient="index")
        compared.insert(4, "p, Holm", multipletests(compared["p"], method="holm")[1])
        table = table.join(compared)
    return table


def _rows(run: Evaluation, name: str, training: int, options: list[Row]) -> pd.DataFrame:
    """The episodes of an evaluation: method, training, seed, success (bool), steps; a folder's `options` grow."""
    where = str(run) if isinstance(run, str | Path) else f"{name}, of {type(run).__name__},"
    if isinstance(run, str | Path) and Path(run).suffix in READERS:
        if not Path(run).is_file():
            raise UserError(f"there is no table {run}")
        with user_input(where=f"{run} is no table"):
            found = READERS[Path(run).suffix](Path(run))
    elif isinstance(run, str | Path):
        rows, theirs = _finished(Path(run))
        options.append(theirs)
        for option in sorted({*options[0], *theirs}):
            if option.partition(".")[0] in SAME_SCENES and (one := theirs.get(option)) != options[0].get(option):
                raise UserError(f"{run} has {option}={one}, not {options[0].get(option)}: its scenes differ")
        found = pd.DataFrame(rows)
    elif isinstance(run, pd.DataFrame):
        found = run
    else:
        with user_input(where=f"{where} is neither a folder nor what evaluate has returned"):
            found = pd.DataFrame(run["per_episode"] if isinstance(run, Mapping) else list(run))
    if "success" not in found and "outcome" in found and found["outcome"].isin(OUTCOMES).all():
        found["success"] = found["outcome"] == "success"
    found = found.assign(method=found.get("method", name), training=found.get("training", training))
    for column, kinds in {"seed": "iu", "success": "biuf", "method": "OU", "training": "iuOU", "steps": "iuf"}.items():
        if column == "steps" and column not in found:
            continue
        if column not in found or found.empty:
            raise UserError(f"{where} has no {column if len(found) else 'episode'}: a row has seed and success")
        values = found[column]
        fits = values.dtype.kind in kinds and values.map(lambda one: isinstance(one, str | Number)).all()
        if not (fits and values.notna().all()) or (column == "success" and not values.isin([0, 1]).all()):
            raise UserError(f"{where} has a {column} that cannot be: seeds are whole numbers, success is true or false")
    return found[[name for name in COLUMNS if name in found]].astype({"success": bool})


def _finished(folder: Path) -> tuple[list[Row], Row]:
    """The rows and the options of a finished evaluation."""
    try:
        rows, theirs = read_json(folder / "results.json")["per_episode"], stored_options(folder / "config.yaml")
    except (UserError, OSError, ValueError, KeyError, TypeError, OmegaConfBaseException, YAMLError) as error:
        raise UserError(f"{folder} holds no finished evaluation, or a damaged one: {one_line(error)}") from error
    wrong = next(filter(None, map(violation, rows)), None) if isinstance(rows, list) else "no list of episodes"
    wrong = wrong or (None if theirs else "no options")
    if wrong:
        raise UserError(f"{folder} holds damaged results ({wrong}): evaluate it again")
    return rows, theirs


def _rate(own: pd.DataFrame) -> Row:
    rate, trainings = wilson(int(own["success"].sum()), len(own)), own["training"].nunique()
    over = ""
    if trainings > 1:
        low, high = hierarchical_interval(own["success"].to_numpy(), own["training"].to_numpy())
        over = f"{100 * low:.1f} to {100 * high:.1f}"
    return {
        "episodes": len(own),
        "trainings": trainings,
        "success": f"{100 * rate['rate']:.1f} %",
        "interval": f"{100 * rate['low']:.1f} to {100 * rate['high']:.1f}",
        "over trainings": over,
        "solved at the start": f"{100 * (own['steps'] == 0).mean():.1f} %" if "steps" in own else "",
    }


def _test(reference: pd.DataFrame, own: pd.DataFrame, names: str) -> Row:
    """Scenes of both, and which method solves each of them more often over its trainings: with one each, McNemar's."""
    rates = pd.concat([one.groupby("seed")["success"].mean() for one in (reference, own)], axis=1, join="inner")
    if rates.empty:
        raise UserError(f"{names} have no seed in common: evaluate both with the same seed=")
    change = rates.iloc[:, 1] - rates.iloc[:, 0]
    worse, better = int((change < 0).sum()), int((change > 0).sum())
    shown = min(100.0, 280 * (worse + better) ** 0.5 / len(rates))  # 1.96 + 0.84 standard errors of the difference
    counts = {"scenes": len(rates), "first better": worse, "this better": better, "p": mcnemar(worse, better)}
    return {**counts, "detectable": f"{shown:.1f} points" if shown else "-"}


def as_text(table: pd.DataFrame) -> str:
    """What `compare` found, for a terminal."""
    return table.to_string(na_rep="", float_format="{:.2g}".format)


def write_page(path: Path, table: pd.DataFrame) -> None:
    """Write what `compare` found as a page of HTML, atomically."""
    html = table.to_html(border=0, na_rep="", float_format="{:.2g}".format)
    with atomic_write(path) as temporary:
        temporary.write_text(PAGE.format(table=html), encoding="utf-8")
