"""The library, the command line and a run's `config.yaml` have one default per option."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.utils import get_object
from omegaconf import OmegaConf

from cavin_pyro.config.commands import WindowConfig
from cavin_pyro.config.composition import PRESETS, compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import configured, constructor_options
from cavin_pyro.config.parts import build_model, construct
from cavin_pyro.data.collection import CollectionConfig, collecting_world
from cavin_pyro.planning import CavinPlanner

PAPER = {  # Algorithm 1 as it is printed
    "planner.motion_horizon": "full_horizon",
    "planner.additions": [],
    "planner.motion_share": 1.0,
    "planner.optimizer._target_": "cavin_pyro.planning.optimizers.Shooting",
    "pushes_per_plan": None,
    "push_decimals": None,
    "margin": 0.0,
    "matmul_precision": "float32",
}


def plain(config: Any) -> dict[str, Any]:
    found = OmegaConf.to_container(config)
    assert isinstance(found, dict)
    return {str(name): value for name, value in found.items()}


def test_a_planner_without_options_is_that_of_the_paper(small: SimpleNamespace) -> None:
    model = build_model(small.config())
    section = plain(compose("evaluate", "planner=paper").planner)
    for name in ("model_free", "default_checkpoint", "add", "drop"):
        del section[name]
    ours, theirs = CavinPlanner(model), construct(section, model=model)
    assert {**vars(ours), "optimizer": None} == {**vars(theirs), "optimizer": None}
    assert vars(ours.optimizer) == vars(theirs.optimizer)


def test_collecting_without_options_is_that_of_the_command() -> None:
    config = compose("collect")
    usual = CollectionConfig()
    assert collecting_world(config.env) == usual
    for name in ("seed", "steps", "intent_length", "perturbation_rate", "maximum_objects", "episodes_per_shard"):
        assert config[name] == getattr(usual, name)


@pytest.mark.parametrize("preset", sorted(PRESETS.rglob("*.yaml")), ids=lambda path: str(path.relative_to(PRESETS)))
def test_presets_name_classes_that_exist_and_repeat_none_of_their_defaults(preset: Path) -> None:
    def check(value: Any) -> None:
        if isinstance(value, dict):
            if value.get("_target_"):
                assert callable(get_object(value["_target_"]))
                declared = constructor_options(value["_target_"])
                for name in value.keys() & declared.keys():
                    assert value[name] != declared[name].default or value[name] is None
            for entry in value.values():
                check(entry)

    check(OmegaConf.to_container(OmegaConf.load(preset)))


def test_one_option_selects_the_papers_algorithm() -> None:
    config = compose("plan", "planner=paper")
    for name, value in PAPER.items():
        assert OmegaConf.select(config, name) == value
    overridden = compose("plan", "planner=paper", "margin=0.01", "pushes_per_plan=2")
    assert (overridden.margin, overridden.pushes_per_plan) == (0.01, 2)


def test_a_stored_section_is_checked_as_a_commands_is() -> None:
    assert configured(WindowConfig, {"maximum_step": 0.3, "of_old": 1}, "windows") == WindowConfig(maximum_step=0.3)
    for values, said in (
        ({"maximum_step": "far"}, "windows.maximum_step: Value 'far'"),
        ({"maximum_step": -1}, "windows.maximum_step in metres must be a number above 0 and at most 1e\\+30, not -1"),
    ):
        with pytest.raises(UserError, match=f"^{said}"):
            configured(WindowConfig, values, "windows")
