from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from matplotlib import colors
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.evaluation.rollout import Episode, PlanRecord, Transition
from cavin_pyro.models.state import State
from cavin_pyro.planning import Plan, RandomPlanner
from cavin_pyro.planning.protocol import Evidence
from cavin_pyro.visualization import drawing
from cavin_pyro.visualization import training as figures
from cavin_pyro.visualization.drawing import PREDICTED, SUBGOALS, candidate_subgoals, draw_episode, object_paths
from cavin_pyro.visualization.rendering import write_steps
from cavin_pyro.visualization.training import draw_training

OBJECTS, ROOM, K, T, N = 3, 5, 4, 3, 40  # the plan knows of 3 objects, the observation has room for 5
TARGET = (0.50, 0.10)  # metres


@pytest.fixture(scope="module", params=["clearing", "crossing"])
def world(request: pytest.FixtureRequest) -> Iterator[PushingEnv]:
    env = PushingEnv(task=request.param, objects=OBJECTS)
    env.reset(seed=0)
    yield env
    env.close()


def seen_centers() -> NDArray[np.float32]:
    centers = np.zeros((ROOM, 3), dtype=np.float32)
    centers[:OBJECTS] = [[*TARGET, 0.03], [0.70, -0.30, 0.03], [0.40, 0.40, 0.03]]
    return centers


def state() -> State:
    centers = torch.from_numpy(seen_centers()[None, :OBJECTS])
    return State(centers, torch.ones(1, OBJECTS, 64), torch.ones(1, OBJECTS, dtype=torch.bool))


def random_plan() -> Plan:
    return RandomPlanner(T, action_dimension=4).plan(state(), generators=[torch.Generator().manual_seed(0)])


def made_up_plan(segments: int = 2) -> Plan:
    """The target goes 5 cm along x per segment, the first obstacle goes 5 mm, the other one stays."""
    start = state().centers
    along = torch.zeros(K, OBJECTS, 3)
    along[:, 0, 0] = 0.05 * torch.arange(1, K + 1)
    along[:, 1, 1] = 0.005
    subgoals = start + along
    generator = torch.Generator().manual_seed(1)
    return random_plan()._replace(
        effect_codes=torch.zeros(1, K, 16),
        motion_codes=torch.zeros(1, K, 16),
        subgoals=State(subgoals[None], torch.ones(1, K, OBJECTS, 64), torch.ones(1, K, OBJECTS, dtype=torch.bool)),
        segments=torch.tensor([segments]),
        predicted_centers=(start + along.repeat_interleave(T, 0))[None],
        expected_return=torch.tensor([90.0]),
        candidate_centers=start[:, None, None] + 0.1 * torch.randn(1, N, K, OBJECTS, 3, generator=generator),
        candidate_returns=torch.linspace(-100, 90, N)[None],
    )


def record(plan: Plan, *, step: int = 0, photograph: bool = True) -> PlanRecord:
    picture = np.full((400, 800, 3), 200, dtype=np.uint8) if photograph else None
    return PlanRecord(step, seen_centers(), np.arange(ROOM) < OBJECTS, plan, 20.0, picture)


def episode(*plans: Plan) -> Episode:
    return Episode(7, "success", [record(plan, step=T * number) for number, plan in enumerate(plans)])


def pixels_like(image: NDArray[np.uint8], color: str) -> int:
    distance = np.abs(image[..., :3].astype(int) - 255 * np.array(colors.to_rgb(color)))
    return int((distance.max(axis=-1) < 12).sum())


def test_a_picture_shows_subgoals_and_predictions(world: PushingEnv, tmp_path: Path) -> None:
    draw_episode(tmp_path / "plan.png", episode(made_up_plan(), made_up_plan()), world)
    image = imageio.imread(tmp_path / "plan.png")
    assert image.shape[1] == pytest.approx(120 * 2 * drawing.PANEL_WIDTH, abs=1)
    assert (image[0, 0, :3] == 255).all()
    assert pixels_like(image, SUBGOALS["color"]) > 100
    assert pixels_like(image, PREDICTED["color"]) > 10


def test_the_legend_names_what_is_drawn_and_nothing_else(world: PushingEnv) -> None:
    full = [entry.get_label() for entry in drawing.legend(world, [record(made_up_plan())])]
    bare = [entry.get_label() for entry in drawing.legend(world, [record(random_plan())])]
    target = ["target"] * (world.name == "crossing")
    assert full == [*target, "candidates", "subgoals", "predicted", "reached", "push"]
    assert bare == [*target, "reached", "push"]


def test_a_title_tells_the_step_and_what_f_moves_farthest(world: PushingEnv) -> None:
    assert drawing.title(world, record(random_plan(), step=2), 6) == "push 3 of 6"
    assert f"push 1 of 6: the {world.names[0]} " in drawing.title(world, record(made_up_plan()), 6)


def push(step: int, *, along_x: float = 0.0) -> Transition:
    """After which the target is seen `along_x` metres from where it was, and nothing else has moved."""
    centers = seen_centers()
    centers[0, 0] += along_x
    flags = dict.fromkeys(("success", "violation", "fall", "unsafe", "ineffective"), False)
    return Transition(step, np.zeros(4, np.float32), -1.0, **flags, centers=centers, subgoal_distance=0.0)


@pytest.mark.parametrize("outcome", ["success", "timeout"])
def test_the_last_panel_shows_the_end_and_says_how_it_went(
    outcome: str, world: PushingEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    monkeypatch.setattr(drawing, "save_figure", lambda path, figure: drawn.append(figure))
    ended = Episode(7, outcome, [record(made_up_plan())], [push(1, along_x=0.1)])
    ended.photograph = np.full((400, 800, 3), 50, dtype=np.uint8)
    draw_episode(tmp_path / "plan.png", ended, world)
    *_, end = [panel for panel in drawn[0].axes if panel.get_title()]
    assert outcome in end.get_title()
    assert (end.images[0].get_array() == 50).all()


def test_a_camera_opposite_the_robot_takes_the_pictures(world: PushingEnv) -> None:
    near, far, left = world.pixels(np.array([[0.8, 0.0, 0.0], [0.4, 0.0, 0.0], [0.4, 0.1, 0.0]]))
    assert near[1] > far[1] + 100 and abs(near[0] - far[0]) < 1e-2
    assert left[0] > far[0] + 40  # the table's left is on the right


@pytest.mark.parametrize("segments", [1, K])
def test_paths_leave_out_what_hardly_moves(segments: int, world: PushingEnv) -> None:
    seen = record(made_up_plan(segments))
    ((target, path),) = object_paths(world, seen, seen.plan.subgoals.centers[0].numpy()[:segments]).items()
    assert target == 0
    np.testing.assert_allclose(path[0], seen.centers[0])
    np.testing.assert_allclose(path[-1], seen.centers[0] + [0.05 * segments, 0.0, 0.0], atol=1e-6)


def test_predictions_that_are_not_finite_are_left_out(world: PushingEnv, tmp_path: Path) -> None:
    plan = made_up_plan()
    plan.predicted_centers[:] = torch.nan
    plan.subgoals.centers[:] = torch.inf
    plan.candidate_centers[:, :20] = torch.nan
    plan.candidate_returns[:, 20:30] = -torch.inf
    seen = record(plan)
    assert object_paths(world, seen, plan.predicted_centers[0].numpy()) == {}
    dots, returns = candidate_subgoals(seen, [0], count=1000)
    assert len(dots) == len(returns) == 10 * K
    assert np.isfinite(dots).all()
    draw_episode(tmp_path / "plan.png", Episode(0, "fall", [seen]), world)


@pytest.mark.parametrize("objects", [[0], [0, 1, 2]])
def test_candidates_are_of_the_objects_that_the_goal_is_about(objects: list[int]) -> None:
    seen = record(made_up_plan())
    every, returns = candidate_subgoals(seen, objects, count=10_000)
    assert every.shape == (N * K * len(objects), 3)
    assert (np.diff(returns) >= 0).all()
    few, _ = candidate_subgoals(seen, objects, count=50)
    assert few.shape == (50, 3)


def test_training_curves_are_drawn_from_numbers_and_from_strings_of_a_csv_file(tmp_path: Path) -> None:
    table: list[dict[str, str | float]] = [
        {
            "step": str(100 * number),
            "training_loss": "" if number == 3 else 1000.0 / (1 + number) - 5,
            "validation_loss": 1000.0 / (1 + number),
            "validation_kl_effect_code": "nan" if number == 4 else 0.1 * number,
            "validation_nll_actions": 50.0 - number,
            "validation_nll_next_centers": -1.0,
            "learning_rate": 1e-4,
        }
        for number in range(50)
    ]
    draw_training(tmp_path / "training.png", table)
    image = imageio.imread(tmp_path / "training.png")
    for color in figures.COLORS.values():
        assert pixels_like(image, color) > 20


def test_the_table_of_steps_has_a_row_per_push_and_tells_of_plans_at_their_first(tmp_path: Path) -> None:
    numbers = torch.tensor([-1.234]), torch.tensor([10.0]), torch.tensor([[60.0, 7.5, 30.0, 90.0]])
    evidence = Evidence(*(number.double() for number in numbers), torch.tensor([100]))
    plans = [record(made_up_plan()._replace(evidence=evidence)), record(made_up_plan(), step=2)]
    write_steps(tmp_path / "steps.csv", Episode(7, "timeout", plans, [push(number) for number in (1, 2, 3)]))
    rows = list(csv.DictReader((tmp_path / "steps.csv").read_text().splitlines()))
    assert [(row["log_z"], row["temperature"], row["effective_samples"]) for row in rows] == [
        ("-1.2340", "10", "7.5"),
        *[("", "", "")] * 2,
    ]
    assert [(row["step"], bool(row["planning_ms"])) for row in rows] == [("1", True), ("2", False), ("3", True)]
