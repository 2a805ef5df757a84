"""Effects of networks, data and planner are those that made-up episodes were given."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import pyarrow
import pytest
from pyarrow import parquet

from cavin_pyro.reproduction.table import SCHEMA, TABLE, write_table
from tests.benchmarks.loading import load
from tests.cavin_pyro.conftest import run_script

ROOT = Path(__file__).parents[2]
FILE = ROOT / "benchmarks" / "factors.py"


@pytest.fixture(scope="module")
def factors() -> Any:
    return load("factors")


def row(method: str, planner: str, objects: int, training_seed: int, scene: int, solved: bool) -> dict[str, Any]:
    values = dict.fromkeys(SCHEMA.names, 0)
    outcomes = {f"{name}_outcome": "success" if solved else "timeout" for name in ("strict", "published")}
    where = {"task": "crossing", "reward": "sparse", "objects": objects, "seed": scene}
    where |= {f"{name}_steps": 10 if solved else 7 for name in ("strict", "published")}
    return {**values, **where, **outcomes, "method": method, "planner": planner, "training_seed": training_seed}


def episodes(data: str) -> list[dict[str, Any]]:
    """`contact` solves 20 of 30 scenes more than `cavin`, `ours` 5 more than `paper`, and more data none."""
    found = []
    ways = product(("cavin", "contact"), ("paper", "ours"), (3, 5), (0, 1, 2), range(10))
    for method, planner, objects, training_seed, place in ways:
        number = 10 * training_seed + place
        solved = number % 6 < 4 * (method == "contact") + (planner == "ours")
        found.append(row(method, planner, objects, training_seed, 1000 * training_seed + place, solved))
    return found


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("factors")
    for name in ("few", "many"):
        (folder / name).mkdir()
        write_table(folder / name / TABLE, episodes(name))
    return folder / "together.parquet"


@pytest.mark.soak
def test_the_factor_that_matters_is_named_and_the_one_that_does_not_is_zero(table: Path) -> None:
    given = (f"{name}={table.parent / name}" for name in ("few", "many"))
    ended = run_script(FILE, str(table), "--collect", *given, folder=ROOT)
    assert ended.status == 0, ended.errors
    assert "| contact | few | paper | 66.7 %" in ended.output and "| cavin | many | paper | 0.0 %" in ended.output
    assert "| cavin | many | paper | 0.0 % (0.0 to 11.4) | 60.0 |" in ended.output  # failures take all pushes
    networks = next(line for line in ended.output.splitlines() if line.startswith("| networks, `contact`"))
    assert "+66.7 (" in networks and "0, 20 (4.6e-05)" in networks  # 24 * 2 / 2^20
    assert "| -33.3 (" in networks  # two thirds of the scenes: 10 pushes instead of 60
    data = next(line for line in ended.output.splitlines() if line.startswith("| data, `many` instead of `few`"))
    assert "+0.0 (+0.0 to +0.0)" in data and "0, 0 (1)" in data


def test_trainings_are_resampled_not_only_scenes(factors: Any) -> None:
    scenes = [(training, scene) for training in range(3) for scene in range(40)]
    never = dict.fromkeys(scenes, False)
    one_training = {scene: scene[0] == 0 for scene in scenes}
    mean, low, high = factors.effect([(never, one_training)])
    assert mean == pytest.approx(1 / 3) and low == 0.0 and high == 1.0  # no training but the first gains
    half = {scene: scene[1] % 2 == 0 for scene in scenes}
    mean, low, high = factors.effect([(never, half)])
    assert mean == 0.5 and 0.38 < low < 0.45 and 0.55 < high < 0.62


@pytest.mark.soak
def test_a_way_without_all_scenes_is_refused(table: Path, tmp_path: Path) -> None:
    rows = [{**one, "data": name} for name in ("few", "many") for one in episodes(name)]
    schema = SCHEMA.append(pyarrow.field("data", pyarrow.string()))
    parquet.write_table(pyarrow.Table.from_pylist(rows[1:], schema=schema), tmp_path / "short.parquet")
    ended = run_script(FILE, str(tmp_path / "short.parquet"), folder=ROOT)
    assert ended.status != 0 and "must have eight ways" in ended.errors


def test_what_is_no_table_is_named_in_one_line(tmp_path: Path) -> None:
    write_table(tmp_path / TABLE, episodes("few"))  # without a name of its data
    for path in (tmp_path / TABLE, tmp_path / "nowhere.parquet"):
        ended = run_script(FILE, str(path), folder=ROOT)
        assert ended.status != 0 and ended.errors.count("\n") == 1 and "is no table of --collect" in ended.errors
