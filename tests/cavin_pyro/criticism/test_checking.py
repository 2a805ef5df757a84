"""The command that criticises, from a checkpoint and a dataset to the report."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism import sections
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.loading import load_context, load_programs, sample_windows, trained_windows
from cavin_pyro.criticism.section import Section
from cavin_pyro.criticism.training_data import compare_data
from cavin_pyro.data.dataset import content_records, read_metadata, write_metadata
from cavin_pyro.data.windows import load_windows
from cavin_pyro.storage.checkpoint import load_checkpoint, save_checkpoint
from tests.cavin_pyro.conftest import SMALL_CHECK, WINDOWS

SMALL = [*SMALL_CHECK, "sizes.consistency.scenes=2"]


@pytest.fixture(scope="module")
def trained(small: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint that tells which windows it was trained on."""
    path = tmp_path_factory.mktemp("trained") / "checkpoint.safetensors"
    config = {**small.config(), "windows": WINDOWS, "seed": 1}
    save_checkpoint(path, parts=small.parts(), config=config, provenance={"step": 0, "command": "train <here>"})
    return path


@pytest.fixture
def check_config(trained: Path, pushes: Path) -> Callable[..., DictConfig]:
    def configuration(*further: str) -> DictConfig:
        return compose("check", f"checkpoint={trained}", f"data={pushes}", *SMALL, *further)

    return configuration


def test_the_command_writes_a_report_and_runs_no_section_twice(
    trained: Path, pushes: Path, shell: SimpleNamespace, tmp_path: Path
) -> None:
    line = [f"checkpoint={trained}", f"data={pushes}", "output=out", *SMALL]
    first = shell.run_command("check", *line, folder=tmp_path)
    assert first.status == 0, first.errors
    assert first.complaints == []
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert left == {"config.yaml", "report.html", "report.json", "sections"}
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["about"]["model"] == "CascadedModel"
    assert report["about"]["windows"] == {"training": 5, "validation": 5}
    assert report["sections"]["consistency"]["values"]["scenes"] == 2
    html = (tmp_path / "out" / "report.html").read_text()
    assert "train &lt;here&gt;" in html and "http" not in html.replace("http-equiv", "")
    again = shell.run_command("check", *line, folder=tmp_path)
    assert again.status == 0, again.errors
    assert "executing" in first.errors and "executing" not in again.errors
    assert json.loads((tmp_path / "out" / "report.json").read_text())["sections"] == report["sections"]


def test_windows_are_those_that_training_held_out_and_all_their_terms_count(
    check_config: Callable[..., DictConfig], trained: Path, pushes: Path
) -> None:
    context, about = load_context(check_config("windows=1000"))
    assert context.seed == 0
    checkpoint = load_checkpoint(trained)
    windows, segment_length, seed = trained_windows(checkpoint, trained)
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
    assert context.selection == windows and windows.minimum_move == WINDOWS["minimum_move"]
    assert load_context(check_config("windows=1000"))[1]["windows_digest"] == about["windows_digest"]
    for other in ("windows=2", "seed=1"):
        assert load_context(check_config("windows=3", other))[1]["windows_digest"] != about["windows_digest"]


def test_sampled_windows_depend_on_their_seed() -> None:
    numbers = torch.arange(40)
    table: Any = SimpleNamespace(sequence_mask=numbers % 2 == 0)
    first, again, other = (sample_windows(table, numbers, 6, seed=[seed, 0]) for seed in (0, 0, 1))
    assert len(set(first.tolist())) == 6 and first.equal(again) and not first.equal(other)
    assert (first % 2 == 0).all()
    assert sample_windows(table, numbers[:7], 1000, seed=[0]).tolist() == [0, 2, 4, 6]


def test_a_report_says_whether_the_model_was_trained_on_the_data(own_pushes: Path) -> None:
    metadata, fingerprint = read_metadata(own_pushes), content_records(own_pushes)[0]["fingerprint"]
    entry = {name: metadata[name] for name in ("transitions", "episodes", "configuration")}

    def verdict(*entries: dict[str, Any]) -> tuple[bool | None, str]:
        compared = compare_data(own_pushes, {"data": list(entries)})
        return compared["same"], compared["verdict"]

    other = {**entry, "configuration": {**metadata["configuration"], "seed": 9}}
    assert verdict({**entry, "fingerprint": fingerprint}) == (True, "the model was trained on these")
    assert verdict(other, {**entry, "fingerprint": fingerprint}) == (True, "the model was trained on these")
    assert verdict({**entry, "fingerprint": fingerprint, "transitions": 9}) == (
        True,
        "the model was trained on these, of which it saw 9",
    )
    assert verdict(other)[0] is False
    assert verdict({**entry, "fingerprint": "0" * 12})[0] is False
    assert verdict(entry)[0] is None
    assert verdict()[0] is None
    assert compare_data(own_pushes, {})["same"] is None
    assert compare_data(own_pushes, {"data": "damaged"})["same"] is None
    write_metadata(own_pushes, {**metadata, "configuration": {**metadata["configuration"], "seed": 9}})
    assert verdict({**entry, "fingerprint": fingerprint})[0] is False


def test_checkpoints_that_cannot_be_checked_are_refused_with_the_reason(small: SimpleNamespace, tmp_path: Path) -> None:
    path, parts, config = tmp_path / "checkpoint", small.parts(), small.config()

    def saved(parts: dict[str, torch.nn.Module], config: dict[str, Any]) -> Any:
        save_checkpoint(path, parts=parts, config=config, provenance={})
        return load_checkpoint(path)

    load_programs(saved(parts, config), path)
    without_guide = {name: part for name, part in parts.items() if name != "guide"}
    with pytest.raises(UserError, match="holds no guide: give one that train has written"):
        load_programs(saved(without_guide, config), path)
    with pytest.raises(UserError, match="holds no guide"):
        load_programs(saved(parts, {name: part for name, part in config.items() if name != "guide"}), path)
    with pytest.raises(UserError, match="holds no model"):
        load_programs(saved(parts, {}), path)
    for wrong in (
        {},
        {"windows": WINDOWS},
        {"windows": {"negative_fraction": 0.2}, "seed": 0},
        {"windows": {}, "seed": 0},
        {"windows": 3, "seed": 0},
        {"windows": None, "seed": 0},
        {"windows": [], "seed": 0},
    ):
        with pytest.raises(UserError, match="does not tell which windows its training held out"):
            trained_windows(saved(parts, {**config, **wrong}), path)
    told = trained_windows(saved(parts, {**config, "windows": WINDOWS, "seed": 7}), path)
    assert told == (WindowConfig(**WINDOWS, held_out_objects=[]), 3, 7)


def test_sections_are_chosen_by_name_and_run_in_the_reports_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sections, "SECTIONS", {"one": None, "two": None, "three": None})
    assert sections.choose_sections(None, {}) == ["one", "two", "three"]
    assert sections.choose_sections(["three", "one"], {}) == ["one", "three"]
    assert sections.choose_sections("two", {"one": {"scenes": 0}}) == ["two"]
    with pytest.raises(UserError, match="unknown section 'four': choose from one, two, three"):
        sections.choose_sections(["one", "four"], {})
    with pytest.raises(UserError, match="at least one: choose from one, two, three"):
        sections.choose_sections([], {})
    with pytest.raises(UserError, match=r"sizes\.one\.scenes must be at least 1, not 0"):
        sections.choose_sections(["one"], {"one": {"scenes": 0}})


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the sections that ran, of two that tell random numbers."""
    ran: list[str] = []

    def assess(context: CheckContext, *, name: str) -> Section:
        ran.append(name)
        return Section(name, name, "", [], {"sampled": [float(torch.rand(())), float(np.random.rand())]})  # noqa: NPY002

    both = {"one": lambda context: assess(context, name="one"), "two": lambda context: assess(context, name="two")}
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
