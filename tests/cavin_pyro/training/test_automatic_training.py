"""`guide=auto_normal` of train: one batch for good, said in a line, resumed exactly, and of no use to check."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.loading import load_programs
from cavin_pyro.storage.checkpoint import load_checkpoint
from cavin_pyro.training.run import train

OPTIONS = [
    *("guide=auto_normal", "model.width=8", "trainer.batch_size=5", "trainer.learning_rate=1e-2"),
    *("trainer.validate_every=4", "windows.minimum_move=0.001", "windows.validation_fraction=0.4"),
]


def run(pushes: Path, folder: Path, *more: str) -> Any:
    return train(compose("train", f"data={pushes}", f"output={folder}", *OPTIONS, *more))


def test_it_learns_its_windows_resumes_and_says_what_it_is(
    own_pushes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = run(own_pushes, tmp_path / "whole", "trainer.steps=8")
    assert "5 of " in capsys.readouterr().out
    assert whole.rows[-1]["validation_loss"] < whole.rows[0]["validation_loss"]
    assert {"validation_kl_effect_code", "validation_kl_effect_code_unconstrained"} <= set(whole.rows[0])
    half = run(own_pushes, tmp_path / "half", "trainer.steps=4")
    resume = half.resume_path
    again = tmp_path / "again"
    again.mkdir()
    (again / "resume.safetensors").write_bytes(resume.read_bytes())
    (again / "metrics.csv").write_bytes((half.folder / "metrics.csv").read_bytes())
    resumed = run(own_pushes, again, "trainer.steps=8")
    for name, value in whole.guide.state_dict().items():
        assert torch.equal(value, resumed.guide.state_dict()[name]), name

    # What reads the checkpoint: the classes that it names are known, and check says why it cannot use them.
    path = whole.folder / "checkpoint.safetensors"
    with pytest.raises(UserError, match="parameters for windows of its training alone: .* cascaded, flow, joint"):
        load_programs(load_checkpoint(path), path)


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("objective=mean_field_elbo", "samples auxiliary sites, which this objective leaves out: choose objective="),
        ("objective.warm_up_steps=5", "without objective.kl_weights and objective.warm_up_steps"),
        ("guide.autoguide._target_=pyro.infer.autoguide.AutoNothing", "cannot be built: Error"),
    ],
)
def test_what_does_not_go_with_it_is_refused(option: str, said: str, own_pushes: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=said):
        run(own_pushes, tmp_path / "run", "trainer.steps=4", option)
    assert not (tmp_path / "run").exists()
