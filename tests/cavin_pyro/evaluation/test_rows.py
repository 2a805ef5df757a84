"""Lines of `episodes.jsonl` that somebody changed or added."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation import evaluation, factory
from cavin_pyro.evaluation.comparison import earlier_rows
from cavin_pyro.evaluation.evaluation import evaluate
from cavin_pyro.evaluation.rows import finished_episodes
from cavin_pyro.evaluation.success.predictors import SUCCESS_PREDICTORS as MEANING
from planning.inputs import NoFiniteCandidateError

PREDICTORS: dict[str, list[Any]] = {name: [0, 0.5] for name in MEANING} | {
    "pushes_left": [60, 59],
    "allowed_distance": [None, None],
}
SHORT = json.dumps(PREDICTORS)[:40]
ROW: dict[str, Any] = {
    "seed": 10,
    "outcome": "success",
    "steps": 4,
    "return": 7.5,
    "strict_outcome": "violation",
    "strict_steps": 2,
    "strict_return": 1.5,
    "unsafe": 0,
    "ineffective": 1,
    "plans": 2,
    "plans_reaching_goal": 2,
    "success_predictors": PREDICTORS,
    "success_probability": [0.9, 1],
    "subgoal_distance": None,
    "planning_ms": [1.5, 2],
}


def written(folder: Path, *rows: Any) -> Path:
    path = folder / "episodes.jsonl"
    path.write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    return path


def test_rows_of_this_and_of_older_versions_are_read(tmp_path: Path) -> None:
    later = ("strict", "plans", "success_predictors", "probability")
    older = {name: value for name, value in ROW.items() if not any(part in name for part in later)}
    path = written(tmp_path, ROW, {**older, "seed": 11}, ROW)
    with open(path, "a") as file:
        file.write('{"seed": 12, "outc')  # cut off by a kill
    assert finished_episodes(path) == {10: ROW, 11: {**older, "seed": 11}}


def under_old_names(values: dict[str, Any], **names: str) -> dict[str, Any]:
    return {names.get(name, name): value for name, value in values.items()}


def test_rows_with_an_old_name_are_read_under_the_new_one(tmp_path: Path) -> None:
    predictors = under_old_names(PREDICTORS, allowed_distance="way", allowed_distance_after="way_after")
    row = {**ROW, "success_predictors": predictors}
    old = under_old_names(row, plans_reaching_goal="hopeful_plans", success_predictors="prospects")
    assert finished_episodes(written(tmp_path, old, {**ROW, "seed": 11})) == {10: ROW, 11: {**ROW, "seed": 11}}
    (tmp_path / "config.yaml").write_text("seed: 10\n")
    (tmp_path / "results.json").write_text(json.dumps({"per_episode": [old]}))
    assert earlier_rows(tmp_path, OmegaConf.create({"seed": 10})) == [ROW]


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ([1], "it is no section"),
        ({"seed": 11}, "'outcome' is missing"),
        ({**ROW, "outcom": "success"}, "'outcom' is unknown"),
        ({**ROW, "hopeful_plans": 3}, "'hopeful_plans' is unknown"),  # beside the new name
        ({**ROW, "seed": 11, "outcome": "sucess"}, 'outcome cannot be "sucess"'),
        ({**ROW, "seed": "11"}, 'seed cannot be "11"'),
        ({**ROW, "seed": True}, "seed cannot be true"),
        ({**ROW, "seed": 11, "return": float("nan")}, "return cannot be NaN"),
        ({**ROW, "seed": 11, "steps": -1}, "steps cannot be -1"),
        ({**ROW, "seed": 11, "planning_ms": 5}, "planning_ms cannot be 5"),
        ({**ROW, "seed": 11, "success_probability": [1.5]}, "success_probability cannot be [1.5]"),
        ({**ROW, "seed": 11, "success_predictors": {"step": [0]}}, 'success_predictors cannot be {"step": [0]}'),
        (
            {**ROW, "success_predictors": {**PREDICTORS, "allowed_distance": 1}, "seed": 11},
            f"success_predictors cannot be {SHORT}",
        ),
        ({**ROW, "steps": 5}, "an earlier line has another episode with seed 10"),
    ],
)
def test_a_line_that_is_no_episode_is_named(row: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as refused:
        finished_episodes(written(tmp_path, ROW, row))
    assert f"episodes.jsonl, line 2 is no episode ({said})" in str(refused.value)


LOCAL = {"launcher": "local", "workers": 1, "address": None}


def test_an_episode_that_nobody_asked_for_displaces_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [{**ROW, "seed": seed} for seed in (3, 10, 11, 12)]
    written(tmp_path, *rows)
    monkeypatch.setattr(evaluation, "run_jobs", lambda jobs, workers: (job for job in ()))
    config = OmegaConf.create({**LOCAL, "seed": 10, "episodes": 3, "shard": "1/1"})
    assert evaluate(config, tmp_path) == rows[1:]


def test_damaged_results_are_not_compared_with(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("seed: 3\n")
    for rows in ({"a": 1}, [{**ROW, "outcome": "sucess"}], "text"):
        (tmp_path / "results.json").write_text(json.dumps({"per_episode": rows}))
        with pytest.raises(UserError, match=r"holds damaged results \(.*\): evaluate it again"):
            earlier_rows(tmp_path, OmegaConf.create({}))


def test_a_model_that_predicts_nothing_finite_ends_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*parts: Any, **options: Any) -> None:
        raise NoFiniteCandidateError(0, "none of the 8 returns of effect plans is finite")

    monkeypatch.setattr(factory, "rollout", fail)
    runner: Any = factory.EpisodeRunner(env=None, planner=None, geometry=None, pushes_per_plan=1)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="none of the 8 returns of effect plans is finite"):
        runner.rollout(3)
