"""A composition leaves nothing behind for the next: presets are read once, and Hydra's store is not copied."""

from __future__ import annotations

import copy

import pytest
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig

from cavin_pyro.config.composition import check_overrides, compose
from cavin_pyro.config.errors import UserError

OVERRIDES = {
    "plan": ("planner=paper", "task=rearrange", "planner.samples=8", "planner.optimizer=cem", "env.objects=mixed"),
    "train": ("model=flat", "guide=flat", "prior=flow", "objective=iwae", "scales=learned", "model.width=8"),
}


@pytest.mark.parametrize("command", OVERRIDES)
def test_overrides_change_one_composition_only(command: str) -> None:
    before = compose(command)
    changed = compose(command, *OVERRIDES[command])
    assert changed != before
    assert compose(command) == before
    assert compose(command, *OVERRIDES[command]) == changed


@pytest.mark.parametrize("command", OVERRIDES)
def test_a_composed_configuration_may_be_changed(command: str) -> None:
    expected = check_overrides(command, [])

    def empty(config: DictConfig) -> None:
        for key in list(config):
            config._set_flag(["readonly", "struct"], [False, False])
            del config[key]

    spoilt = check_overrides(command, [])
    for section in [spoilt[key] for key in spoilt if isinstance(spoilt._get_node(key), DictConfig)]:
        if not section._is_none():
            empty(section)
    assert check_overrides(command, []) == expected


def test_a_refused_override_leaves_the_next_composition_alone() -> None:
    before = compose("plan")
    with pytest.raises(UserError):
        compose("plan", "planner.samples=none")
    assert compose("plan") == before


def test_the_store_stands_for_its_copy_and_its_schemas_are_copied() -> None:
    store = ConfigStore.instance()
    assert copy.deepcopy(store) is store
    one, other = store.load("plan.yaml"), store.load("plan.yaml")
    assert one.node == other.node and one.node is not other.node
