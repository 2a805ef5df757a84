"""From overrides to a configuration, or to one line about the wrong one."""

from __future__ import annotations

import re
from itertools import chain, zip_longest
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from cavin_pyro.config.application import read_command_line
from cavin_pyro.config.commands import CHECKPOINTS, COMMANDS
from cavin_pyro.config.composition import PRESETS, compose, composed, of_sweep, presets, sweeps
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.help import EXAMPLES, FACTS_OF_PRESETS, RARE, USUAL, WIDTH, help_page, is_usual, option_entries
from cavin_pyro.config.options import flat_options
from cavin_pyro.storage.checkpoint import find_checkpoint

BROKEN_OFF = re.compile(r"(?:^|[,:;(]| (?:an?|the|of|with|and|or|to|in|by|for|which|that|when))$")
GROUPS = {  # and a command that has them
    "train": ("model", "guide", "prior", "geometry", "dynamics", "scales", "objective"),
    "plan": ("task", "planner", "env/ranges"),
    "evaluate": ("planner/optimizer",),
}
# Several groups at once, since a composition takes a while.
CHOICES = [
    (command, [f"{group}={choice}" for group, choice in zip(groups, choices, strict=True) if choice])
    for command, groups in GROUPS.items()
    for choices in zip_longest(*map(presets, groups))
]


@pytest.mark.parametrize(("command", "overrides"), CHOICES)
def test_every_preset_is_composed_and_helps_with_whole_sentences(command: str, overrides: list[str]) -> None:
    config, choices = composed(command, overrides)
    assert {f"{group}={choice}" for group, choice in choices.items()} >= {*overrides}
    for option, meaning in chain.from_iterable(option_entries(command, config, choices).values()):
        assert not BROKEN_OFF.search(meaning) or option.startswith("planner.compile="), f"{option} {meaning}"
        assert meaning.count("(") <= len(re.findall(r"[])]", meaning)) and "`" not in meaning


def test_a_path_may_have_letters_outside_of_ascii() -> None:
    config = compose("train", "output='ü\\'s'", data=["a/ü=ü", "b ü/c"])
    assert (config.data, config.output) == (["a/ü=ü", "b ü/c"], "ü's")
    assert [compose("plan", f"output={path}").output for path in ("a(b", "{x}", "a=b")] == ["a(b", "{x}", "a=b"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_lists_the_usual_options_or_every_one_with_its_meaning_and_valid_examples(command: str) -> None:
    config, choices = composed(command, [])
    usual = help_page(command, "What it does.", config, choices, everything=False)
    assert all(map(is_usual, names := re.findall(r"^  ([^-\s]\S*?)=", usual, re.MULTILINE))) and len(names) <= 25
    page = help_page(command, "What it does.", config, choices)
    assert 4 < len(names) < page.count("\n  ")
    listed = {line.strip().partition("=")[0] for line in page.splitlines() if "=" in line and line[2:3] > " "}
    hidden = {f"planner.{name}" for name in FACTS_OF_PRESETS} | {"model.prior._target_"}
    assert {
        name for name in flat_options(OmegaConf.to_container(config)) if not name.startswith("task.")
    } - listed <= hidden
    assert "None" not in page and max(map(len, page.splitlines())) <= WIDTH
    for example in EXAMPLES[command]:
        line = read_command_line(example.split())
        for overrides in sweeps(line.overrides) if line.multirun else [line.overrides]:
            compose(command, *overrides)


def test_help_names_units_defaults_choices_and_arguments_of_a_users_class(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_help.py").write_text(
        'class Wide:\n    """My layers.\n\n    Args:\n        width: width of my layers. depth: how many.\n    """\n'
    )
    monkeypatch.syspath_prepend(tmp_path)
    page = help_page("train", "", *composed("train", ["guide._target_=my_help.Wide"]))
    lines = [" ".join(line.split()) for line in page.splitlines()]
    assert "guide.width=64 width of my layers" in lines
    page = " ".join(help_page("plan", "", *composed("plan", [])).split())
    assert "env.ranges.clearance=0.15 least distance of centres at the start, in metres" in page
    assert "reward=sparse reward of the task; one of dense, sparse" in page


@pytest.mark.parametrize("command", ["plan", "train"])
def test_a_composition_leaves_nothing_behind(command: str) -> None:
    before = compose(command)
    changed = compose(command, *(["planner=paper", "planner.samples=8"] if command == "plan" else ["model=flat"]))
    assert changed != before
    with pytest.raises(UserError):
        compose(command, "seed=none")
    changed.clear()
    assert compose(command) == before


BAD = [  # overrides of `plan` unless another command is named, and what the line must say
    ("task=[crossing,clearing]", "task=[crossing,clearing]: task takes one choice, not a list"),
    ("train planner.samples=3", "unknown option 'planner.samples': it is an option of plan, evaluate; valid are"),
    ("collect env=pusht env.camera=kinect2", "unknown option 'env.camera': "),
    ("task=juggling", "unknown task 'juggling': choose from clearing, "),
    ("planner.optimizer=best", "unknown planner/optimizer 'best': choose from cem, "),
    ("planner.optimizer=my_lab.Mine", "a class of your own is planner.optimizer._target_=my_lab.Mine"),
    ("reward=medium", "unknown reward 'medium': choose from dense, sparse"),
    ("tsak=crossing", "unknown option 'tsak': did you mean task? valid are checkpoint, "),
    ("planner.sampels=3", "unknown option 'planner.sampels': did you mean samples? valid under planner are "),
    ("check device=cuda", "unknown option 'device': it is an option of pretrain, "),
    ("~task", "~task: an option cannot be removed"),
    ("hydra.run.dir=here", "hydra.run.dir=here: Hydra's folders and logs are not used here; choose output=DIR"),
    ("reproduce objects=[]", "objects must name at least one: choose from 1, 2, 3, 4, 5"),
    ("seed", "seed: missing EQUAL at '<EOF>'; write name=value, or "),
    ("seed=1,2", "seed=1,2: Ambiguous value for argument 'seed=1,2'; several values need -m: "),
    ("reward=???", "reward=???: Missing mandatory value"),
    ("reward=${nowhere}", "reward=${nowhere}: Interpolation key 'nowhere' not found"),
    ("seed=1.5", "seed=1.5: Value '1.5' of type 'float' could not be converted to Integer"),
    ("trust=os", "trust=os: trust must be a list, such as [a,b]"),
    ("planner.add={guidance:1}", "planner.add must be a list, such as [a,b]"),
    ("output=", "output= is empty: name a folder, or leave it out"),
    ("train guide=[]", "guide must be one of auto_iaf, "),
    ("train objective=[1,2]", "; choose from iwae, "),
    ("train windows.held_out_objects=[[]]", "windows.held_out_objects must be a plain list such as [a,b], not [[]]"),
    ("video=${oc.decode:'maybe'}", "'maybe' is not a valid bool"),
    (f"seed={'1' * 5000}", "value has 5000 digits"),
    ("seed=${oc.decode:'-1'}", "seed must be a whole number of at least 0 and at most 4294967295, not -1"),
    ("margin=inf", "margin in metres must be a number of at least 0 and at most 0.075, not inf"),
    ("env.robot=[stick]", "unknown env.robot ['stick']: choose from stick, "),
    ("env=maze env=pusht", "env=maze and env=pusht: choose one env"),
    ("pln seed=0", "unknown command 'pln': choose from quickstart, "),
]


@pytest.mark.parametrize(("line", "said"), BAD)
def test_a_wrong_override_is_named_in_one_line_with_what_would_be_right(line: str, said: str) -> None:
    command, *overrides = line.split() if line.split()[0] in (*COMMANDS, "pln") else ["plan", *line.split()]
    with pytest.raises(UserError) as refused:
        compose(command, "video=false", *overrides) if command == "plan" else compose(command, *overrides)
    assert said in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ("", "contact"),
        ("planner=paper", "cavin"),
        ("planner=random", "cavin"),
        ("planner=sectar planner.optimizer=cem", "sectar"),
        ("planner=sectar checkpoint=runs/mine.safetensors", "runs/mine.safetensors"),
    ],
)
def test_the_planner_brings_its_checkpoint(overrides: str, name: str) -> None:
    assert compose("plan", *overrides.split()).checkpoint == name


def test_checkpoints_have_names() -> None:
    assert find_checkpoint("kinect").is_file()
    assert find_checkpoint("runs/a.safetensors") == Path("runs/a.safetensors")
    with pytest.raises(UserError, match="^unknown checkpoint 'best': choose from cavin, "):
        find_checkpoint("best")
    for model, guide in CHECKPOINTS.values():
        compose("train", f"model={model}", f"guide={guide}")


def test_an_output_folder_says_how_a_run_differs() -> None:
    lines = {
        ("train",): "runs/train",
        ("train", "model=flat", "guide=flat", "data=a/b"): "runs/train-data=a-b,guide=flat,model=flat",
        ("train", "output=mine", "model=flat"): "mine",
        ("collect", "transitions=7", "workers=3"): "data/pushes",
        ("plan", "planner=paper", "seed=3"): "runs/plan/crossing-sparse-3-paper-3",
        ("plan", "planner.optimizer=cem"): "runs/plan/crossing-sparse-3-cavin-0-planner-optimizer=cem",
        ("reproduce", "scale=smoke"): "runs/reproduce/smoke",
    }
    assert {line: compose(*line).output for line in lines} == lines


def test_a_sweep_has_a_run_for_each_combination_named_by_what_differs() -> None:
    words = ["task=clearing,crossing", "seed=0,1", "objects=2", "output=here"]
    runs = list(sweeps(words))
    assert len(runs) == 4 and ["task=crossing", "seed=0", "objects=2", "output=here"] in runs
    assert of_sweep(words) == ({"task", "seed"}, ["hydra.sweep.dir=here"])


def test_a_class_of_the_users_takes_the_place_of_a_part() -> None:
    words = ["env.camera._target_=my_lab.Mine", "seed=3", "+env.camera.noise=0.1", "env.objects._target_=my_lab.Others"]
    config = compose("evaluate", *words, "planner._target_=my_lab.Plans", "+planner.depth=3")
    assert config.env.camera == {"_target_": "my_lab.Mine", "noise": 0.1}
    assert config.env.objects == {"_target_": "my_lab.Others"} and config.env.segmentation == "mask"
    assert (config.planner._target_, config.planner.depth, config.planner.samples) == ("my_lab.Plans", 3, 1024)


def test_presets_of_the_users_own_lie_in_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "bücher (1)" / "planner"
    folder.mkdir(parents=True)
    (folder / "mine.yaml").write_text("_target_: cavin_pyro.planning.RandomPlanner\nmodel_free: true\n")
    config, choices = composed("plan", ["planner=mine"], str(folder.parent))
    assert choices["planner"] == "mine" and config.checkpoint == "cavin"
    assert config.output == "runs/plan/crossing-sparse-3-mine-0"
    for content, said in (("[1, 2", "is not YAML: "), ("word", "must hold options, .*, not 'word'")):
        (folder / "mine.yaml").write_text(content)
        with pytest.raises(UserError, match=f"mine.yaml {said}"):
            composed("plan", ["planner=mine"], str(folder.parent))


def test_help_names_no_option_that_no_command_has() -> None:
    entries = [option_entries(name, *composed(name, [])).values() for name in COMMANDS]
    named = {option.partition("=")[0] for sections in entries for option, _ in chain.from_iterable(sections)}
    assert not (USUAL | RARE) - named


def test_every_group_of_presets_belongs_to_a_command() -> None:
    groups = {file.parent.relative_to(PRESETS).as_posix() for file in PRESETS.rglob("*.yaml")} - {"."}
    chosen = {group for name in COMMANDS for group in composed(name, [])[1]}
    assert groups <= chosen


def test_the_folder_of_a_run_has_a_name_that_a_file_system_takes() -> None:
    outputs = {compose("check", f"checkpoint=/{place}{'x' * 300}.safetensors").output for place in "ab"}
    assert len(outputs) == 2 and all(len(one.encode()) < 255 for one in outputs)
