from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import pytest
import yaml
from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.run_directory import check_same_data, check_same_run, write_config
from envs.tasks import GeneratedLayouts


def config(**changes: object) -> DictConfig:
    overrides = {
        "seed": 3,
        "output": "a",
        "name": "${output}-${seed}",
        "trainer": {"steps": 10, "rates": [0.1, 0.2]},
    }
    return OmegaConf.create({**overrides, **changes})


def test_a_run_directory_holds_its_configuration_without_interpolations(tmp_path: Path) -> None:
    plain = write_config(tmp_path, config())
    assert plain == {"seed": 3, "output": "a", "name": "a-3", "trainer": {"steps": 10, "rates": [0.1, 0.2]}}
    assert yaml.safe_load((tmp_path / "config.yaml").read_text()) == plain


def test_a_run_resumes_with_the_same_configuration(tmp_path: Path) -> None:
    check_same_run(tmp_path, config(), ignore=())
    write_config(tmp_path, config())
    check_same_run(tmp_path, config(), ignore=())
    check_same_run(tmp_path, config(output="b", name="c"), ignore=("output", "name"))
    check_same_run(tmp_path, config(trainer={"steps": 20, "rates": [0.1, 0.2]}), ignore=("trainer.steps",))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seed": 4, "name": "a-3"}, "a run with seed=3, not 4"),
        ({"trainer": {"steps": 20, "rates": [0.1, 0.2]}}, "a run with trainer.steps=10, not 20"),
        ({"trainer": {"steps": 10, "rates": [0.1, 0.3]}}, r"trainer.rates=\[0.1, 0.2\], not \[0.1, 0.3\]"),
        ({"extra": 1}, "a run with extra=None, not 1"),
    ],
)
def test_a_run_with_another_configuration_is_refused_and_the_option_is_named(
    changes: dict, said: str, tmp_path: Path
) -> None:
    write_config(tmp_path, config())
    (tmp_path / "metrics.csv").touch()
    with pytest.raises(UserError, match=f"{said}: resume with the same options, or choose another output=DIR"):
        check_same_run(tmp_path, config(**changes), ignore=())


def test_a_run_whose_task_was_stored_by_name_resumes(tmp_path: Path) -> None:
    write_config(tmp_path, config(task="crossing"))
    (tmp_path / "metrics.csv").touch()
    check_same_run(tmp_path, config(task={"_target_": "envs.tasks.crossing.Crossing"}), ignore=())
    with pytest.raises(UserError, match=r"a run with task\._target_=envs\.tasks\.crossing\.Crossing, not my\.Own"):
        check_same_run(tmp_path, config(task={"_target_": "my.Own"}), ignore=())


@pytest.mark.parametrize(
    ("stored", "said"),
    [
        ("task: [a]\nreward: sparse\n", "a run with .*=.*, not"),
        ("task: {a: [1]}\n", "a run with .*=.*, not"),
        ("[" * 5000, "config.yaml is damaged"),
    ],
)
def test_a_stored_configuration_of_another_form_is_one_line(stored: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(stored)
    (tmp_path / "metrics.csv").touch()
    with pytest.raises(UserError, match=said) as refused:
        check_same_run(tmp_path, config(task="crossing"), ignore=())
    assert "\n" not in str(refused.value)


def test_a_run_from_before_checkpoints_had_planners_resumes(tmp_path: Path) -> None:
    write_config(tmp_path, config(checkpoint="cavin", planner={"samples": 8}))
    (tmp_path / "episodes.jsonl").touch()
    now = {"samples": 8, "default_checkpoint": "cavin"}
    check_same_run(tmp_path, config(checkpoint="cavin", planner=now), ignore=())
    with pytest.raises(UserError, match="a run with checkpoint=cavin, not mpc"):
        check_same_run(tmp_path, config(checkpoint="mpc", planner={**now, "default_checkpoint": "mpc"}), ignore=())


def test_a_run_that_failed_before_its_first_result_may_begin_otherwise(tmp_path: Path) -> None:
    write_config(tmp_path, config())
    check_same_run(tmp_path, config(seed=4, name="a-3"), ignore=())
    (tmp_path / "metrics.csv").touch()
    with pytest.raises(UserError, match="a run with seed=3, not 4"):
        check_same_run(tmp_path, config(seed=4, name="a-3"), ignore=())


def test_a_damaged_configuration_is_named(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("seed: [1")
    (tmp_path / "metrics.csv").touch()
    with pytest.raises(UserError, match=r"config\.yaml is damaged"):
        check_same_run(tmp_path, config(), ignore=())


def test_training_resumes_with_the_same_data_in_any_folder(tmp_path: Path) -> None:
    data = {"transitions": 60, "fingerprint": "12ab", "episodes": 12}
    check_same_data(tmp_path, [data])
    check_same_data(tmp_path, [{**data, "episodes": 13}])
    noted = (tmp_path / "data.json").read_text()
    for other in ([{**data, "fingerprint": "34cd"}], [{**data, "transitions": 70}], [data, data]):
        with pytest.raises(UserError, match=r"other data, 60 transitions \(12ab\) instead of .* or choose another"):
            check_same_data(tmp_path, other)
    assert (tmp_path / "data.json").read_text() == noted


def test_a_run_that_an_older_version_began_resumes(tmp_path: Path) -> None:
    (tmp_path / "data.json").write_text('[{"transitions": 60, "mark": "12ab"}]')
    check_same_data(tmp_path, [{"transitions": 60, "fingerprint": "12ab"}])
    with pytest.raises(UserError, match="other data"):
        check_same_data(tmp_path, [{"transitions": 60, "fingerprint": "34cd"}])


@pytest.mark.parametrize("content", ["[1]", "5", '[{"transitions": 60}]'])
def test_a_damaged_record_of_the_data_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "data.json").write_text(content)
    with pytest.raises(UserError, match="other data, something unreadable instead of 60 transitions"):
        check_same_data(tmp_path, [{"transitions": 60, "fingerprint": "12ab"}])


def test_an_evaluation_belongs_to_a_device_which_is_the_cpu_where_it_does_not_say(tmp_path: Path) -> None:
    write_config(tmp_path, config(reward="sparse"))
    (tmp_path / "episodes.jsonl").touch()
    now = {"reward": "sparse", "criterion": "strict", "generated": asdict(GeneratedLayouts())}
    check_same_run(tmp_path, config(**now, device="cpu"), ignore=())
    with pytest.raises(UserError, match="a run with device=cpu, not cuda"):
        check_same_run(tmp_path, config(**now, device="cuda"), ignore=())


def test_a_training_of_an_older_version_mirrored_nothing_and_trained_all_parts_with_adam(tmp_path: Path) -> None:
    write_config(tmp_path, config(trainer={"schedule": "cosine"}))
    (tmp_path / "metrics.csv").touch()
    now = {"schedule": "cosine", "reflect": False, "optimizer": "adam"}
    check_same_run(tmp_path, config(trainer=now, trained=[], initial=None), ignore=())
    for name, other in (("reflect", True), ("optimizer", "muon")):
        with pytest.raises(UserError, match=f"a run with trainer.{name}={now[name]}, not {other}"):
            check_same_run(tmp_path, config(trainer={**now, name: other}, trained=[]), ignore=())
