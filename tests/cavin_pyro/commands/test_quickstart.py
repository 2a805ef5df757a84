"""From an empty folder to a planner by one command, whose steps are the other commands."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import pytest

from cavin_pyro import quickstart
from cavin_pyro.config import recipes
from cavin_pyro.config.composition import compose

TINY = (
    "model.width=8 trainer.steps=2 trainer.validate_every=1 trainer.batch_size=4 trainer.validation_windows=8 "
    "windows.validation_fraction=0.4"
)


@pytest.mark.parametrize(
    "world", ["", "env=pusht env.ahead=25", "env=maze", "env._target_=my_lab.World env.size=3 \"env.name='two words'\""]
)
def test_every_step_of_a_recipe_has_options_that_its_command_knows(world: str) -> None:
    config = compose("quickstart", *shlex.split(world), "minutes=10")
    steps = list(recipes.steps_of(config, Path("a folder")))
    assert sum(step.minutes for step in steps) == pytest.approx(10)
    for step in steps:
        found = compose(step.command, *step.options)
        assert Path(found.output).parent == Path("a folder")
        if step.command != "train":  # collection ends at no goal
            assert {**found.world, "criterion": ""} == {**config.world, "criterion": ""}


def test_one_command_makes_a_planner_and_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    collect, plan = "steps=8 env.criterion=none episodes_per_shard=5", "planner.samples=8 planner.horizon=3"
    monkeypatch.setitem(recipes.WORLDS, "pusht", recipes.Recipe(collect, TINY, plan, ((100, 200), (2, 4))))
    words = ["env=pusht", "env.ahead=25", "env.maximum_steps=2", "minutes=10", "episodes=2", f"output={tmp_path}"]
    for _ in range(2):
        monkeypatch.setattr(sys, "argv", ["quickstart.py", *words, "workers=1"])
        quickstart.main()
    said = capsys.readouterr()
    assert [line.split()[0] for line in said.out.splitlines() if " min to go: " in line] == [*"1234"] * 2
    assert (tmp_path / "episode" / "episode.mp4").exists() and (tmp_path / "evaluate" / "results.json").exists()
    assert "training: finished at step 2" in said.err  # the second time
