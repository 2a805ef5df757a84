"""The training loop on windows made up here; `test_resuming.py` kills the command itself."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyro
import pytest
import torch
from pyro.infer import Trace_ELBO
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional

from cavin_pyro.config.commands import TrainerConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.windows import WindowTable
from cavin_pyro.models.state import State
from cavin_pyro.storage.checkpoint import load, save
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.training import trainer as trainer_module
from cavin_pyro.training.elbo import elbo_terms
from cavin_pyro.training.objectives import Objective
from cavin_pyro.training.resume import load_optimizer, optimizer_tensors
from cavin_pyro.training.run import _keep_best
from cavin_pyro.training.trainer import Row, Trainer

SHORT = TrainerConfig(steps=8, batch_size=4, validate_every=2, validation_windows=10, learning_rate=1e-2)
Hook = Callable[[Trainer, int], None]


@pytest.fixture(autouse=True)
def without_validation() -> Iterator[None]:
    """As the command does, so that a NaN reaches the loss."""
    with pyro.settings.context(validate_distributions_pyro=False, validate_distributions_torch=False):
        yield


def windows(episodes: int = 10, positions: int = 6) -> WindowTable:
    """Everything counts; the last three episodes are for validation."""
    generator = torch.Generator().manual_seed(0)
    count = episodes * positions
    start = torch.rand(count, 5, 3, generator=generator)
    features = functional.normalize(torch.randn(count, 5, 64, generator=generator), dim=-1)
    states = State(start, features, torch.ones(count, 5, dtype=torch.bool))
    actions = 2 * torch.rand(count, 4, generator=generator) - 1
    starts = [episode * positions + step for episode in range(episodes) for step in range(positions - 3)]
    index = torch.arange(len(starts))
    windows = {"starts": torch.tensor(starts), "sequence_mask": index >= 0, "held_out": index >= len(starts) - 9}
    return WindowTable(states, actions, torch.ones(count, dtype=torch.bool), **windows, episodes=index)


def trainer(
    small: SimpleNamespace,
    folder: Path,
    config: TrainerConfig = SHORT,
    hook: Hook | None = None,
    seed: int = 0,
    objective: Objective | None = None,
) -> Trainer:
    """A trainer of a small cascade; the hook is called after each checkpoint."""
    parts = small.parts()

    def keep(step: int, row: Row) -> None:
        save(folder / "checkpoint.safetensors", **parts, config={}, provenance={"step": step})
        if hook is not None:
            hook(run, step)

    folder.mkdir(exist_ok=True)
    programs = (parts["model"], parts["guide"], objective or Objective(Trace_ELBO()))
    run = Trainer(*programs, windows(), folder, keep, config, seed=seed)
    return run


def weights(run: Trainer) -> Tensor:
    both = nn.ModuleList([run.model, run.guide])
    return nn.utils.parameters_to_vector(both.parameters()).detach().clone()


def without_speed(rows: list[Row]) -> list[Row]:
    return [{name: value for name, value in row.items() if name != "windows_per_second"} for row in rows]


def test_the_optimizer_follows_the_schedule(small: SimpleNamespace, tmp_path: Path) -> None:
    constant = TrainerConfig(steps=100, learning_rate=1e-3)
    assert {constant.rate(step) for step in (0, 50, 99)} == {1e-3}
    config = TrainerConfig(**{**vars(SHORT), "schedule": "cosine"})
    assert [config.rate(step) for step in (0, 4, 8)] == pytest.approx([1e-2, 0.505e-2, 1e-4])
    run = trainer(small, tmp_path / "run", config)
    run.run()
    (group,) = run._optimizer.param_groups
    assert group["lr"] == config.rate(7)
    assert [row["learning_rate"] for row in run.rows] == [config.rate(step) for step in (2, 4, 6, 8)]


def test_training_lowers_the_loss_and_reports_every_term(small: SimpleNamespace, tmp_path: Path) -> None:
    run = trainer(small, tmp_path / "run", TrainerConfig(**{**vars(SHORT), "steps": 40}))
    run.run()
    losses = [row["validation_loss"] for row in run.rows]
    assert losses[-1] < losses[0] - 10
    assert run.best == min(losses)
    with open(tmp_path / "run" / "metrics.csv", newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    sites = ["subgoal_centers", "subgoal_features", "actions", "next_centers", "next_features"]
    terms = [f"validation_nll_{site}" for site in sites] + [
        f"validation_kl_{code}_code" for code in ("effect", "motion")
    ]
    assert {"step", "training_loss", "validation_loss", "learning_rate", "windows_per_second", *terms} == set(rows[0])
    assert rows == run.rows
    assert load(tmp_path / "run" / "checkpoint.safetensors").provenance == {"step": run.best_step}
    assert not pyro.get_param_store().keys()


def test_validation_does_not_disturb_training(small: SimpleNamespace, tmp_path: Path) -> None:
    often = trainer(small, tmp_path / "often", TrainerConfig(**{**vars(SHORT), "validate_every": 1}))
    often.run()
    seldom = trainer(small, tmp_path / "seldom", TrainerConfig(**{**vars(SHORT), "validate_every": 8}))
    seldom.run()
    assert torch.equal(weights(often), weights(seldom))
    assert often.rows[-1]["validation_loss"] == seldom.rows[-1]["validation_loss"]
    mean = sum(row["training_loss"] for row in often.rows) / 8
    assert seldom.rows[-1]["training_loss"] == pytest.approx(mean)


def test_metrics_are_means_over_what_counts_in_all_parts_of_the_validation(
    small: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parts in which different numbers of windows and transitions count, one of them none."""
    monkeypatch.setattr(trainer_module, "VALIDATION_BATCH", 4)
    run = trainer(small, tmp_path / "run")
    order = torch.randperm(9, generator=torch.Generator().manual_seed(0))
    parts = run.windows.validation[order].split(4)
    run.windows.sequence_mask[parts[1]] = False
    run.windows._transition_mask[run.windows.starts[parts[0]]] = False
    sums: dict[str, float] = {}
    torch.manual_seed(0)
    for part in parts:
        for name, value in elbo_terms(run.model, run.guide, run.windows.batch(part)).items():
            sums[name] = sums.get(name, 0.0) + value.item()
    batches = [run.windows.batch(part) for part in parts]
    windows_that_count = sum(int(batch.sequence_mask.sum()) for batch in batches)
    transitions_that_count = sum(int(batch.transition_mask.sum()) for batch in batches)
    assert (windows_that_count, len(parts)) == (5, 3) and transitions_that_count < 27
    terms, loss = run._validation_terms()
    assert terms.keys() == sums.keys()
    for name, value in terms.items():
        count = transitions_that_count if name.startswith("nll_next") else windows_that_count
        assert value == pytest.approx(sums[name] / count, rel=1e-6), name
    assert loss == pytest.approx(sum(sums.values()) / 9, rel=1e-6)


def test_the_validation_loss_has_the_terms_of_the_model(small: SimpleNamespace, tmp_path: Path) -> None:
    losses = {}
    for weight in (0.0, 2.0):
        run = trainer(small, tmp_path / str(weight), objective=Objective(Trace_ELBO(), rollout_weight=weight))
        terms, losses[weight] = run._validation_terms()
        assert ("rollout" in terms) == (weight > 0)
    assert losses[2.0] == pytest.approx(losses[0.0] + terms["rollout"])


def test_gradients_are_clipped(small: SimpleNamespace, tmp_path: Path) -> None:
    """Adam forgets the size of a gradient, except where it is small beside its epsilon of 1e-8."""
    free = trainer(small, tmp_path / "free")
    before = weights(free)
    free.run()
    clipped = trainer(small, tmp_path / "clipped", TrainerConfig(**{**vars(SHORT), "clip_norm": 1e-20}))
    clipped.run()
    assert (weights(free) - before).abs().max() > 1e-3
    assert (weights(clipped) - before).abs().max() < 1e-9


def test_training_stops_when_patience_is_lost(small: SimpleNamespace, tmp_path: Path) -> None:
    config = TrainerConfig(**{**vars(SHORT), "steps": 100, "learning_rate": 0.0, "patience": 3})
    run = trainer(small, tmp_path / "run", config)
    run.run()
    assert run.best_step == 2  # never better again
    assert run.step == 2 * (1 + 3)


@pytest.mark.parametrize("broken_after", [2, 4, 6])
def test_an_interrupted_run_resumes_as_if_it_had_not_been_interrupted(
    broken_after: int, small: SimpleNamespace, tmp_path: Path
) -> None:
    def stop(run: Trainer, step: int) -> None:
        if step == broken_after:
            raise KeyboardInterrupt

    whole = trainer(small, tmp_path / "whole")
    whole.run()
    assert [row["step"] for row in whole.rows] == [2, 4, 6, 8]
    with pytest.raises(KeyboardInterrupt):
        trainer(small, tmp_path / "broken", hook=stop).run()
    assert not (tmp_path / "broken" / "metrics.csv").exists() or broken_after > 2
    resumed = trainer(small, tmp_path / "broken")
    resumed.run()
    assert torch.equal(weights(resumed), weights(whole))
    other = trainer(small, tmp_path / "other", seed=1)
    other.run()
    assert not torch.equal(weights(other), weights(whole))
    assert without_speed(resumed.rows) == without_speed(whole.rows)
    assert (resumed.best, resumed.best_step, resumed.stale) == (whole.best, whole.best_step, whole.stale)


def poison(choose: Callable[[Trainer], Tensor]) -> Hook:
    """Puts a NaN into a parameter after the checkpoint of step 4."""

    def hook(run: Trainer, step: int) -> None:
        if step == 4:
            with torch.no_grad():
                choose(run).view(-1)[0] = math.nan

    return hook


@pytest.mark.parametrize(
    ("choose", "term"),
    [
        (lambda run: run.model.action_generator.starts[-2].bias, "nll_actions"),
        (lambda run: run.model.meta_dynamics.change.head.bias, "nll_subgoal_centers"),
        (lambda run: run.model.dynamics.change.head.bias, "nll_next_centers"),
        (lambda run: run.guide.effect_inference.code.head.bias, "kl_effect_code"),
        (lambda run: run.guide.motion_inference.code.head.bias, "kl_motion_code"),
    ],
)
def test_a_nan_stops_training_with_its_term_and_the_last_good_checkpoint_stays(
    choose: Callable[[Trainer], Tensor], term: str, small: SimpleNamespace, tmp_path: Path
) -> None:
    run = trainer(small, tmp_path / "run", hook=poison(choose))
    with pytest.raises(UserError) as caught:
        run.run()
    assert f"the term {term} is not finite; the best checkpoint, of step 4, stays" in str(caught.value)
    assert "\n" not in str(caught.value)
    checkpoint = load(tmp_path / "run" / "checkpoint.safetensors")
    assert checkpoint.provenance == {"step": 4}
    assert all(bool(value.isfinite().all()) for value in checkpoint.tensors.values())


def test_a_nan_that_validation_finds_first_is_neither_recorded_nor_resumed_from(
    small: SimpleNamespace, tmp_path: Path
) -> None:
    run = trainer(small, tmp_path / "run")
    run.windows._states.centers[run.windows.starts[run.windows.validation]] = math.nan  # none for training
    with pytest.raises(UserError, match="is not finite; there is no checkpoint yet: look at the data"):
        run.run()
    assert not list((tmp_path / "run").glob("*.safetensors"))
    assert not (tmp_path / "run" / "metrics.csv").exists()


def test_a_gradient_that_is_not_finite_is_named(small: SimpleNamespace, tmp_path: Path) -> None:
    run = trainer(small, tmp_path / "run")
    head = run.model.dynamics.change.head.weight
    head.register_hook(lambda gradient: gradient * math.inf)
    before = weights(run)
    with pytest.raises(UserError, match="the term gradient is not finite; there is no checkpoint yet"):
        run.run()
    assert torch.equal(weights(run), before)


PARAMETERS = 3
Tensors = dict[str, Tensor]


def stepped(*, without_gradient: int | None = None) -> tuple[torch.optim.Adam, Tensors]:
    """An optimizer of three matrices after a step, and its moments."""
    torch.manual_seed(0)
    parameters = [nn.Parameter(torch.randn(6, 6)) for _ in range(PARAMETERS)]
    optimizer = torch.optim.Adam(parameters, lr=0.1)
    for number, parameter in enumerate(parameters):
        parameter.grad = None if number == without_gradient else torch.ones_like(parameter)
    optimizer.step()
    return optimizer, optimizer_tensors(optimizer)


def test_moments_come_back_and_a_weight_without_gradient_has_none() -> None:
    optimizer, tensors = stepped(without_gradient=1)
    assert not [entry for entry in tensors if entry.startswith("adam.1.")]
    again, _ = stepped()
    load_optimizer(again, tensors)
    assert optimizer_tensors(again).keys() == tensors.keys()
    with pytest.raises(ValueError, match=r"^adam\.3 belongs to no weight$"):
        load_optimizer(optimizer, {**tensors, "adam.3.exp_avg": torch.zeros(6, 6)})


@pytest.fixture(scope="module")
def finished(small: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "run"
    trainer(small, folder).run()
    return folder


@pytest.fixture
def own(finished: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "resume.safetensors").write_bytes((finished / "resume.safetensors").read_bytes())
    return folder


def without(name: str) -> Callable[[Tensors], None]:
    return lambda tensors: [tensors.pop(one) for one in list(tensors) if one.startswith(name)] and None


def put(name: str, make: Callable[[Tensor], Tensor]) -> Callable[[Tensors], None]:
    def change(tensors: Tensors) -> None:
        full = next(one for one in sorted(tensors) if one.startswith(name))
        tensors[full] = make(tensors[full])

    return change


CHANGES: dict[str, Callable[[Tensors], None]] = {
    "a weight fewer": without("model.dynamics"),
    "another shape": put("model.", lambda one: one[:0]),
    "a moment of another shape": put("adam.0.exp_avg", lambda one: one[:0]),
    "a moment of a negative number": lambda tensors: tensors.update({"adam.-1.exp_avg": torch.zeros(1)}),
    "moments without their step": without("adam.0.step"),
    "NaN": put("model.", lambda one: one * torch.nan),
    "a short generator": put("batches", lambda one: one[:10]),
}


@pytest.mark.parametrize("rows", [[], [{}], [{"step": 2}], "x", None])
def test_metrics_that_a_run_cannot_go_on_from_are_named(rows: Any, own: Path, small: SimpleNamespace) -> None:
    path = own / "resume.safetensors"
    with safe_open(path, framework="pt") as file:
        header = file.metadata()
    save_file(load_file(path), path, metadata={**header, "state": json.dumps({"rows": rows})})
    with pytest.raises(UserError, match=r"resume\.safetensors is damaged: delete it to start again"):
        trainer(small, own).resume()


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_resume_file_is_named(name: str, own: Path, small: SimpleNamespace) -> None:
    """Also where it has the digest of what it then holds."""
    path = own / "resume.safetensors"
    for forged in (True, False):
        with safe_open(path, framework="pt") as file:
            header = file.metadata()
        tensors = load_file(path)
        CHANGES[name](tensors)
        tensors = {one: value.contiguous() for one, value in tensors.items()}
        save_file(tensors, path, metadata={**header, "sha256": tensors_digest(tensors)} if forged else header)
        with pytest.raises(UserError, match=r"resume\.safetensors is damaged: delete it to start again, .*: ") as no:
            trainer(small, own).resume()
        assert "\n" not in str(no.value)


def test_a_run_whose_best_checkpoint_is_gone_says_so_or_writes_it_again(own: Path, small: SimpleNamespace) -> None:
    run, path, saved = trainer(small, own), own / "checkpoint.safetensors", []
    run.resume()
    small.save_baseline(path, "dynamics")
    content = path.read_bytes()
    _keep_best(run, path, lambda step, row: saved.append(step))
    path.write_bytes(content[:-5])
    with pytest.raises(UserError, match="and later weights cannot replace it: restore it, .* is truncated or no"):
        _keep_best(run, path, lambda step, row: saved.append(step))
    assert not saved
    path.unlink()
    run.best_step = run.step
    _keep_best(run, path, lambda step, row: (saved.append(step), path.write_bytes(content)))
    assert saved == [8]
