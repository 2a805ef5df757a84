"""Which episodes are pictured, that their replay is the episode of the table, and why the others fail."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
from matplotlib import colors
from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.evaluation import evaluate
from cavin_pyro.reproduction.cells import Cell, Evaluation
from cavin_pyro.reproduction.episodes.choice import caption, choose
from cavin_pyro.reproduction.episodes.failures import failure_table, failures, kind_of
from cavin_pyro.reproduction.episodes.failures_figure import COLORS, draw_failures
from cavin_pyro.reproduction.episodes.picture import draw_chosen_episodes
from cavin_pyro.reproduction.episodes.replay import replay, stored_configuration
from cavin_pyro.reproduction.table import episode_row
from cavin_pyro.storage.run_directory import write_config
from cavin_pyro.visualization.plan import FAILURE_COLOR

CELL = {"method": "cavin", "planner": "paper", "task": "crossing", "reward": "sparse", "objects": 3}


def row(seed: int, outcome: str, strict: str | None = None, **more: Any) -> dict[str, Any]:
    """A row of the table."""
    return {
        **CELL,
        "training_seed": seed % 2,
        "seed": seed,
        "published_outcome": outcome,
        "strict_outcome": strict or outcome,
        **{f"{criterion}_{name}": 10 for criterion in ("strict", "published") for name in ("steps", "return")},
        **{"unsafe": 1, "ineffective": 2, "plans": 20, "plans_reaching_goal": 0},
        **more,
    }


def shares_of_color(path: Path, color: str) -> int:
    distance = np.abs(imageio.imread(path)[..., :3].astype(int) - np.round(255 * np.array(colors.to_rgb(color))))
    return int((distance.max(axis=-1) < 3).sum())


def test_the_first_three_successes_and_failures_are_chosen_by_their_scenes() -> None:
    outcomes = {
        9: "success",
        4: "fall",
        1: "timeout",
        7: "success",
        2: "success",
        8: "violation",
        3: "success",
        6: "fall",
    }
    table = [row(seed, outcome) for seed, outcome in outcomes.items()]
    others = {"method": "mpc", "planner": "ours", "task": "clearing", "reward": "dense", "objects": 5}
    table += [row(0, outcome, **{name: value}) for name, value in others.items() for outcome in ("success", "fall")]
    chosen = choose(table, "crossing", "published")
    assert [one["seed"] for one in chosen.successes] == [2, 3, 7]
    assert [one["seed"] for one in chosen.failures] == [1, 4, 6]


def test_the_criterion_decides_what_a_success_is_and_few_failures_are_all_chosen() -> None:
    table = [row(seed, "success", strict="violation" if seed == 2 else None) for seed in range(5)]
    assert not choose(table, "crossing", "published").failures
    chosen = choose(table, "crossing", "strict")
    assert [one["seed"] for one in chosen.rows] == [0, 1, 3, 2]


@pytest.mark.parametrize(
    ("outcome", "reaching", "kind", "said"),
    [
        ("success", 20, "success", "scene 7, training 1: success after 10 pushes"),
        ("violation", 0, "violation", "scene 7, training 1: failure after 10 pushes: a constraint was violated"),
        ("fall", 20, "fall", "scene 7, training 1: failure after 10 pushes: an object left the table"),
        ("timeout", 0, "never", "10 pushes were not enough; 0 of 20 plans expected success"),
        ("timeout", 1, "seldom", "10 pushes were not enough; 1 of 20 plans expected success"),
        ("timeout", 2, "promised", "10 pushes were not enough; 2 of 20 plans expected success"),
    ],
)
def test_a_failure_has_a_reason(outcome: str, reaching: int, kind: str, said: str) -> None:
    one = row(7, outcome, plans_reaching_goal=reaching)
    assert kind_of(one, "strict") == kind
    assert caption(one, "published").endswith(said)


def test_failures_are_counted_by_hand(tmp_path: Path) -> None:
    table = [
        row(0, "success", strict="violation", published_steps=4, unsafe=3),
        row(1, "timeout", published_steps=60, unsafe=12, ineffective=30),
        row(2, "timeout", published_steps=60, plans_reaching_goal=15, unsafe=0, ineffective=0),
        row(3, "fall", published_steps=1, unsafe=0, ineffective=0),
        row(4, "fall", reward="dense"),
        row(5, "fall", objects=4),
    ]
    strict, published = failures(table)
    expected = {"success": 0, "violation": 1, "fall": 1, "never": 1, "seldom": 0, "promised": 1, "episodes": 4}
    assert {name: strict[name] for name in expected} == expected
    assert {name: published[name] for name in expected} == {**expected, "success": 1, "violation": 0}
    assert strict["unsafe"] == pytest.approx(15 / 125) and published["ineffective"] == pytest.approx(32 / 125)
    *_, line = failure_table([strict, published], "paper", "strict")
    assert line == "| crossing | CAVIN | 4 | 25.0 % | 25.0 % | 25.0 % | 0.0 % | 25.0 % | 12.0 % | 25.6 % |"
    draw_failures(tmp_path / "failures.png", [strict, published], planner="paper", criterion="strict")
    areas = {kind: shares_of_color(tmp_path / "failures.png", color) for kind, color in COLORS.items()}
    assert areas["violation"] == pytest.approx(areas["promised"], rel=0.1)
    assert areas["violation"] > 5 * areas["seldom"] > 0  # of which the legend alone has some


@pytest.fixture(scope="module")
def small_run(configure: Callable[..., DictConfig], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A reproduction with two episodes of the chosen cell, and its table."""
    home = tmp_path_factory.mktemp("reproduced")
    one = Evaluation(Cell(**CELL), 0, 5, 2)
    folder = home / "evaluate" / one.name
    folder.mkdir(parents=True)
    config = configure(
        "planner=paper", "criterion=published", "reward=sparse", "objects=3", "maximum_steps=4", "seed=5"
    )
    config.episodes, config.workers, config.output = one.episodes, 1, str(folder)
    write_config(folder, config)
    return home, [episode_row(one, line) for line in evaluate(config, folder)]


@pytest.mark.parametrize("criterion", ["strict", pytest.param("published", marks=pytest.mark.soak)])
def test_chosen_episodes_are_replayed_and_drawn_below_one_another(
    criterion: str, small_run: tuple[Path, list[dict[str, Any]]], tmp_path: Path
) -> None:
    home, table = small_run
    assert {one[f"{criterion}_outcome"] for one in table} == {"timeout"}
    found = draw_chosen_episodes(tmp_path, [tmp_path, home], table, criterion)
    assert found == [tmp_path / f"episodes-crossing-{criterion}.png"]
    both = imageio.imread(found[0]).shape[0]
    assert shares_of_color(found[0], FAILURE_COLOR) > 500  # captions, and titles of the ends
    draw_chosen_episodes(tmp_path, [home], table[:1], criterion)
    assert both - imageio.imread(found[0]).shape[0] == pytest.approx(120 * 2.2, abs=2)


@pytest.mark.soak
def test_a_replay_that_ends_otherwise_than_in_the_table_is_told(small_run: tuple[Path, list[dict[str, Any]]]) -> None:
    home, (one, _) = small_run
    assert replay([home], one, "published").episode.total_reward == one["published_return"]
    ended = f"timeout after {one['published_steps']} pushes, return {one['published_return']:.3f}"
    for name, value, told in (
        ("outcome", "fall", "fall after"),
        ("steps", 3, "after 3 p"),
        ("return", 1.5, "return 1.500"),
    ):
        with pytest.raises(UserError, match=f"scene 5 of crossing .*{ended}, but the table says .*{told}"):
            replay([home], {**one, f"published_{name}": value}, "published")


def copied(home: Path, folder: Path) -> Path:
    """The configuration of the one evaluation in a copy of a reproduction."""
    shutil.copytree(home, folder)
    (path,) = (folder / "evaluate").glob("*/config.yaml")
    return path


def test_a_moved_reproduction_has_its_own_checkpoint_and_one_without_the_cell_is_told(
    small_run: tuple[Path, list[dict[str, Any]]], tmp_path: Path
) -> None:
    home, (one, _) = small_run
    path = copied(home, tmp_path / "moved")
    stored = stored_configuration([home], one).checkpoint
    path.write_text(path.read_text().replace(stored, "/gone/checkpoint.safetensors"))
    moved = stored_configuration([tmp_path / "moved"], one)
    assert moved.checkpoint == str(tmp_path / "moved" / "train" / "cavin-0" / "checkpoint.safetensors")
    with pytest.raises(
        UserError, match=r"no evaluate/cavin-paper-crossing-sparse-3-1/config.yaml in .*: pictures need"
    ):
        stored_configuration([home], {**one, "training_seed": 1})


def test_an_evaluation_of_before_the_first_push_was_tracked_is_replayed_with_ends(
    small_run: tuple[Path, list[dict[str, Any]]], tmp_path: Path
) -> None:
    home, (one, _) = small_run
    path = copied(home, tmp_path / "older")
    lines = path.read_text().splitlines()
    (place,) = (number for number, line in enumerate(lines) if line.strip().startswith("tracking_at:"))
    lines[place] = "  running_cost_share: 0.0"
    path.write_text("\n".join(lines))
    older = stored_configuration([tmp_path / "older"], one)
    assert older.planner == stored_configuration([home], one).planner
