"""A probability is given to the planners and scenes that it was fitted for, and to no others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.success.fit import fit, read_evaluation, write_regressions
from cavin_pyro.evaluation.success.predictors import plans_of
from cavin_pyro.evaluation.success.probability import Regression, Unfitted, probability_for, read_regressions
from tests.cavin_pyro.evaluation.success.made_up import evaluation, rows


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fit for the default planner in crossing, layout 0, with three to five objects."""
    folder = tmp_path_factory.mktemp("fit")
    evaluations = [evaluation(folder / str(objects), 60, f"objects={objects}") for objects in (3, 5)]
    write_regressions(folder / "fit.json", [fit([read_evaluation(one) for one in evaluations], "mine")], {})
    return folder / "fit.json"


def test_a_fit_is_read_as_it_was_written(file: Path) -> None:
    (found,) = read_regressions(file)
    write_regressions(file.with_name("again.json"), [found], {})
    assert file.with_name("again.json").read_text() == file.read_text()


@pytest.mark.parametrize(
    "options",
    [(), ("objects=4",), ("seed=9",), ("planner.compile=true",), ("episodes=3", "workers=1")],
)
def test_the_planner_and_the_scenes_of_a_fit_get_its_probability(options: tuple[str, ...], file: Path) -> None:
    found = probability_for(compose("evaluate", f"success_probability={file}", *options))
    assert isinstance(found, Regression)
    plans = plans_of(rows(1)[0]["success_predictors"])
    assert 0.0 < (found(plans) or 0.0) < 1.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("planner.horizon=60",), "planner.horizon=60"),
        (("planner.guidance=layout",), "planner.guidance=layout"),
        (("checkpoint=kinect",), "checkpoint=kinect"),
        (("env.segmentation=clusters",), "env.segmentation=clusters"),
        (("layout=1",), "layout=1"),
        (("objects=2",), "objects=2"),
        (("maximum_steps=90",), "maximum_steps=90"),
        (("task=clearing",), "task._target_=envs.tasks.clearing.Clearing"),
        (("planner=mpc",), "planner"),
        (
            ("planner.motion_optimizer={_target_: planning.optimizers.CrossEntropy}",),
            "planner.motion_optimizer=planning.optimizers.CrossEntropy",
        ),
    ],
)
def test_any_other_is_uncalibrated_and_told_why(options: tuple[str, ...], said: str, file: Path) -> None:
    found = probability_for(compose("evaluate", f"success_probability={file}", *options))
    assert isinstance(found, Unfitted) and found.why.startswith(f"not fitted for {said}")
    assert found([]) is None


def test_the_nearest_fit_is_one_for_such_scenes(file: Path) -> None:
    content = json.loads(file.read_text())
    (mine,) = content["regressions"]
    elsewhere = json.loads(json.dumps(mine).replace("crossing.Crossing", "clearing.Clearing"))
    elsewhere["planner"] |= {"planner.samples": 32, "planner.horizon": 60}
    both = file.with_name("both.json")
    both.write_text(json.dumps({**content, "regressions": [elsewhere, mine]}))
    found = probability_for(
        compose("evaluate", f"success_probability={both}", "planner.samples=32", "planner.horizon=60")
    )
    assert isinstance(found, Unfitted) and found.why == "not fitted for planner.samples=32 and planner.horizon=60"


def test_a_planner_that_predicts_nothing_gets_none_without_a_word(file: Path) -> None:
    assert probability_for(compose("plan", f"success_probability={file}", "planner=random")) == Unfitted("")


def test_an_option_younger_than_the_fit_must_have_its_default(file: Path) -> None:
    content = json.loads(file.read_text())
    del content["regressions"][0]["planner"]["planner.idle_distance"]
    older = file.with_name("older.json")
    older.write_text(json.dumps(content))
    assert isinstance(probability_for(compose("evaluate", f"success_probability={older}")), Regression)
    changed = probability_for(compose("evaluate", f"success_probability={older}", "planner.idle_distance=0"))
    assert isinstance(changed, Unfitted)


def test_a_plan_that_does_not_tell_enough_gets_none(file: Path) -> None:
    (found,) = read_regressions(file)
    plans = plans_of(rows(1)[0]["success_predictors"])
    assert found([{**plans[0], "failures": float("nan")}]) is None


@pytest.mark.parametrize(
    "change",
    [
        {"format": "another"},
        {"regressions": None},
        {"regressions": [{}]},
        {"regressions": [{"slopes": {"luck": 1.0}}]},
    ],
)
def test_a_damaged_file_is_refused_in_one_line(change: dict[str, Any], file: Path) -> None:
    damaged = file.with_name("damaged.json")
    damaged.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(
        UserError, match=r"is no file of benchmarks/success_probability.py, or damaged .*: fit it again"
    ):
        probability_for(compose("evaluate", f"success_probability={damaged}"))


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for path in ("/dev/zero", tmp_path, tmp_path / "missing"):
        with pytest.raises(UserError, match="is no file of up to 10,000,000 bytes"):
            probability_for(compose("evaluate", f"success_probability={path}"))


SHIPPED = {
    "default": ("objects=3",),
    "guided": ("planner.guidance=layout", "layout=generated", "generated.tiles=12", "maximum_steps=120"),
    "default, horizon 3": ("task=rearrange", "planner.horizon=3"),
}


@pytest.mark.parametrize(("name", "options"), SHIPPED.items(), ids=SHIPPED)
def test_the_shipped_planners_have_a_fit(name: str, options: tuple[str, ...]) -> None:
    """If a default changes on purpose: fit anew, `benchmarks/success_probability.py`."""
    found = probability_for(compose("plan", *options))
    assert isinstance(found, Regression) and found.name == name


@pytest.mark.parametrize("option", ["layout=1", "planner.horizon=60", "objects=1", "planner=sectar", "planner=paper"])
def test_the_shipped_fit_does_not_pretend_to_know_others(option: str) -> None:
    found = probability_for(compose("plan", option))
    assert isinstance(found, Unfitted)
    assert found.why.startswith("not fitted for " if option.startswith("planner=") else f"not fitted for {option}")
