"""What a run's folder holds of it: its configuration, its data, its provenance, its scalars."""

from __future__ import annotations

import datetime
import json
import sys
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import DictConfig, OmegaConf

from cavin_pyro import __version__
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.storage.checkpoint import save
from cavin_pyro.storage.geometry import chosen_geometry
from cavin_pyro.storage.provenance import provenance
from cavin_pyro.storage.run_directory import check_same_data, check_same_run, write_config


def config(**changes: object) -> DictConfig:
    trainer = {"steps": 10, "rates": [0.1, 0.2]}
    return OmegaConf.create({"seed": 3, "output": "a", "name": "${output}-${seed}", "trainer": trainer, **changes})


def test_a_run_directory_holds_its_configuration_without_interpolations(tmp_path: Path) -> None:
    plain = write_config(tmp_path, config())
    assert plain == {"seed": 3, "output": "a", "name": "a-3", "trainer": {"steps": 10, "rates": [0.1, 0.2]}}
    assert yaml.safe_load((tmp_path / "config.yaml").read_text()) == plain


def test_a_run_resumes_with_the_same_configuration(tmp_path: Path) -> None:
    write_config(tmp_path, config())
    (tmp_path / "metrics.csv").touch()
    check_same_run(tmp_path, config(), ignore=())
    check_same_run(tmp_path, config(output="b", name="c"), ignore=("output", "name"))
    check_same_run(tmp_path, config(trainer={"steps": 20, "rates": [0.1, 0.2]}), ignore=("trainer.steps",))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seed": 4, "name": "a-3"}, "a run with seed=3, not 4"),
        ({"trainer": {"steps": 20, "rates": [0.1, 0.2]}}, "a run with trainer.steps=10, not 20"),
        ({"trainer": {"steps": 10, "rates": [0.1, 0.3]}}, r"trainer.rates=\[0.1,0.2\], not \[0.1,0.3\]"),
        ({"extra": 1}, "a run with extra=null, not 1"),
    ],
)
def test_a_run_with_another_configuration_is_refused_and_the_option_is_named(
    changes: dict, said: str, tmp_path: Path
) -> None:
    write_config(tmp_path, config())
    check_same_run(tmp_path, config(**changes), ignore=())  # it may begin otherwise before its first result
    (tmp_path / "metrics.csv").touch()
    with pytest.raises(UserError, match=f"{said}: resume it with its own command and options, or "):
        check_same_run(tmp_path, config(**changes), ignore=())


@pytest.mark.parametrize(("stored", "said"), [("trainer: [a]\n", "a run with .*=.*, not"), ("seed: [1", "is damaged")])
def test_a_stored_configuration_of_another_form_is_one_line(stored: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(stored)
    (tmp_path / "metrics.csv").touch()
    with pytest.raises(UserError, match=said) as refused:
        check_same_run(tmp_path, config(), ignore=())
    assert "\n" not in str(refused.value)


def test_training_resumes_with_the_same_data_in_any_folder(tmp_path: Path) -> None:
    data = {"transitions": 60, "fingerprint": "12ab", "episodes": 12}
    check_same_data(tmp_path, [{**data, "transitions": 1}])  # of a run that kept nothing
    check_same_data(tmp_path, [data])
    (tmp_path / "metrics.csv").touch()
    check_same_data(tmp_path, [{**data, "episodes": 13}])
    noted = (tmp_path / "data.json").read_text()
    for other in ([{**data, "fingerprint": "34cd"}], [{**data, "transitions": 70}], [data, data]):
        with pytest.raises(UserError, match=r"other data, .*60.*12ab.* instead of .* or choose another"):
            check_same_data(tmp_path, other)
    assert (tmp_path / "data.json").read_text() == noted


def test_provenance_names_command_versions_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/somewhere/cavin_pyro/plan.py", "task=crossing", "output=a b"])
    record = provenance()
    assert json.loads(json.dumps(record)) == record
    assert record["program"] == f"cavin_pyro {__version__}"
    assert record["command"] == "python -m cavin_pyro.plan task=crossing 'output=a b'"
    assert record["packages"]["torch"] == torch.__version__
    age = datetime.datetime.now(datetime.UTC) - datetime.datetime.fromisoformat(record["date"])
    assert datetime.timedelta(seconds=-2) < age < datetime.timedelta(minutes=1)
    monkeypatch.setattr(sys, "argv", ["/usr/bin/cavin-plan"])
    assert provenance()["command"] == "python -m cavin_pyro.plan"
    monkeypatch.setattr(sys, "argv", ["/somewhere/study.py", "3"])
    assert provenance()["command"] == "python study.py 3"


def test_a_pointnet_out_of_a_whole_checkpoint_keeps_its_own_record(tmp_path: Path) -> None:
    path = tmp_path / "pointnet.safetensors"
    for record in ({"command": "pretrain"}, {"command": "train", "pointnet": {"command": "pretrain"}}):
        save(path, geometry=PointNet(), config={}, provenance=record)
        assert chosen_geometry(compose("train", f"pointnet={path}"))[1] == {"pointnet": {"command": "pretrain"}}
