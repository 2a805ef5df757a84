"""Resume files that were changed or lost in part, and a run whose checkpoint is gone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from cavin_pyro.config.commands.training import TrainerConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.training import pretraining
from cavin_pyro.training.optimizers import OPTIMIZERS, make_optimizers
from cavin_pyro.training.resume import ENTRIES, load_optimizer, optimizer_tensors, write_resume
from cavin_pyro.training.run import _keep_best
from cavin_pyro.training.trainer import Trainer
from tests.cavin_pyro.training.test_pretraining import clouds, pretrained
from tests.cavin_pyro.training.test_trainer import SHORT, trainer

Tensors = dict[str, Tensor]


def without(name: str) -> Callable[[Tensors], None]:
    return lambda tensors: [tensors.pop(one) for one in list(tensors) if one.startswith(name)] and None


def put(name: str, make: Callable[[Tensor], Tensor]) -> Callable[[Tensors], None]:
    def change(tensors: Tensors) -> None:
        full = next(one for one in sorted(tensors) if one.startswith(name))
        tensors[full] = make(tensors[full])

    return change


CHANGES = {
    "no counters": without("counters"),
    "no generator": without("batches"),
    "a weight fewer": without("model.dynamics"),
    "another shape": put("model.", lambda one: one[:0]),
    "a moment of another shape": put("adam.0.exp_avg", lambda one: one[:0]),
    "a moment of no weight": lambda tensors: tensors.update({"adam.99999.exp_avg": torch.zeros(1)}),
    "a moment of a negative number": lambda tensors: tensors.update({"adam.-1.exp_avg": torch.zeros(1)}),
    "half of the moments of a weight": without("adam.0.exp_avg_sq"),
    "moments without their step": without("adam.0.step"),
    "a moment without a number": lambda tensors: tensors.update({"adam.x.exp_avg": torch.zeros(1)}),
    "NaN": put("model.", lambda one: one * torch.nan),
    "a short generator": put("batches", lambda one: one[:10]),
    "a generator of numbers": put("random", lambda one: one.float()),
    "few counters": put("counters", lambda one: one[:2]),
    "odd counters": put("counters", lambda one: one.flip(0) - 100),
}


@pytest.fixture(scope="module")
def finished(small: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "run"
    trainer(small, folder).run()
    return folder


@pytest.fixture
def own(finished: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("metrics.csv", "resume.safetensors"):
        (folder / name).write_bytes((finished / name).read_bytes())
    return folder


def change(path: Path, function: Callable[[Tensors], Any], *, forged: bool) -> None:
    """Change a file's tensors; a forged one has the digest of what it then holds."""
    with safe_open(path, framework="pt") as file:
        header = file.metadata()
    tensors = load_file(path)
    function(tensors)
    tensors = {name: value.contiguous() for name, value in tensors.items()}
    save_file(tensors, path, metadata={**header, "sha256": tensors_digest(tensors)} if forged else header)


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_resume_file_is_named(name: str, own: Path, small: SimpleNamespace) -> None:
    for forged in (True, False):
        change(own / "resume.safetensors", CHANGES[name], forged=forged)
        with pytest.raises(UserError, match=r"resume\.safetensors is damaged \(.*\): delete it to start again") as no:
            trainer(small, own).resume()
        assert "\n" not in str(no.value)


PARAMETERS = 3


def stepped(name: str, *, without_gradient: int | None = None) -> tuple[torch.optim.Optimizer, Tensors]:
    """An optimizer of three matrices after a step, and its moments."""
    torch.manual_seed(0)
    weights = [nn.Parameter(torch.randn(6, 6)) for _ in range(PARAMETERS)]
    (optimizer,) = make_optimizers(name, weights, 0.1).values()
    for number, weight in enumerate(weights):
        weight.grad = None if number == without_gradient else torch.ones_like(weight)
    optimizer.step()
    return optimizer, optimizer_tensors(optimizer, name)


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_moments_come_back_and_a_weight_without_gradient_has_none(name: str) -> None:
    optimizer, tensors = stepped(name, without_gradient=1)
    assert len(tensors) == (PARAMETERS - 1) * len(ENTRIES[name]) and f"{name}.1" not in " ".join(tensors)
    again, _ = stepped(name)
    load_optimizer(again, tensors, name)
    assert optimizer_tensors(again, name).keys() == tensors.keys()
    with pytest.raises(ValueError, match=rf"^{name}\.3 belongs to no weight$"):
        load_optimizer(optimizer, {**tensors, f"{name}.3.exp_avg": torch.zeros(6, 6)}, name)


@pytest.mark.parametrize("lacking", ENTRIES["adam"])
def test_half_of_the_moments_of_a_weight_are_damage(lacking: str) -> None:
    optimizer, tensors = stepped("adam")
    del tensors[f"adam.2.{lacking}"]
    with pytest.raises(ValueError, match=rf"^adam\.2\.{lacking} is missing$"):
        load_optimizer(optimizer, tensors)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_a_training_with_weights_that_get_no_gradient_resumes(
    optimizer: str, small: SimpleNamespace, tmp_path: Path
) -> None:
    config = TrainerConfig(**{**vars(SHORT), "optimizer": optimizer})

    def made() -> Trainer:
        run = trainer(small, tmp_path / "run", config)
        for made in run._optimizers.values():
            made.add_param_group({"params": [nn.Parameter(torch.zeros(8, 8))]})
        return run

    made().run()
    again = made()
    again.resume()
    assert (again.step, len(again.rows)) == (8, 4)


def test_a_resume_file_without_a_digest_is_refused(own: Path, small: SimpleNamespace) -> None:
    path = own / "resume.safetensors"
    save_file(load_file(path), path)
    with pytest.raises(UserError, match=r"damaged \(its tensors are not those that were saved\): delete it to start"):
        trainer(small, own).resume()


@pytest.mark.parametrize(
    "content", [None, "", "step,validation_loss\n2,x\n", "a,b\n1,2\n", "step,validation_loss\n2,1\n"]
)
def test_metrics_that_do_not_belong_to_the_resume_file_are_named(
    content: str | None, own: Path, small: SimpleNamespace
) -> None:
    path = own / "metrics.csv"
    path.unlink()
    if content is not None:
        path.write_text(content)
    with pytest.raises(UserError, match=r"metrics\.csv .* start again, or choose another output=DIR"):
        trainer(small, own).resume()


def test_a_run_whose_best_checkpoint_is_gone_says_so_or_writes_it_again(own: Path, small: SimpleNamespace) -> None:
    run, path, saved = trainer(small, own), own / "checkpoint.safetensors", []
    run.resume()
    small.save_baseline(path, "dynamics")
    content = path.read_bytes()
    _keep_best(run, path, lambda step, row: saved.append(step))
    path.unlink()
    run.best_step = 4
    with pytest.raises(UserError, match=r"of step 4, is gone or damaged, and later weights cannot replace it: restore"):
        _keep_best(run, path, lambda step, row: saved.append(step))
    path.write_bytes(content[:-5])
    with pytest.raises(UserError, match="is gone or damaged"):
        _keep_best(run, path, lambda step, row: saved.append(step))
    path.unlink()
    assert not saved
    run.best_step = run.step
    _keep_best(run, path, lambda step, row: (saved.append(step), path.write_bytes(content)))
    assert saved == [8]


def weights(part: torch.nn.Module) -> Tensor:
    return torch.nn.utils.parameters_to_vector(part.parameters())


def test_interrupted_pretraining_resumes_as_if_it_had_not_been_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("whole", "broken"):
        (tmp_path / name).mkdir()
    whole, losses = pretrained(tmp_path / "whole", steps=20, resume=tmp_path / "whole" / "resume.safetensors")
    plain, _ = pretrained(tmp_path / "whole", steps=20)
    assert torch.equal(weights(plain), weights(whole))
    written = []

    def interrupted(path: Path, *state: Any) -> None:
        write_resume(path, *state)
        written.append(path)
        if len(written) in (7, 12):
            raise KeyboardInterrupt

    monkeypatch.setattr(pretraining, "write_resume", interrupted)
    path = tmp_path / "broken" / "resume.safetensors"
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            pretrained(tmp_path / "broken", steps=20, resume=path)
    again, its_losses = pretrained(tmp_path / "broken", steps=20, resume=path)
    assert len(written) == 20  # none of the steps was made twice
    assert torch.equal(weights(again), weights(whole)) and its_losses == losses
    metrics = [(tmp_path / name / "metrics.csv").read_text() for name in ("whole", "broken")]
    assert metrics[0] == metrics[1]


def test_pretraining_goes_on_with_its_own_clouds_and_whole_files_only(tmp_path: Path) -> None:
    path = tmp_path / "resume.safetensors"
    pretrained(tmp_path, steps=3, resume=path)
    good = path.read_bytes()
    with pytest.raises(UserError, match=r"is damaged \(it was made with other clouds\): delete it to start again"):
        pretrained(tmp_path, steps=3, resume=path, points=clouds() * 2)
    with safe_open(path, framework="pt") as file:
        header, tensors = file.metadata(), load_file(path)
    state = json.loads(header["state"])
    for changes in ({"rows": []}, {"rows": [[1, 2, 3]]}, {"step": "x"}, {"generator": {}}, {"rate": None}):
        save_file(tensors, path, metadata={**header, "state": json.dumps({**state, **changes})})
        with pytest.raises(UserError, match=r"resume\.safetensors is damaged"):
            pretrained(tmp_path, steps=3, resume=path)
    for content in (good[:-4], b"", good[: len(good) // 2]):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"resume\.safetensors is damaged"):
            pretrained(tmp_path, steps=3, resume=path)
