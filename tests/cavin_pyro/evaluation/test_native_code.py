"""`planner.compile=auto`, the default of `plan` alone, is false where native code could give other plans."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from torch import nn

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.evaluation.native_code import argument_compile, searches
from cavin_pyro.storage.run_directory import check_same_run, write_config
from models.priors.flow import FlowPrior
from planning import CavinPlanner, RandomPlanner

CPU, GPU = torch.device("cpu"), torch.device("cuda")
PLANNERS = ("cavin", "cavin_evolution", "cavin_without_effects", "paper", "sectar", "cvae_mpc", "mpc")


@pytest.mark.parametrize(
    "planner", [name if name == "cavin" else pytest.param(name, marks=pytest.mark.soak) for name in PLANNERS]
)
def test_plan_alone_loads_native_code_by_itself(planner: str) -> None:
    """Results of many episodes must not depend on what lies in one machine's cache."""
    for command, usual in (("plan", "auto"), ("evaluate", False), ("demo", False)):
        assert compose(command, f"planner={planner}").planner.compile == usual
        assert compose(command, f"planner={planner}", "planner.compile=true").planner.compile is True


def test_evaluations_have_the_folders_that_they_had() -> None:
    assert compose("evaluate").output == compose("evaluate", "planner.compile=false").output
    assert compose("evaluate").output != compose("evaluate", "planner.compile=true").output


@pytest.mark.parametrize(
    ("overrides", "device", "chosen"),
    [
        ("", CPU, "auto"),
        ("layout=1", CPU, "auto"),
        ("layout=generated generated.seed=3", CPU, "auto"),
        ("planner.compile=true", CPU, True),
        ("planner.compile=false", CPU, False),
        ("", GPU, "cuda_graphs"),
        ("planner.compile=true", GPU, "cuda_graphs"),
        ("planner.compile=false", GPU, False),
        ("layout=random", GPU, False),
        ("layout=random", CPU, False),
        ("layout=generated", CPU, False),
        ("task=rearrange", CPU, False),
        ("matmul_precision=bfloat16", CPU, False),  # it would round at other places
        ("planner.warm_start=false", CPU, False),  # direct plans sample codes then, not noise
        ("planner=paper", CPU, False),
        ("planner.warm_start=false planner.compile=true", CPU, True),
    ],
)
def test_auto_is_false_where_other_plans_could_come_of_it(
    overrides: str, device: torch.device, chosen: bool | str
) -> None:
    config = compose("plan", *overrides.split())
    assert argument_compile(config, device, nn.Module(), Path("a.safetensors")) == chosen  # type: ignore[arg-type]


def test_auto_is_false_with_flows() -> None:
    model = nn.ModuleList([FlowPrior(dimension=2, feature_dimension=4)])
    assert argument_compile(compose("plan"), CPU, model, Path("a.safetensors")) is False  # type: ignore[arg-type]


def test_planners_that_do_not_search_are_not_asked_to_compile() -> None:
    runner = make_runner(compose("plan", "planner=random", "objects=1", "output=unused"))
    runner.env.close()
    assert isinstance(runner.planner, RandomPlanner)
    assert not searches(compose("plan", "planner=random").planner) and searches(compose("plan").planner)
    assert searches(OmegaConf.create({"_target_": f"{CavinPlanner.__module__}.{CavinPlanner.__qualname__}"}))


def test_a_run_that_did_not_round_pushes_is_not_resumed_with_rounding(tmp_path: Path) -> None:
    config = compose("evaluate", f"output={tmp_path}")
    before = config.copy()
    del before["push_decimals"]  # of versions that knew no such option
    write_config(tmp_path, before)
    (tmp_path / "episodes.jsonl").write_text("{}\n")
    with pytest.raises(UserError, match=r"holds a run with push_decimals=None, not 3: resume with the same options"):
        check_same_run(tmp_path, config, ignore=("output",))
    check_same_run(tmp_path, compose("evaluate", f"output={tmp_path}", "push_decimals=null"), ignore=("output",))


def test_a_run_of_before_the_first_push_was_tracked_compared_ends(tmp_path: Path) -> None:
    for planner, fits in (("paper", True), ("cavin", False)):
        folder = tmp_path / planner
        folder.mkdir()
        config = compose("evaluate", f"planner={planner}", f"output={folder}")
        before = config.copy()
        del before.planner["tracking_at"]  # of versions that knew no such option
        OmegaConf.update(before, "planner.running_cost_share", 0.0, force_add=True)
        write_config(folder, before)
        (folder / "episodes.jsonl").write_text("{}\n")
        if fits:
            check_same_run(folder, config, ignore=("output",))
            continue
        with pytest.raises(UserError, match=r"holds a run with planner.tracking_at=end, not auto: resume with"):
            check_same_run(folder, config, ignore=("output",))
