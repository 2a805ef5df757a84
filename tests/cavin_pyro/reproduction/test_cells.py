from __future__ import annotations

import re
from dataclasses import astuple, replace
from pathlib import Path

import pytest

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.reproduction.cells import PLANNERS, cells
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.pipeline import (
    SHARED,
    check_inputs,
    chosen_cells,
    chosen_size,
    chosen_trainings,
    preparation,
    training,
)
from cavin_pyro.reproduction.sizes import SIZES

PAPER_METHODS = [name for name, method in METHODS.items() if method.in_paper]


def test_the_paper_figure_has_seventy_two_cells_for_each_kind_of_planner_with_the_papers_episodes() -> None:
    total: dict[tuple, int] = {}
    for cell in cells(SIZES["paper"], PAPER_METHODS):
        place = astuple(cell)[:5]
        total[place] = total.get(place, 0) + cell.episodes
    assert len(total) == 2 * 72
    assert len([place for place in total if place[1] == "paper" and place[-1] == 3]) == 4 * 3 * 2
    assert all(count >= (1000 if place[-1] == 3 else 300) for place, count in total.items())


def test_methods_meet_the_same_scenes_and_training_seeds_and_sizes_other_ones() -> None:
    known: dict[str, set[int]] = {}
    for name, size in SIZES.items():
        scenes: dict[tuple, set[int]] = {}
        for cell in cells(size, list(METHODS)):
            seeds = set(range(cell.seed, cell.seed + cell.episodes))
            assert scenes.setdefault((cell.objects, cell.training_seed), seeds) == seeds
            known.setdefault(f"{name}-{cell.training_seed}", set()).update(seeds)
    assert sum(map(len, known.values())) == len(set.union(*known.values()))


def test_more_episodes_contain_those_of_a_shorter_run() -> None:
    size = SIZES["medium"]
    short, long = (
        {(cell.name, seed) for cell in cells(some, ["mpc"]) for seed in range(cell.seed, cell.seed + cell.episodes)}
        for some in (size, replace(size, episodes=300, bottom_episodes=90))
    )
    assert short < long


@pytest.mark.parametrize("method", METHODS)
def test_every_command_line_of_a_stage_is_accepted(method: str) -> None:
    size, home = SIZES["smoke"], Path("home")
    for stage in (*preparation(size, home, [method], workers=1, device="cpu"), training(size, home, method, 0)):
        config = compose(stage.command, *stage.options, f"output={stage.folder}")
    assert config.model._target_.startswith("cavin_pyro.models.") and config.seed == 0
    for planner in METHODS[method].planners.values():
        composed = compose("evaluate", *SHARED, *planner, *size.planning, "output=-")
        assert composed.env.segmentation == "clusters" and composed.criterion == "published"


def test_codes_of_the_papers_size_have_its_prior_and_dimensions_and_a_choice_replaces_it() -> None:
    for scale, given, prior, dimension in (
        ("paper", (), "Standard", 32),
        ("paper", ("priors=conditional",), "Conditional", 16),
        ("medium", (), "Conditional", 16),
        ("medium", ("priors=standard",), "Standard", 32),
    ):
        size = chosen_size(compose("reproduce", f"scale={scale}", *given, "output=-"))
        config = compose("train", *training(size, Path("home"), "cvae_mpc", 0).options, "output=-")
        assert config.prior._target_.endswith(f"{prior}Prior") and config.model.motion_dimension == dimension
        contact = compose("train", *training(size, Path("home"), "contact", 0).options, "output=-")
        assert contact.prior._target_.endswith("ObjectMixturePrior")


def test_the_papers_planners_have_no_additions_and_ours_have_some() -> None:
    for method in METHODS.values():
        assert tuple(method.planners) == PLANNERS
        paper, ours = (compose("evaluate", *method.planners[name], "output=-") for name in PLANNERS)
        assert paper.planner._target_ == ours.planner._target_ and paper.planner != ours.planner
        assert paper.pushes_per_plan is None and paper.margin == 0 and paper.matmul_precision == "float32"


def test_networks_train_on_the_chosen_device_and_a_pointnet_only_for_methods_that_read_it() -> None:
    size, home = SIZES["smoke"], Path("home")
    for methods, wanted in ((["contact"], ["collect"]), (["cavin", "contact"], ["collect", "pretrain"])):
        first = preparation(size, home, methods, workers=1, device="cuda")
        assert [stage.command for stage in first] == wanted
        stages = [*first, *(training(size, home, method, 0, device="cuda") for method in methods)]
        assert all(("device=cuda" in stage.options) == (stage.command != "collect") for stage in stages)
        assert any("pointnet=" in option for stage in stages for option in stage.options) == ("cavin" in methods)


def test_a_part_of_the_figure_can_be_chosen() -> None:
    some = ("tasks=[crossing,clearing]", "objects=[5,1]", "methods=[cavin]", "planners=[paper]", "first_scene=7000")
    config = compose("reproduce", "scale=medium", *some, "output=-")
    found = chosen_cells(chosen_size(config), config)
    sparse = {(task, "sparse", objects) for task in ("clearing", "crossing") for objects in (1, 5)}
    dense = {("clearing", "dense", 3), ("crossing", "dense", 3)}
    assert {(cell.task, cell.reward, cell.objects) for cell in found} == sparse | dense
    assert {cell.seed for cell in found} == {7000, 8000, 9000}


def test_shards_share_the_trainings_without_overlap() -> None:
    size, parts = SIZES["paper"], []
    for shard in ("1/1", *(f"{number}/5" for number in range(1, 6))):
        config = compose("reproduce", "scale=paper", f"shard={shard}", "output=-")
        parts.append([*chosen_trainings(size, config)])
        assert {(cell.method, cell.training_seed) for cell in chosen_cells(size, config)} == set(parts[-1])
    assert len(parts[0]) == 4 * 5 and sorted(parts[0]) == sorted(pair for part in parts[1:] for pair in part)


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("shard=6/6", "no cell of scale=smoke has these methods, planners, tasks, objects and rewards"),
        ("episodes=1001", "episodes must be at most 1000 with scale=smoke, not 1001"),
        ("objects=[6]", "unknown objects 6: choose from 1, 2, 3, 4, 5"),
        ("models=nowhere", "models=nowhere holds no cavin-0.safetensors"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_is_written(option: str, said: str) -> None:
    with pytest.raises(UserError, match=re.escape(said)):
        check_inputs(compose("reproduce", "scale=smoke", option))
