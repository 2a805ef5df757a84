"""The command that criticises, from a checkpoint and a dataset to the report."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

from cavin_pyro.config.commands import WindowConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism import sections
from cavin_pyro.criticism.loading import CheckContext, compare_data, load_context, trained_windows
from cavin_pyro.criticism.section import Section, Verdict
from cavin_pyro.data.collection import collect
from cavin_pyro.data.dataset import content_record
from cavin_pyro.data.episodes import WorldCollection
from cavin_pyro.data.windows import load_windows
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.storage.checkpoint import load, save
from cavin_pyro.training.run import train
from tests.cavin_pyro.conftest import SMALL_CHECK, WINDOWS
from tests.guides.user_programs import InferredKindsGuide, KindsGuide, KindsModel

POINT = {"_target_": "tests.cavin_pyro.data.point.Point"}
SMALL = [*SMALL_CHECK, "sizes.subgoals.scenes=2"]


@pytest.fixture(scope="module")
def trained(small: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint that tells which windows it was trained on."""
    path = tmp_path_factory.mktemp("trained") / "checkpoint.safetensors"
    config = {**small.config(), "windows": WINDOWS, "seed": 1}
    save(path, **small.parts(), config=config, provenance={"step": 0, "command": "train <here>"})
    return path


@pytest.fixture
def check_config(trained: Path, pushes: Path) -> Callable[..., DictConfig]:
    def configuration(*further: str) -> DictConfig:
        return compose("check", f"checkpoint={trained}", f"data={pushes}", *SMALL, *further)

    return configuration


def test_the_command_writes_a_report(trained: Path, pushes: Path, shell: SimpleNamespace, tmp_path: Path) -> None:
    line = [f"checkpoint={trained}", f"data={pushes}", "output=out", *SMALL]
    first = shell.run_command("check", *line, folder=tmp_path)
    assert first.status == 0, first.errors
    assert first.complaints == []
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert left == {"config.yaml", "report.html", "report.json", "sections"}
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["about"]["model"] == "CascadedModel"
    assert report["about"]["windows"] == {"training": 5, "validation": 5}
    assert report["sections"]["subgoals"]["values"]["scenes"] == 2
    html = (tmp_path / "out" / "report.html").read_text()
    assert "train &lt;here&gt;" in html and "http" not in html.replace("http-equiv", "")


@pytest.mark.parametrize(
    "name", ["flat", *(pytest.param(name, marks=pytest.mark.soak) for name in ("dynamics", "single_latent"))]
)
def test_other_models_are_checked_for_what_they_have(
    name: str, small: SimpleNamespace, pushes: Path, tmp_path: Path
) -> None:
    small.save_baseline(tmp_path / "checkpoint", name, windows=WINDOWS, seed=1)
    config = compose("check", f"checkpoint={tmp_path / 'checkpoint'}", f"data={pushes}", *SMALL_CHECK)
    context, _ = load_context(config)
    parts = sections.run_sections(list(sections.SECTIONS), context, config.sizes, tmp_path, "")
    nothing = {part["name"] for part in parts if "The model has no codes" in " ".join(part["findings"])}
    assert nothing == ({"guide", "prior", "subgoals"} if name == "dynamics" else set())


def test_in_another_world_motions_are_executed_if_it_is_given(pushes: Path, tmp_path: Path) -> None:
    (tmp_path / "walks").mkdir()
    walks = WorldCollection(POINT, seed=3, steps=12, episodes_per_shard=10)
    collect(walks, tmp_path / "walks", transitions=250, workers=1)
    steps = ("trainer.steps=3", "trainer.validate_every=3", "trainer.batch_size=8", "model.width=8")
    train(compose("train", f"data={tmp_path / 'walks'}", f"output={tmp_path / 'run'}", *steps))
    words = [f"checkpoint={tmp_path / 'run' / 'checkpoint.safetensors'}", *SMALL_CHECK]
    for env in ([], [f"env._target_={POINT['_target_']}"]):
        config = compose("check", f"data={tmp_path / 'walks'}", *words, *env)
        context, _ = load_context(config)
        *others, last = sections.run_sections(list(sections.SECTIONS), context, config.sizes, tmp_path, str(env))
        assert all(part["values"]["windows"] for part in others)
        assert last["values"].get("scenes") == (1 if env else None)
    with pytest.raises(UserError, match=r"is of another world than checkpoint .*: choose another dataset"):
        load_context(compose("check", f"data={pushes}", *words))


@pytest.mark.parametrize("kind", [KindsGuide, InferredKindsGuide])
def test_a_discrete_latent_of_a_users_model_is_left_to_the_sections_that_it_suits(
    kind: type[KindsGuide], cascade: CheckContext, tmp_path: Path
) -> None:
    model = KindsModel(space=SPACE, width=8, motion_dimension=4).double().requires_grad_(False)
    context = replace(cascade, model=model, guide=kind(model, width=8).double().requires_grad_(False))
    names = ["elbo", "guide", "prior", "predictive", "intervals"]
    sizes = {"guide": {"samples": 8, "particles": 20}, "predictive": {"replicates": 2}, "intervals": {"samples": 8}}
    parts = {part["name"]: part for part in sections.run_sections(names, context, sizes, tmp_path, "")}
    unsuited = {name for name, part in parts.items() if part["verdict"]["level"] == "none"}
    assert unsuited == ({"guide", "prior"} if kind is InferredKindsGuide else set())
    for name in unsuited:
        assert parts[name]["findings"] == ["kind: this check is of codes that the guide samples as vectors of numbers."]
    assert "kl_kind" in parts["elbo"]["values"]["validation"] and "z" in parts["elbo"]["values"]["active"]


def test_windows_are_those_that_training_held_out_and_all_their_terms_count(
    check_config: Callable[..., DictConfig], trained: Path, pushes: Path
) -> None:
    context, about = load_context(check_config("windows=1000"))
    assert context.seed == 0
    checkpoint = load(trained)
    windows, segment_length, seed = trained_windows(checkpoint)
    table = load_windows([pushes], context.geometry, windows, segment_length=segment_length, seed=seed)
    for name in ("training", "validation"):
        window = getattr(context, name)
        counted = getattr(table, name)[table.sequence_mask[getattr(table, name)]]
        torch.testing.assert_close(window.states.centers, table.batch(counted).states.centers, rtol=0, atol=0)
        assert window.sequence_mask.all()
        assert about["windows"][name] == len(counted) > 0
        assert getattr(context, f"{name}_episodes").equal(table.episodes[counted])
    assert not context.model.training and not context.guide.training
    parameters = [*context.model.parameters(), *context.guide.parameters()]
    assert parameters and not any(parameter.requires_grad for parameter in parameters)
    assert json.loads(json.dumps(about)) == about
    assert windows.minimum_move == WINDOWS["minimum_move"]
    assert load_context(check_config("windows=1000"))[1]["windows_digest"] == about["windows_digest"]
    for other in ("windows=2", "seed=1"):
        assert load_context(check_config("windows=3", other))[1]["windows_digest"] != about["windows_digest"]


def test_a_report_says_whether_the_model_was_trained_on_the_data(pushes: Path) -> None:
    fingerprint = content_record(pushes)["fingerprint"]
    cases = {True: [{"fingerprint": "0"}, {"fingerprint": fingerprint}], False: [{"fingerprint": "0"}], None: []}
    for same, entries in cases.items():
        assert compare_data(pushes, {"data": entries})["same"] is same
    assert compare_data(pushes, {})["same"] is None and compare_data(pushes, {"data": "damaged"})["same"] is None


def test_checkpoints_that_cannot_be_checked_are_refused_with_the_reason(small: SimpleNamespace, tmp_path: Path) -> None:
    path, parts, config = tmp_path / "checkpoint", small.parts(), small.config()

    def saved(parts: dict[str, torch.nn.Module], config: dict[str, Any]) -> Any:
        save(path, **parts, config=config, provenance={})
        return load(path)

    assert saved(parts, config).guide
    without_guide = {name: part for name, part in parts.items() if name != "guide"}
    unnamed = {name: part for name, part in config.items() if name != "guide"}
    for what, kept in ((without_guide, config), (parts, unnamed)):
        with pytest.raises(UserError, match="holds no guide: give one that train has written"):
            assert saved(what, kept).guide
    for wrong in (
        *({}, {"windows": WINDOWS}, {"windows": {}, "seed": 0}, {"windows": 3, "seed": 0}),
        *({"windows": WINDOWS, "seed": seed} for seed in ("x", -1, math.inf, math.nan)),
        {"windows": {**WINDOWS, "held_out_objects": [[]]}, "seed": 0},
    ):
        with pytest.raises(UserError, match="does not tell which windows its training held out"):
            trained_windows(saved(parts, {**config, **wrong}))
    told = trained_windows(saved(parts, {**config, "windows": WINDOWS, "seed": 7}))
    assert told == (WindowConfig(**WINDOWS, held_out_objects=[]), 3, 7)


def test_sections_are_chosen_by_name_and_run_in_the_reports_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sections, "SECTIONS", {"one": None, "two": None, "three": None})
    assert sections.choose_sections(None, {}) == ["one", "two", "three"]
    assert sections.choose_sections(["three", "one"], {}) == ["one", "three"]
    assert sections.choose_sections(["two"], {"one": {"scenes": 0}}) == ["two"]
    with pytest.raises(UserError, match=r"sizes\.one\.scenes must be at least 1, not 0"):
        sections.choose_sections(["one"], {"one": {"scenes": 0}})


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the sections that ran, of two that tell random numbers."""
    ran: list[str] = []

    def assess(context: CheckContext, *, name: str) -> Section:
        ran.append(name)
        sampled = [float(torch.rand(())), float(np.random.rand())]  # noqa: NPY002
        return Section("", Verdict("none", ""), values={"sampled": sampled})

    both = {name: (name, partial(assess, name=name)) for name in ("one", "two")}
    monkeypatch.setattr(sections, "SECTIONS", both)
    return ran


def test_finished_sections_are_kept_and_others_run_again(counted: list[str], tmp_path: Path) -> None:
    nothing: Any = None
    context = CheckContext(nothing, nothing, nothing, nothing, nothing, seed=3)

    def run(*names: str, fingerprint: str = "a") -> list[Any]:
        counted.clear()
        return sections.run_sections(names, context, {}, tmp_path, fingerprint)

    both = run("one", "two")
    assert counted == ["one", "two"]
    assert run("one", "two") == both and counted == []
    (tmp_path / "sections" / "two.json").write_text("{")
    assert run("one", "two") == both and counted == ["two"]  # whatever ran before it samples the same numbers
    run("one", fingerprint="b")
    assert counted == ["one"]
