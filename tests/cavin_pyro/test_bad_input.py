"""Bad words on the command line, one case each: one clear line, exit status 2, and nothing written."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from cavin_pyro.dataset import read_metadata, shard_path, write_metadata

# @name is a file or folder that `material` makes.
GOOD = {
    "collect": "transitions=2 steps=1 episodes_per_shard=1 workers=1",
    "pretrain": "data=@pushes steps=1 clouds=10 batch_size=2",
    "train": "data=@pushes pointnet=@checkpoint model.width=8 guide.width=8 trainer.steps=1 trainer.validate_every=1 "
    "trainer.batch_size=2 windows.minimum_move=0.001 windows.validation_fraction=0.4",
    "plan": "checkpoint=@checkpoint maximum_steps=1 video=false",
    "evaluate": "checkpoint=@checkpoint maximum_steps=1 episodes=1 workers=1",
    "check": "checkpoint=@trained data=@pushes windows=2 sections=consistency sizes.consistency.scenes=1 "
    "sizes.consistency.samples=2",
}

# (command, words added to the good ones, what the line must say)
BAD = [
    # Names: the valid ones are named.
    ("plan", "task=juggling", "unknown task 'juggling': choose from clearing, insertion, crossing"),
    ("plan", "reward=medium", "unknown reward 'medium': choose from dense, sparse"),
    ("plan", "planner=best", "unknown planner 'best': choose from cavin, cvae_mpc, mpc, random, sectar"),
    ("plan", "planner.optimizer=best", "unknown optimizer 'best': choose from shooting, cem, icem, mppi, smc"),
    ("plan", "planner=mpc planner.proposal=best", "unknown proposal 'best': take uniform or heuristic"),
    ("plan", "planner.reward_at=end", "unknown reward_at 'end': take path or subgoals"),
    ("plan", "planner.motion_horizon=long", "take full_horizon or first_segment"),
    ("plan", "layout=7", "unknown layout 7: choose 0, 1, 2 or the path of a YAML file"),
    ("plan", "env.robot=hand", "unknown env.robot 'hand': choose from stick, sawyer, panda"),
    ("plan", "env.robot=sawyer", "robot sawyer needs a folder with sawyer/sawyer_stick.urdf, and none was given: get"),
    ("plan", "env.robot=sawyer env.assets=nowhere", "needs sawyer/sawyer_stick.urdf, which is not in nowhere: get it"),
    ("plan", "env.assets=3", "env.assets must be the path of a folder, not 3"),
    ("collect", "env.robot=panda", "data are collected with env.robot=stick"),
    ("plan", "env.ranges.names=[fork]", "unknown object 'fork' in env.ranges.names: choose from sugar_box"),
    ("train", "model=nonsense", "unknown model 'nonsense': choose from cascaded"),
    ("train", "guide=nonsense", "unknown guide 'nonsense': choose from cascaded"),
    ("train", "prior=nonsense", "unknown prior 'nonsense': choose from conditional, flow, standard"),
    (
        "train",
        "objective=nonsense",
        "unknown objective 'nonsense': choose from counterfactual, iwae, mean_field_elbo, trace_elbo",
    ),
    ("train", "trainer.schedule=linear", "unknown trainer.schedule 'linear': choose from constant, cosine"),
    ("evaluate", "task=juggling", "choose from clearing, insertion, crossing"),
    ("check", "sections=[consistency,bliss]", "unknown section 'bliss': choose from "),
    ("check", "sections=[]", "sections must name at least one: choose from "),
    # Words that are not there.
    (
        "plan",
        "tsak=crossing",
        "unknown override 'tsak': did you mean task? valid are checkpoint, env, layout",
    ),
    ("plan", "planner.sampels=3", "did you mean samples? valid under planner are"),
    (
        "plan",
        "planner=random planner.samples=3",
        "unknown override 'planner.samples': valid under planner are",
    ),
    ("plan", "env.ranges.color=3", "valid under env.ranges are clearance, friction, mass, names, scale"),
    ("plan", "tiles.goals=[[1,1]]", "did you mean goal? valid under tiles are"),
    ("plan", "seed.x=3", "unknown override 'seed.x': valid are"),
    ("plan", "sum.what.else=3", "unknown override 'sum.what.else': valid are"),
    ("collect", "transition=3", "did you mean transitions?"),
    ("pretrain", "autoencoder.depth=3", "valid under autoencoder are"),
    ("train", "trainer.step=3", "did you mean steps? valid under trainer are"),
    ("evaluate", "episode=3", "did you mean episodes?"),
    ("check", "window=3", "did you mean windows?"),
    ("check", "sizes.consistency.scene=3", "did you mean scenes? valid under sizes.consistency are"),
    # Words that Hydra refuses.
    ("collect", "transitions", "'transitions': write overrides as name=value"),
    ("collect", "transitions=[1,", "write overrides as name=value"),
    ("plan", "seed=1,2", "seed=1,2"),
    ("plan", "task=???", "Missing mandatory value: task"),
    ("plan", "task=${nowhere}", "'nowhere' not found"),
    ("plan", "~task", "task cannot be taken away: give it a value as task=value"),
    ("plan", "planner=null", "write overrides as name=value"),
    ("plan", "env.ranges=3", "env.ranges must be a section, not 3"),
    # Kinds.
    ("plan", "seed=1.5", "seed must be a whole number, not 1.5"),
    ("plan", "maximum_steps=many", "maximum_steps must be a whole number, not many"),
    ("plan", "objects=two", "objects must be a whole number, not two"),
    ("plan", "planner.samples=2.5", "planner.samples must be a whole number, not 2.5"),
    ("plan", "margin=wide", "margin must be a number, not wide"),
    ("plan", "video=maybe", "video must be true or false, not maybe"),
    ("plan", "trust=os", "trust must be a list, not os"),
    ("evaluate", "episodes=1.5", "episodes must be a whole number, not 1.5"),
    ("train", "trainer.learning_rate=small", "trainer.learning_rate must be a number, not small"),
    # Numbers out of their range.
    ("plan", "objects=0", "objects must be a whole number from 1 to 5, not 0"),
    ("plan", "objects=-1", "objects must be a whole number from 1 to 5, not -1"),
    ("plan", "objects=6", "objects must be a whole number from 1 to 5, not 6"),
    ("plan", "objects=3 checkpoint=@few_objects", "knows at most 2: use objects=2"),
    ("plan", "maximum_steps=0", "maximum_steps must be at least 1, not 0"),
    ("plan", "planner.samples=0", "samples must be at least 1, not 0"),
    ("plan", "planner.samples=-3", "samples must be at least 1, not -3"),
    ("plan", "planner.horizon=0", "horizon must be at least 1, not 0"),
    ("plan", "planner.horizon=-3", "horizon must be at least 1, not -3"),
    (
        "plan",
        "planner.horizon=10",
        "horizon=10 is not divisible by the model's segment length T=3: take 9 or 12",
    ),
    ("plan", "planner=random planner.segment_length=0", "segment_length must be at least 1, not 0"),
    ("plan", "planner.stride_limits=[0.3,0.1]", "stride_limits must be two distances in metres, low then high"),
    ("plan", "planner.stride_limits=3", "stride_limits must be two distances in metres, low then high, not 3"),
    (
        "plan",
        "planner.optimizer=cem planner.optimizer_options={elite:3}",
        "unknown option 'elite' of optimizer cem: valid are iterations, elites, inertia",
    ),
    (
        "plan",
        "planner.optimizer=cem planner.optimizer_options={elites:many}",
        "optimizer cem: an option is of the wrong kind",
    ),
    ("plan", "planner.optimizer=cem planner.samples=3", "4 iterations need at least as many samples, not 3"),
    ("plan", "planner.feature_weight=-1", "feature_weight must be zero or a positive number, not -1"),
    ("plan", "planner.optimizer_options=3", "optimizer_options must be a section like"),
    ("plan", "planner.robustness.draws=0", "draws must be at least 1, not 0"),
    ("plan", "planner.robustness.start_noise=-1", "start_noise must be zero or a positive number, not -1"),
    ("plan", "planner.robustness=3", "planner.robustness must be a section, not 3"),
    ("plan", "margin=-1", "margin must be at least 0 metres, not -1"),
    ("plan", "seed=-1", "seed must be a whole number from 0 to"),
    ("plan", "seed=99999999999999", "seed must be a whole number from 0 to"),
    (
        "plan",
        "env.ranges.scale=[2,1]",
        "env.ranges.scale must be two positive numbers, low then high, not [2, 1]",
    ),
    ("plan", "env.ranges.mass=[0,1]", "env.ranges.mass must be two positive numbers"),
    ("plan", "env.ranges.clearance=-1", "env.ranges.clearance must be at least 0 metres, not -1"),
    *(
        (command, f"{word}=0", f"{word} must be at least 1, not 0")
        for command, words in {
            "collect": "transitions workers steps hold minimum_objects episodes_per_shard",
            "pretrain": "steps batch_size autoencoder.width",
            "train": "trainer.steps trainer.batch_size trainer.validate_every trainer.validation_windows "
            "trainer.patience model.segment_length model.width guide.width objective.elbo.num_particles",
            "evaluate": "episodes workers",
            "check": "windows sizes.consistency.scenes sizes.consistency.objects sizes.consistency.samples",
        }.items()
        for word in words.split()
    ),
    ("collect", "transitions=-2", "transitions must be at least 1, not -2"),
    ("pretrain", "batch_size=-2", "batch_size must be at least 1, not -2"),
    ("train", "trainer.steps=-2", "trainer.steps must be at least 1, not -2"),
    ("check", "windows=-2", "windows must be at least 1, not -2"),
    ("check", "sizes.consistency.objects=6", "sizes.consistency.objects=6, but the model knows at most 5"),
    ("check", "seed=-1", "seed must be a whole number from 0 to"),
    ("evaluate", "episodes=-2", "episodes must be at least 1, not -2"),
    ("collect", "maximum_objects=6", "maximum_objects must be between minimum_objects=1 and 5, not 6"),
    ("collect", "maximum_objects=2 minimum_objects=3", "between minimum_objects=3 and 5, not 2"),
    ("collect", "perturbed=2", "perturbed must be between 0 and 1, not 2"),
    ("collect", "seed=-1", "seed must be a whole number from 0 to"),
    ("pretrain", "seed=-1", "seed must be a whole number from 0 to"),
    ("pretrain", "clouds=1", "clouds must be at least 2, not 1"),
    ("pretrain", "learning_rate=0", "learning_rate must be a positive number, not 0"),
    ("train", "seed=-1", "seed must be a whole number from 0 to"),
    ("train", "trainer.learning_rate=0", "trainer.learning_rate must be a positive number, not 0"),
    ("train", "trainer.clip_norm=-1", "trainer.clip_norm must be a positive number, not -1"),
    ("train", "windows.validation_fraction=2", "windows.validation_fraction must be between 0 and 1, not 2"),
    ("train", "windows.quiet_fraction=-1", "windows.quiet_fraction must be between 0 and 1, not -1"),
    ("train", "windows.maximum_step=-1", "windows.maximum_step must be at least 0, not -1"),
    ("train", "windows.minimum_move=9", "no training window in which an object moved more than 9 m"),
    ("train", "windows.validation_fraction=0", "no validation window"),
    ("train", "model.segment_length=9", "6 pushes per episode, too few for windows of T=9"),
    ("train", "model.maximum_objects=3", "model.maximum_objects=3, but datasets have room for 5"),
    (
        "train",
        "model.feature_dimension=32",
        "model.feature_dimension=32, but the PointNet's features have 64",
    ),
    # Checkpoints.
    ("plan", "checkpoint=@nothing", "no checkpoint at"),
    ("plan", "checkpoint=@pushes", "no checkpoint at"),
    ("plan", "checkpoint=@truncated", "truncated is truncated or no safetensors file"),
    ("plan", "checkpoint=@beginning", "beginning is truncated or no safetensors file"),
    ("plan", "checkpoint=@noise", "noise is truncated or no safetensors file"),
    ("plan", "checkpoint=@foreign", "foreign is a safetensors file of another program"),
    ("plan", "checkpoint=@version", "has format version 7, this program reads 1"),
    ("plan", "checkpoint=@damaged_header", "has a damaged header"),
    ("plan", "checkpoint=@no_sections", "has a damaged header"),
    ("plan", "checkpoint=@no_prior", "lacks 'prior'"),
    ("plan", "checkpoint=@no_model", "holds no model: give one that train has written"),
    ("plan", "checkpoint=@no_pointnet", "holds no PointNet: give one that pretrain or train has written"),
    *(
        (
            command,
            f"checkpoint=@{name} {words}",
            f"{said}; planner=random takes any",
        )
        for command in ("plan", "evaluate")
        for name, words, said in (
            ("flat", "", "FlatModel, which has no effect_prior and no subgoal"),
            ("single_latent", "", "SingleLatentModel, which has no motion_prior"),
            (
                "dynamics",
                "",
                "DynamicsModel, which has no effect_prior and no motion_prior and no subgoal and no actions",
            ),
        )
    ),
    ("plan", "checkpoint=@width", "is of another architecture"),
    ("plan", "checkpoint=@segment_length", "is of another architecture"),
    ("plan", "checkpoint=@untrusted", "asks to run numpy.save, which is not part of this program"),
    (
        "plan",
        "checkpoint=@smuggled",
        "asks to run models.pointnet.torch.save, which is not part of this program",
    ),
    (
        "plan",
        "planner=sectar",
        "SectarPlanner needs a checkpoint of model=single_latent, but",
    ),
    ("plan", "planner=cvae_mpc", "CvaeMpcPlanner needs a checkpoint of model=flat, but"),
    ("evaluate", "checkpoint=@truncated", "truncated is truncated or no safetensors file"),
    ("check", "checkpoint=@nothing", "no checkpoint at"),
    ("check", "checkpoint=@truncated", "truncated is truncated or no safetensors file"),
    ("check", "checkpoint=@no_model", "holds no model: give one that train has written"),
    ("check", "checkpoint=@no_guide", "holds no guide: give one that train has written"),
    ("check", "checkpoint=@no_pointnet", "holds no PointNet"),
    ("check", "checkpoint=@untrusted", "asks to run numpy.save"),
    ("check", "checkpoint=@checkpoint", "does not tell which windows its training held out"),
    ("check", "checkpoint=@all_training", "no validation window in which an object moved more than"),
    ("train", "pointnet=@truncated", "truncated is truncated or no safetensors file"),
    ("train", "pointnet=@no_pointnet", "holds no PointNet"),
    # Datasets.
    ("train", "data=@nothing", "python -m cavin_pyro.collect"),
    ("pretrain", "data=@nothing", "python -m cavin_pyro.collect"),
    ("check", "data=@nothing", "python -m cavin_pyro.collect"),
    ("check", "data=@empty_data", "empty_data is empty"),
    ("check", "data=@corrupt_data", "corrupt_data/episodes-00001.h5 is missing or corrupt"),
    ("check", "data=[@pushes,@long_data]", "episodes of different length cannot be joined"),
    ("train", "data=@empty_data", "empty_data is empty"),
    ("pretrain", "data=@empty_data", "empty_data is empty"),
    ("train", "data=@old_data", "has format version 0, this program reads 1: collect it again"),
    ("train", "data=@foreign_data", "does not describe a dataset of this program"),
    ("train", "data=@damaged_data", "metadata.json is damaged"),
    ("train", "data=@corrupt_data", "corrupt_data/episodes-00001.h5 is missing or corrupt"),
    ("pretrain", "data=@corrupt_data", "corrupt_data/episodes-00001.h5 is missing or corrupt"),
    ("train", "data=@lost_data", "lost_data/episodes-00001.h5 is missing or corrupt"),
    ("train", "data=[@pushes,@long_data]", "episodes of different length cannot be joined"),
    ("train", "data=[@pushes,@nothing]", "python -m cavin_pyro.collect"),
    ("collect", "output=@old_data", "has format version 0"),
    ("collect", "output=@pushes seed=4", "holds a dataset with"),
    ("evaluate", "output=@used", "holds a run with"),
    ("train", "output=@used", "holds a run with"),
    ("check", "output=@used", "holds a run with"),
    # Layouts.
    ("plan", "layout=@nothing.yaml", "nothing.yaml cannot be read"),
    ("plan", "layout=@no_yaml.yaml", "no_yaml.yaml is not YAML"),
    ("plan", "layout=@overlapping.yaml", "tile [2, 3] is listed twice, tiles must not overlap"),
    ("plan", "layout=@off_table.yaml", "tile [5, 3] is off the table, which holds [0, 0] to [4, 6]"),
    ("plan", "layout=@off_bridge.yaml", "tile [4, 4] is off the bridge, add it to region"),
    ("plan", "layout=@no_room.yaml", "no room for 3 objects"),
    ("plan", "task=clearing layout=@off_table.yaml", "is for task crossing: run it with task=crossing"),
    ("plan", "tiles.goal=[[9,9]]", "tile [9, 9] is off the table"),
    ("plan", "tiles.goal=[[2,5]]", "tile [2, 5] is both goal and target_start"),
    ("plan", "tiles.goal=5", "goal must be a list of tiles such as [[2, 3], [2, 4]], not 5"),
    ("plan", "objects=5 env.ranges.clearance=1", "no room for 5 objects at least 1 m apart"),
    ("evaluate", "layout=@no_room.yaml", "no room for 3 objects"),
    ("collect", "env.ranges.clearance=2 minimum_objects=5", "no room for 5 objects at least 2 m apart"),
    # Places that cannot be written to; a folder below a file is refused to every user alike.
    *(
        (
            command,
            "output=@checkpoint/below",
            "cannot be written (Not a directory): choose another with output=DIR",
        )
        for command in GOOD
    ),
]


def name_of(command: str, words: str) -> str:
    return f"{command} {words}"


@pytest.fixture(scope="module")
def material(
    tmp_path_factory: pytest.TempPathFactory, pushes: Path, checkpoint_file: Path, small: SimpleNamespace
) -> Path:
    """Files and folders for the words in `GOOD` and `BAD`, most of them with something wrong."""
    folder = tmp_path_factory.mktemp("material")
    spoil_checkpoints(folder, shutil.copy(checkpoint_file, folder / "checkpoint"))
    for name in small.baselines:
        small.save_baseline(folder / name, name)
    spoil_data(folder, shutil.copytree(pushes, folder / "pushes"))
    tiles = {"target_start": "[[2, 2]]", "region": "[[2, 2], [2, 3], [2, 4]]", "goal": "[[2, 4]]"}
    layouts = {
        "overlapping": {"region": "[[2, 2], [2, 3], [2, 3], [2, 4]]"},
        "off_table": {"region": "[[2, 2], [2, 4], [5, 3]]"},
        "off_bridge": {"goal": "[[4, 4]]"},
        "no_room": {"obstacle_start": "[[2, 2]]"},
    }
    for name, wrong in layouts.items():
        content = {"task": "crossing", "obstacle_start": "[[1, 3]]", **tiles, **wrong}
        text = "".join(f"{key}: {value}\n" for key, value in content.items())
        (folder / f"{name}.yaml").write_text(text)
    (folder / "no_yaml.yaml").write_text("region: [[1, 2]")
    (folder / "used").mkdir()
    (folder / "used" / "config.yaml").write_text("seed: 17\n")
    return folder


def spoil_checkpoints(folder: Path, good: Path) -> None:
    content, tensors = good.read_bytes(), load_file(good)
    (folder / "truncated").write_bytes(content[: len(content) // 2])
    (folder / "beginning").write_bytes(content[:5])
    (folder / "noise").write_bytes(bytes(range(256)) * 20)
    with safe_open(good, framework="pt") as file:
        header = file.metadata()
    config = json.loads(header["config"])

    def save(name: str, *, without: str = "nothing", **changes: str) -> None:
        kept = {key: value for key, value in tensors.items() if not key.startswith(without)}
        save_file(kept, folder / name, metadata={**header, **changes})

    def save_model(name: str, **changes: object) -> None:
        save(name, config=json.dumps({**config, "model": {**config["model"], **changes}}))

    save_file(tensors, folder / "foreign", metadata={"format": "pt"})
    save("version", version="7")
    save("damaged_header", config="{")
    save("no_sections", config="[1]")
    save("no_prior", config=json.dumps({"model": config["model"]}))
    save("no_model", config="{}")
    windows = {"maximum_step": 0.2, "minimum_move": 0.001, "maximum_move": 0.5, "quiet_fraction": 0.25}
    trained = {**config, "seed": 0, "windows": {**windows, "validation_fraction": 0.4}}
    save("trained", config=json.dumps(trained))
    save("no_guide", without="guide", config=json.dumps(trained))
    save("all_training", config=json.dumps({**trained, "windows": {**windows, "validation_fraction": 0}}))
    save("no_pointnet", without="pointnet")
    save_model("width", width=16)
    save_model("segment_length", segment_length=5)
    save_model("few_objects", maximum_objects=2)
    save_model("untrusted", scales={"_target_": "numpy.save", "_args_": ["written.npy", 0]})
    save_model("smuggled", scales={"_target_": "models.pointnet.torch.save", "_args_": [0, "written.pt"]})


def spoil_data(folder: Path, good: Path) -> None:
    metadata = read_metadata(good)
    for name in ("empty_data", "old_data", "foreign_data", "damaged_data"):
        (folder / name).mkdir()
    write_metadata(folder / "empty_data", {**metadata, "shards": 0, "episodes": 0, "transitions": 0})
    write_metadata(folder / "old_data", {**metadata, "version": 0})
    write_metadata(folder / "foreign_data", {**metadata, "format": "photographs"})
    (folder / "damaged_data" / "metadata.json").write_text("{")
    shutil.copytree(good, folder / "long_data")
    settings = {**metadata["settings"], "steps": 9}
    write_metadata(folder / "long_data", {**metadata, "settings": settings})
    shutil.copytree(good, folder / "lost_data")
    shard_path(folder / "lost_data", 1).unlink()
    shutil.copytree(good, folder / "corrupt_data")
    shard = shard_path(folder / "corrupt_data", 1)
    content = bytearray(shard.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 8] = bytes(255 - byte for byte in content[middle : middle + 8])
    shard.write_bytes(content)


def without_features(contents: dict[str, bytes]) -> dict[str, bytes]:
    """Without what training may keep beside a dataset."""
    return {name: content for name, content in contents.items() if "/features-" not in name}


@pytest.fixture(scope="module")
def answers(shell: SimpleNamespace, material: Path, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """How every case ended, what it left in its folder, and what became of the material."""
    before = without_features(shell.contents(material))
    rows = [(command, "", "") for command in GOOD] + BAD
    cases = {}
    for command, words, _ in rows:
        line = f"output=out {GOOD[command]} {words}"
        line = re.sub(r"@([\w.]+)", lambda name: str(material / name[1]), line)
        cases[name_of(command, words)] = shell.Case(command, line.split())  # the last of several values counts
    folder = tmp_path_factory.mktemp("answers")
    ended = shell.run_in_turn(cases, folder)
    left = {name: [path for path in (folder / name).rglob("*") if path.is_file()] for name in cases}
    return SimpleNamespace(ended=ended, left=left, before=before, after=without_features(shell.contents(material)))


@pytest.mark.parametrize("command", GOOD)
def test_the_words_to_which_bad_ones_are_added_are_good(command: str, answers: SimpleNamespace) -> None:
    name = name_of(command, "")
    assert answers.ended[name].status == 0, answers.ended[name].errors
    assert answers.left[name]


@pytest.mark.parametrize(("command", "words", "said"), BAD, ids=[f"{row[0]} {row[1]}" for row in BAD])
def test_bad_input_ends_in_one_line_and_writes_nothing(
    command: str, words: str, said: str, answers: SimpleNamespace
) -> None:
    answer = answers.ended[name_of(command, words)]
    assert answer.status == 2, answer.errors
    (line,) = answer.complaints
    assert line.startswith("error: ")
    assert said in line
    assert not answers.left[name_of(command, words)]


def test_bad_input_leaves_what_it_names_as_it_was(answers: SimpleNamespace) -> None:
    assert len(answers.before) > 30
    assert answers.before == answers.after


@pytest.mark.parametrize("line", ["plan task=juggling", "collect transitions", "evaluate workers=0"])
def test_bad_input_of_a_user_at_a_terminal(line: str, shell: SimpleNamespace, tmp_path: Path) -> None:
    """The cases above share a process; these are on their own, as users are."""
    answer = shell.run_command(*line.split(), folder=tmp_path)
    assert answer.status == 2
    assert answer.errors.startswith("error: ")
    assert answer.errors.count("\n") == 1
    assert answer.output == ""
    assert not list(tmp_path.iterdir())
