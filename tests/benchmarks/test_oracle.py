"""The oracle's second world mirrors the real one, its choice is the best outcome, and its report tells who wins."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.factory import make_environment
from envs.workspace import push_endpoints
from models.state import State
from planning import PerturbedRollouts
from planning.rollouts.ranking import SubgoalDistance
from tests.benchmarks.loading import load
from tests.cavin_pyro.conftest import run_script

ROOT = Path(__file__).parents[2]
TINY = ("--objects", "2", "--planner", "cavin", "--candidates", "2", "--seed", "3")
OVERRIDES = ("planner.samples=8", "planner.horizon=6", "maximum_steps=3", "pushes_per_plan=null")


@pytest.fixture(scope="module")
def benchmark() -> Any:
    return load("oracle")


def test_the_oracle_foretells_pushes_without_touching_the_episode(benchmark: Any) -> None:
    config = compose("evaluate", "planner=paper", "objects=3")
    env, alone = make_environment(config), make_environment(config)
    mirror = benchmark.Oracle(config, env, 2)
    seen = env.reset(seed=7)[0]["centers"]
    alone.reset(seed=7)
    mirror.reset(7)
    box = push_endpoints(np.array([[-1.0, -1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]]))[0]
    for target in env.scene.ground_truth().positions[:2, :2]:
        start = 2.0 * (target - (0.08, 0.0) - box[0]) / (box[1] - box[0]) - 1.0
        actions = np.array([[*start, 0.9, 0.1]] * 2, dtype=np.float32)  # the second meets what the first has left
        before = env.scene.ground_truth()
        foretold = mirror.path(actions)
        # From the real poses again, up to what contacts of the last run have left in the simulator.
        np.testing.assert_allclose(mirror.path(actions)[0], foretold[0], atol=0.02)
        assert not np.allclose(foretold[-1], seen, atol=0.01)
        after = env.scene.ground_truth()
        assert np.array_equal(before.positions, after.positions)
        assert np.array_equal(before.orientations, after.orientations)
        for action, centers in zip(actions, foretold, strict=True):
            observed, untouched = env.step(action)[0], alone.step(action)[0]
            assert all(np.array_equal(observed[name], untouched[name]) for name in observed)
            seen = observed["centers"]
            assert np.allclose(seen, centers, atol=0.005)
    for one in (env, alone, mirror.twin):
        one.close()


def test_the_motion_with_the_best_outcome_is_chosen_unless_it_fails(benchmark: Any) -> None:
    """Motion k is known by its first number; the simulator says where it leads, f says the opposite."""
    ends = torch.tensor([0.3, 0.1, 0.0, 0.2])  # metres from the subgoal
    here = State(torch.zeros(1, 1, 3), torch.zeros(1, 1, 2), torch.ones(1, 1, dtype=torch.bool))
    subgoals = State(torch.zeros(1, 1, 1, 3), torch.zeros(1, 1, 1, 2), torch.ones(1, 1, 1, dtype=torch.bool))
    actions = torch.arange(4.0).view(1, 4, 1, 1).expand(1, 4, 2, 4)
    motions = SimpleNamespace(problem=SimpleNamespace(state=here), at=lambda segment, field: actions)

    def reward(previous: torch.Tensor, centers: torch.Tensor, mask: torch.Tensor) -> Any:
        nothing = torch.zeros(mask.shape[:-1])
        return SimpleNamespace(reward=nothing, success=nothing.bool(), failure=centers[..., 0, 1] > 0.5)

    def chosen(candidates: int, failing: int, failure_cost: float = 0.3) -> int:
        def path(pushes: np.ndarray) -> np.ndarray:
            number = int(pushes[0, 0])
            side = 1.0 if number == failing else 0.0  # on the way only
            return np.array([[[0.0, side, 0.0]], [[ends[number], 0.0, 0.0]]], dtype=np.float32)

        oracle = SimpleNamespace(candidates=candidates, path=path)
        scores, later = ends.unsqueeze(0), torch.zeros(1, 4)
        rules = PerturbedRollouts(failure_cost=failure_cost)
        what = motions, scores, later, None, reward, subgoals, SubgoalDistance()
        return int(benchmark.Oracle.choose(oracle, rules, *what).candidate)

    assert chosen(4, failing=-1) == 2
    assert chosen(4, failing=2) == 1
    assert chosen(4, failing=2, failure_cost=0.0) == 2
    assert chosen(2, failing=-1) == 3  # f ranks 0 and 3 best, and no others are played


def row(line_10: str, seed: int, outcome: str, steps: int) -> dict[str, Any]:
    names = "line_10", "seed", "outcome", "steps", "strict_outcome", "strict_steps"
    return dict(zip(names, (line_10, seed, outcome, steps, outcome, steps), strict=True))


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_table_tells_by_how_much_f_is_behind(benchmark: Any) -> None:
    """Of 20 scenes f fails in 4, and takes 12 pushes where the simulator takes 8."""
    rows = [row("f", seed, "timeout" if seed < 4 else "success", 12) for seed in range(20)]
    rows += [row("simulator", seed, "success", 8) for seed in range(20)]
    rows.append(row("f", 20, "success", 100))  # not played by the simulator yet
    (line,) = benchmark.table(rows, "crossing | 3 | 0 to 20", "strict")
    f, simulator, alone, pushes, ratio = cells(line)[4:]
    assert len(cells(line)) == len(cells(benchmark.HEAD[0]))
    assert f.startswith("16 of 20: 80.0 %") and simulator.startswith("20 of 20: 100.0 %")
    assert alone == "0, 4 (p = 0.12)" and pushes == "12.0 (median 12) and 8.0 (median 8)"
    assert ratio == "1.50 (1.50 to 1.50)"
    exchanged = [{**one, "line_10": {"f": "simulator", "simulator": "f"}[one["line_10"]]} for one in rows]
    (line,) = benchmark.table(exchanged, "crossing | 3 | 0 to 20", "strict")
    assert cells(line)[6] == "4, 0 (p = 0.12)" and cells(line)[8] == "0.67 (0.67 to 0.67)"
    published, strict = benchmark.table(rows, "crossing | 3 | 0 to 20", "published")  # episodes that tell both
    assert cells(published)[4:] == cells(strict)[4:]
    (line,) = benchmark.table([{**one, "outcome": "timeout"} for one in rows], "crossing | 3 | 0 to 20", "strict")
    assert cells(line)[7:] == ["-", "-"]


def test_the_interval_of_a_ratio_covers_the_truth_and_not_more(benchmark: Any) -> None:
    generator = np.random.default_rng(1)
    one, other = generator.normal(12.0, 3.0, 400), generator.normal(10.0, 3.0, 400)
    ratio, low, high = benchmark.ratio(one, other)
    assert low < 1.2 < high and low < ratio < high and high - low < 0.15


@pytest.mark.soak
def test_the_papers_planner_is_judged_by_both_criteria() -> None:
    small = ("planner.samples=8", "planner.horizon=3", "maximum_steps=4")
    given = ("--episodes", "1", "--objects", "2", "--candidates", "2", "--seed", "5", *small)
    ended = run_script(ROOT / "benchmarks" / "oracle.py", *given, folder=ROOT)
    assert ended.status == 0, ended.errors
    rows = [cells(line) for line in ended.output.splitlines()[2:]]
    assert [row[:4] for row in rows] == [["crossing", "2", "5 to 5", name] for name in ("published", "strict")]
    assert all(re.match(r"[01] of 1: ", cell) for row in rows for cell in row[4:6])


@pytest.mark.soak
def test_a_second_run_goes_on_after_the_episodes_of_a_log(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"

    def run(episodes: int, *more: str) -> str:
        given = (*TINY, "--episodes", str(episodes), "--log", str(log), *OVERRIDES, *more)
        ended = run_script(ROOT / "benchmarks" / "oracle.py", *given, folder=ROOT)
        assert ended.status == 0, ended.errors
        return ended.output

    run(1)
    with log.open("a") as file:
        file.write('{"line_10": "f", "se')  # cut off
        file.write("\n")
    printed = run(2)
    assert re.search(r"^\| crossing \| 2 \| 3 to 4 \| strict \| \d of 2: ", printed, re.MULTILINE)
    first = log.read_text().splitlines()
    assert len(first) == 2 + 1 + 2 and [json.loads(line)["seed"] for line in first[:2]] == [3, 3]
    assert run(2) == printed and log.read_text().splitlines() == first  # nothing is left to play
    run(1, "planner.nearest_objects=1")  # another question: its episodes are its own
    assert len(log.read_text().splitlines()) == 7


def test_the_page_has_the_rows_of_the_stored_episodes(benchmark: Any) -> None:
    folder = ROOT / "docs" / "measurements"
    stored = [json.loads(line) for line in (folder / "oracle.jsonl").read_text().splitlines()]
    page = (folder / "success.md").read_text()
    told = page.partition("### The simulator in the place of f")[2].partition("\n## ")[0]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in stored:
        _, task, objects, *_ = (option.partition("=")[2] for option in row["options"])
        groups.setdefault((task, objects), []).append(row)
    for (task, objects), rows in groups.items():
        seeds = {row["seed"] for row in rows}
        (line,) = benchmark.table(rows, f"{task} | {objects} | {min(seeds)} to {max(seeds)}", "strict")
        assert line in told and len(rows) == 2 * len(seeds) == 2 * (max(seeds) - min(seeds) + 1)
    assert told.count("| strict |") == len(groups)
