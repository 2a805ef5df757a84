from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf import DictConfig
from pyarrow import parquet

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.reproduction.cells import evaluations
from cavin_pyro.reproduction.merging import check_shards, merge_tables
from cavin_pyro.reproduction.pipeline import check_inputs, chosen_rows
from cavin_pyro.reproduction.results import write_results
from cavin_pyro.reproduction.scales import SCALES
from cavin_pyro.reproduction.table import TABLE, episode_row, read_table, row_key, write_table
from cavin_pyro.storage.run_directory import write_config

METHODS = ["cavin", "mpc"]


def played() -> list[dict[str, Any]]:
    """The rows of a minimal run, in which CAVIN succeeds and MPC runs out of time."""
    rows = []
    for one in evaluations(SCALES["minimal"], METHODS, ["paper"]):
        outcome = "success" if one.cell.method == "cavin" else "timeout"
        line = {"seed": one.seed, "outcome": outcome, "steps": 2, "return": 97.5, "unsafe": 1, "ineffective": 0}
        line |= {"plans": 2, "plans_reaching_goal": 1, "subgoal_distance": None}
        strict = {"strict_outcome": outcome, "strict_steps": 2, "strict_return": 97.5}
        rows.append(episode_row(one, {**line, **strict, "planning_ms": [1.0]}))
    return rows


def config(**options: Any) -> DictConfig:
    overrides = ["scale=minimal", "planners=[paper]", f"methods=[{','.join(METHODS)}]"]
    return compose("reproduce", *overrides, *(f"{name}={value}" for name, value in options.items()))


def shard(folder: Path, rows: list[dict[str, Any]], **options: Any) -> Path:
    folder.mkdir()
    write_config(folder, config(output=folder, **options))
    write_table(folder / TABLE, rows)
    return folder


def test_a_table_comes_back_as_it_was_and_has_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "other"):
        write_table(tmp_path / name, played())
    assert read_table(tmp_path / "one") == played()
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


def test_a_table_with_an_old_name_is_read_under_the_new_one(tmp_path: Path) -> None:
    write_table(tmp_path / "new", played())
    table = parquet.read_table(tmp_path / "new")
    old = ["hopeful_plans" if name == "plans_reaching_goal" else name for name in table.column_names]
    parquet.write_table(table.rename_columns(old), tmp_path / "old")
    assert "hopeful_plans" in parquet.read_schema(tmp_path / "old").names
    assert read_table(tmp_path / "old") == played()


def test_shards_are_joined_to_the_table_of_a_whole_run(tmp_path: Path) -> None:
    rows = played()
    write_table(tmp_path / "whole", rows)
    cut = len(rows) // 2
    folders = [
        shard(tmp_path / "b", rows[cut:], shard="2/2"),
        shard(tmp_path / "a", rows[:cut], shard="1/2", workers=1),
    ]
    home = tmp_path / "joined"
    home.mkdir()
    assert merge_tables(config(output=home), home, folders) == rows
    assert (home / TABLE).read_bytes() == (tmp_path / "whole").read_bytes()


def test_joined_shards_keep_what_the_table_before_them_had(tmp_path: Path) -> None:
    rows = played()
    more = [{**row, "seed": row["seed"] + 7} for row in rows[:2]]  # of a table that the option `extends` named
    home = tmp_path / "joined"
    home.mkdir()
    joined = merge_tables(config(), home, [shard(tmp_path / name, [*rows, *more]) for name in "ab"])
    assert sorted(map(row_key, joined)) == sorted(map(row_key, [*rows, *more]))


def test_shards_that_have_one_episode_differently_are_refused(tmp_path: Path) -> None:
    rows = played()
    other = [{**rows[0], "strict_outcome": "fall"}, *rows[1:]]
    with pytest.raises(UserError, match="has another episode of cavin in clearing, scene 50000, than a folder"):
        merge_tables(config(), tmp_path, [shard(tmp_path / "a", rows), shard(tmp_path / "b", other)])


def test_shards_that_lack_episodes_or_have_other_options_are_refused(tmp_path: Path) -> None:
    half = shard(tmp_path / "half", played()[:2])
    with pytest.raises(UserError, match=r"lack 4 of 6 episodes, the first of cavin in clearing with training seed 0"):
        merge_tables(config(), tmp_path, [half])
    with pytest.raises(UserError, match="holds a run with scale=minimal, not smoke"):
        merge_tables(compose("reproduce", "scale=smoke", f"methods=[{','.join(METHODS)}]"), tmp_path, [half])
    with pytest.raises(UserError, match=f"holds no {TABLE}: let its shard end first"):
        check_shards([half, tmp_path / "none"])
    assert not (tmp_path / TABLE).exists()


def test_figures_and_page_follow_from_the_table_and_have_the_same_bytes(tmp_path: Path) -> None:
    written = []
    for name in ("one", "other"):
        home = tmp_path / name
        home.mkdir()
        written.append([(path.name, path.read_bytes()) for path in write_results(home, played(), "the command")])
    assert written[0] == written[1]
    names = {name for name, _ in written[0]}
    pictures = {f"{kind}-paper-{one}.png" for kind in ("figure", "failures") for one in ("strict", "published")}
    assert names == {"results.md", "statistics.json", *pictures}
    page = (tmp_path / "one" / "results.md").read_text()
    assert "| clearing | sparse | 1 | 100.0 % (20.7 to 100.0), n = 1 |" in page and "    the command" in page
    assert "| clearing | MPC | 1 | 0.0 % | 0.0 % | 0.0 % | 0.0 % | 100.0 % | 50.0 % | 0.0 % |" in page
    statistics = json.loads((tmp_path / "one" / "statistics.json").read_text())
    assert set(statistics) == {"rates", "tests", "interquartile_means", "failures"}


def test_without_scenes_of_three_objects_there_is_no_picture_of_failures(tmp_path: Path) -> None:
    rows = chosen_rows(played(), config(objects="[1]"))
    assert {row["objects"] for row in rows} == {1}
    names = {path.name for path in write_results(tmp_path, rows, "the command")}
    assert names == {"results.md", "statistics.json", *(f"figure-paper-{one}.png" for one in ("strict", "published"))}


def test_one_reward_alone_has_its_figures(tmp_path: Path) -> None:
    names = {
        path.name for path in write_results(tmp_path, chosen_rows(played(), config(rewards="[sparse]")), "command")
    }
    assert {"figure-paper-strict.png", "failures-paper-strict.png"} <= names
    assert "dense" not in (tmp_path / "results.md").read_text().partition("## The paper's claims")[0]


def test_a_table_is_drawn_as_far_as_the_options_choose() -> None:
    rows = played()
    assert chosen_rows(rows, config()) == rows
    ours = [*rows, {**rows[0], "method": "contact"}]
    assert (
        chosen_rows(ours, config(table="some.parquet", methods="null")) == ours
    )  # a table's own; `contact` runs where it is named
    assert chosen_rows(ours, config(methods="null")) == rows
    assert {row["method"] for row in chosen_rows(rows, config(methods="[mpc]"))} == {"mpc"}
    assert {row["reward"] for row in chosen_rows(rows, config(rewards="[sparse]"))} == {"sparse"}
    with pytest.raises(UserError, match="has no episode of the chosen methods, planners, tasks, objects and rewards"):
        chosen_rows(rows, config(table="some.parquet", tasks="[crossing]"))


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("planners=[]", "planners=[] leaves nothing to run"),
        ("methods=[]", "methods=[] leaves nothing to run"),
        ("rewards=[]", "rewards=[] leaves nothing to run"),
        ("rewards=[shaped]", "unknown rewards 'shaped': choose from dense, sparse"),
        ("tasks=[]", "tasks has none of scale=minimal"),
        ("models=nowhere", "models=nowhere holds no cavin-0.safetensors"),
        ("extends=nowhere", "nowhere is no table of episodes"),
        ("shard=3/2", "shard must be i/n"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_is_written(option: str, said: str) -> None:
    with pytest.raises(UserError, match=re.escape(said)):
        check_inputs(compose("reproduce", "scale=minimal", option))


def test_a_refused_command_leaves_its_folder_to_the_corrected_one(shell: SimpleNamespace, tmp_path: Path) -> None:
    for option in ("models=nowhere", "merge=[nowhere]", "planners=[]"):
        refused = shell.run_command("reproduce", "scale=minimal", option, "output=run", folder=tmp_path)
        assert refused.status == 2 and len(refused.complaints) == 1
        assert not (tmp_path / "run").exists()


def test_figures_and_page_come_from_a_table_alone(shell: SimpleNamespace, tmp_path: Path) -> None:
    write_table(tmp_path / "some.parquet", played())
    drawn = shell.run_command("reproduce", "table=some.parquet", "output=drawn", folder=tmp_path)
    assert drawn.status == 0, drawn.errors
    assert "python -m cavin_pyro.reproduce table=some.parquet" in (tmp_path / "drawn" / "results.md").read_text()
    (tmp_path / "some.parquet").write_bytes(b"no table")
    refused = shell.run_command("reproduce", "table=some.parquet", "output=other", folder=tmp_path)
    assert refused.status == 2 and "some.parquet is no table of episodes" in refused.complaints[0]
    absent = shell.run_command("reproduce", "table=absent.parquet", "output=other", folder=tmp_path)
    assert absent.status == 2 and "absent.parquet is no table of episodes" in absent.complaints[0]
