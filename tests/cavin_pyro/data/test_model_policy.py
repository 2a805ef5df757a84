"""Pushes that a model chooses: what they are, that the seed alone determines them, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.collection import check_policy, collect
from cavin_pyro.data.dataset import read_shard, shard_path
from cavin_pyro.data.model_policy import ModelPushingPolicy, load_pusher
from cavin_pyro.envs.tabletop.objects.sampling import WHOLE_TABLE, ObjectRanges
from cavin_pyro.envs.tabletop.observation import Observation, ObservedPoints
from cavin_pyro.envs.tabletop.pushing import state_of
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.planning.rollout import predict_states
from cavin_pyro.storage.checkpoint import find_checkpoint
from cavin_pyro.storage.files import file_digest

MOTIONS = 32


@pytest.fixture(scope="module")
def pusher() -> tuple[Model, Geometry]:
    return load_pusher("cavin")


@pytest.fixture(scope="module")
def observation() -> Observation:
    scene = Scene()
    generator = np.random.default_rng(1)
    seen = scene.sample([WHOLE_TABLE] * 3, ObjectRanges(clearance=0.15), generator)
    scene.close()
    return seen


def chosen(pusher: tuple[Model, Geometry], observation: Observation, seed: int, motions: int) -> np.ndarray:
    policy = ModelPushingPolicy(np.random.default_rng(seed), *pusher, motions=motions)
    return np.stack([policy.act(observation) for _ in range(3)])


@torch.inference_mode()
def distance_to_where_the_intent_points(
    pusher: tuple[Model, Geometry], observation: Observation, seed: int, motions: int
) -> float:
    """How far f sees the intended object from its place in the subgoal, after the pushes of one segment."""
    model, geometry = pusher
    policy = ModelPushingPolicy(np.random.default_rng(seed), model, geometry, motions=motions)
    pushes = np.stack([policy.act(observation) for _ in range(3)])
    state = state_of(vars(observation), geometry).expand_plans(1)
    random = torch.Generator().manual_seed(int(np.random.default_rng(seed).integers(2**62)))
    code = model.effect_prior(state).base_dist
    effect = code.loc + code.scale * torch.randn(1, 16, generator=random)
    subgoal = model.subgoal(state, effect).centers[0, policy.intent.target, :2]
    ends, _ = predict_states(model, state.expand_plans(1), torch.from_numpy(pushes)[None, None])
    return float((ends.centers[0, 0, policy.intent.target, :2] - subgoal).norm())


def test_of_more_motions_the_best_comes_nearer_to_the_subgoal(
    pusher: tuple[Model, Geometry], observation: Observation
) -> None:
    one, many = (
        np.mean([distance_to_where_the_intent_points(pusher, observation, seed, motions) for seed in range(12)])
        for motions in (1, 256)
    )
    assert many < 0.4 * one


def test_no_segment_begins_on_an_object(pusher: tuple[Model, Geometry], observation: Observation) -> None:
    first = torch.from_numpy(np.stack([chosen(pusher, observation, seed, 64)[0] for seed in range(20)]))
    assert not ObservedPoints.of(vars(observation)).blocked(first[None], 0.015).any()


def test_the_seed_determines_the_pushes_whatever_the_number_of_threads(
    pusher: tuple[Model, Geometry], observation: Observation
) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        two = chosen(pusher, observation, 4, MOTIONS)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_array_equal(chosen(pusher, observation, 4, MOTIONS), two)
    assert not np.array_equal(chosen(pusher, observation, 5, MOTIONS), two)


def test_a_collection_by_a_model_records_its_checkpoint(small: SimpleNamespace, pushes: Path, tmp_path: Path) -> None:
    config = replace(small.pushes, policy="model", checkpoint="cavin", motions=8)
    stored = collect(config, tmp_path, transitions=1, workers=1)["configuration"]
    assert (stored["policy"], stored["motions"]) == ("model", 8)
    assert stored["checkpoint"] == file_digest(find_checkpoint("cavin"))
    one, other = (read_shard(shard_path(folder, 0))["actions"] for folder in (tmp_path, pushes))
    assert not np.array_equal(one, other)  # the heuristic's


def test_a_checkpoint_that_cannot_choose_pushes_is_refused(small: SimpleNamespace) -> None:
    with pytest.raises(UserError, match="needs a cascade, and checkpoint .* has model dynamics"):
        check_policy(replace(small.pushes, policy="model", checkpoint="mpc"))
