from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from matplotlib import colors
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.layouts import load_task
from cavin_pyro.envs.tabletop.scene import COLORS
from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.evaluation.rollout import Episode, PlanRecord, Transition
from cavin_pyro.models.state import State
from cavin_pyro.planning import Plan, RandomPlanner
from cavin_pyro.planning.protocol import Evidence
from cavin_pyro.visualization import plan as figures_plan
from cavin_pyro.visualization import training as figures
from cavin_pyro.visualization.overlay import (
    PREDICTION_COLOR,
    SUBGOAL_COLOR,
    candidate_subgoals,
    predicted_paths,
    subgoal_chains,
)
from cavin_pyro.visualization.plan import FAILURE_COLOR, SUCCESS_COLOR, Map, draw_plan
from cavin_pyro.visualization.rendering import write_steps
from cavin_pyro.visualization.training import draw_training

CAMERA = Camera().resized(512, 424)
OBJECTS, ROOM, K, T, N = 3, 5, 4, 3, 40  # the plan knows of 3 objects, the observation has room for 5
TARGET = (0.50, 0.10)  # metres


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
    picture = np.full((424, 512, 3), 200, dtype=np.uint8) if photograph else None
    return PlanRecord(step, seen_centers(), np.arange(ROOM) < OBJECTS, plan, 20.0, picture)


def episode(*plans: Plan) -> Episode:
    return Episode(7, "success", [record(plan, step=T * number) for number, plan in enumerate(plans)])


def pixels_like(image: NDArray[np.uint8], color: str) -> int:
    distance = np.abs(image[..., :3].astype(int) - 255 * np.array(colors.to_rgb(color)))
    return int((distance.max(axis=-1) < 12).sum())


@pytest.mark.parametrize("task", ["clearing", "crossing"])
def test_a_plans_figure_shows_subgoals_and_predictions(task: str, tmp_path: Path) -> None:
    layout = load_task(task, 0)
    draw_plan(tmp_path / "plan.png", episode(made_up_plan(), made_up_plan()), layout, CAMERA)
    image = imageio.imread(tmp_path / "plan.png")
    assert image.shape[:2] == pytest.approx((120 * (0.9 + 2.95), 120 * 3 * 4.4), abs=1)
    assert (image[0, 0, :3] == 255).all()
    assert pixels_like(image, SUBGOAL_COLOR) > 100
    assert pixels_like(image, PREDICTION_COLOR) > 10


def test_the_legend_names_what_is_drawn_and_nothing_else() -> None:
    layout = load_task("crossing", 0)
    full = [entry.get_label() for entry in figures_plan.legend(layout, [record(made_up_plan())], candidates=True)]
    bare = [entry.get_label() for entry in figures_plan.legend(layout, [record(random_plan())], candidates=False)]
    assert full[:5] == ["bridge", "goal", "target", "observed", "candidates"]
    assert full[5:] == ["target's subgoals", "obstacles' subgoals", "predicted", "reached", "push"]
    assert bare == ["bridge", "goal", "target", "observed", "reached", "push"]


def push(step: int, *, along_x: float = 0.0) -> Transition:
    """After which the target is seen `along_x` metres from where it was, and nothing else has moved."""
    centers = seen_centers()
    centers[0, 0] += along_x
    flags = dict.fromkeys(("success", "violation", "fall", "unsafe", "ineffective"), False)
    return Transition(step, np.zeros(4, np.float32), -1.0, **flags, centers=centers, subgoal_distance=0.0)


@pytest.mark.parametrize(
    ("outcome", "title", "color"),
    [
        ("success", "end, after 1 push: success", SUCCESS_COLOR),
        ("timeout", "end, after 1 push: failure (timeout)", FAILURE_COLOR),
    ],
)
def test_the_last_panel_shows_the_end_and_says_how_it_went(
    outcome: str, title: str, color: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = []
    monkeypatch.setattr(figures_plan, "save_figure", lambda path, figure: drawn.append(figure))
    ended = Episode(7, outcome, [record(made_up_plan())], [push(1, along_x=0.1)])
    ended.photograph = np.full((424, 512, 3), 50, dtype=np.uint8)
    draw_plan(tmp_path / "plan.png", ended, load_task("insertion", 0), CAMERA)
    *_, end = [panel for panel in drawn[0].axes if panel.get_title()]
    assert (end.get_title(), end.title.get_color()) == (title, color)
    assert (end.images[0].get_array() == 50).all()


def test_a_map_is_true_to_scale_and_turned_as_the_cameras_image(tmp_path: Path) -> None:
    origin, ahead, left = Map().project(np.array([[0.5, 0.1, 0.0], [0.6, 0.1, 0.3], [0.5, 0.2, 0.0]]))
    np.testing.assert_allclose(ahead - origin, [0.0, -36.55], atol=1e-9)  # up, whatever its height
    np.testing.assert_allclose(left - origin, [-36.55, 0.0], atol=1e-9)
    seen = record(made_up_plan(), photograph=False)
    draw_plan(tmp_path / "plan.png", Episode(0, "fall", [seen]), load_task("crossing", 0), None)
    clouds = seen_centers()[:, None] + 0.02 * np.random.default_rng(0).standard_normal((ROOM, 256, 3))
    seen = replace(seen, observation={"clouds": clouds.astype(np.float32)})
    draw_plan(tmp_path / "clouds.png", Episode(0, "fall", [seen]), load_task("crossing", 0), None)
    bare, full = (imageio.imread(tmp_path / name) for name in ("plan.png", "clouds.png"))
    assert pixels_like(full, colors.to_hex(COLORS[1])) > pixels_like(bare, colors.to_hex(COLORS[1])) + 20


@pytest.mark.parametrize("segments", [1, K])
def test_chains_end_where_the_plan_does_and_leave_out_what_hardly_moves(segments: int) -> None:
    seen = record(made_up_plan(segments))
    ((target, chain),) = subgoal_chains(seen, CAMERA).items()
    (path,) = predicted_paths(seen, CAMERA).values()
    assert target == 0
    assert len(chain) == 1 + segments
    assert len(path) == 1 + segments * T
    np.testing.assert_allclose(chain[0], CAMERA.project(seen.centers[0]))
    np.testing.assert_allclose(chain[-1], CAMERA.project(seen.centers[0] + [0.05 * segments, 0.0, 0.0]), atol=1e-3)
    np.testing.assert_allclose(path[-1], chain[-1], atol=1e-3)


def test_predictions_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    plan = made_up_plan()
    plan.predicted_centers[:] = torch.nan
    plan.subgoals.centers[:] = torch.inf
    plan.candidate_centers[:, :20] = torch.nan
    plan.candidate_returns[:, 20:30] = -torch.inf
    seen = record(plan)
    assert predicted_paths(seen, CAMERA) == subgoal_chains(seen, CAMERA) == {}
    dots, returns = candidate_subgoals(seen, load_task("insertion", 0), CAMERA, count=1000)
    assert len(dots) == len(returns) == 10 * K
    assert np.isfinite(dots).all()
    draw_plan(tmp_path / "plan.png", Episode(0, "fall", [seen]), load_task("insertion", 0), CAMERA)


@pytest.mark.parametrize(("task", "objects"), [("clearing", OBJECTS), ("insertion", 1), ("crossing", 1)])
def test_candidates_are_of_the_target_or_in_clearing_of_all_objects(task: str, objects: int) -> None:
    seen, layout = record(made_up_plan()), load_task(task, 0)
    every, returns = candidate_subgoals(seen, layout, CAMERA, count=10_000)
    assert every.shape == (N * K * objects, 2)
    assert (np.diff(returns) >= 0).all()
    few, _ = candidate_subgoals(seen, layout, CAMERA, count=50)
    assert few.shape == (50, 2)


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
