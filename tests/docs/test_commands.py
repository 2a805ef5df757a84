"""Every command and every block of Python in README and documentation runs, in the order of its page.

A page is a test with a folder of its own. Options that make a command small are added to it. A page that uses data or
a model which none of its commands makes gets those of TRAINING. A block of Python that begins with a
file's name is written to that file (`continued` adds to it), as is one of YAML; the others run as one script after the
page's commands. What does not run is in NOT_RUN, with its reason.
"""

from __future__ import annotations

import functools
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cavin_pyro.conftest import Case, run_in_turn, run_script
from tests.docs.pages import FENCE, PAGES, ROOT, Line, commands, name

EPISODES = "maximum_steps=2 planner.samples=16"
SMALL = {  # options that make each command a matter of a second
    "collect": "transitions=30 seed=6 steps=6 episodes_per_shard=2 workers=1",
    "pretrain": "steps=2 batch_size=4 clouds=40",
    "train": "model.width=8 trainer.steps=2 trainer.validate_every=1 trainer.batch_size=4 trainer.validation_windows=8 "
    "windows.minimum_move=0.001 windows.validation_fraction=0.4",
    "plan": f"{EPISODES} video=false",
    "imagine": "effects=1 motions=1",
    "evaluate": f"{EPISODES} episodes=2 workers=1",
    "check": "windows=2 sections=[elbo]",
    "reproduce": "",
}
OTHER_WORLD = r"env\._target_=|data/pendulum|pusht"  # which refuses options of the tabletop
NOT_RUN = {  # a part of a command, and why it does not run here
    "make ": "installs and tests everything",
    "source ": "of the shell",
    " -m pip ": "needs the network",
    "cavin_pyro.assets": "needs the network; tests/cavin_pyro/fetching runs it on small archives",
    "env.assets=": "needs files from publishers",
    "viewer=live": "runs until Ctrl-C; tests/cavin_pyro/visualization runs it",
    "maze": "needs an extra; tests/envs runs it",
    "cavin_pyro.quickstart": "takes minutes; tests/cavin_pyro/commands runs it",
    "cavin_pyro.data export": "needs an extra; tests/cavin_pyro/data runs it",
    "cavin_pyro.data import": "needs an extra; tests/cavin_pyro/data runs it",
    "reproduce scale=": "trains for minutes; tests/cavin_pyro/reproduction runs it on tiny models",
    "rsync ": "of the shell",
    "mkdir ": "of the shell",
}
MADE = ("runs/train", "runs/pretrain", "data/pushes")  # by TRAINING
TRAINING = ROOT / "docs" / "how-to" / "collect-and-train.md"
SHORTER = {  # in blocks of Python
    "episodes=20, workers=1": 'episodes=1, workers=1, maximum_steps=1, **{"planner.samples": 8}',
    "steps=2000": "steps=2, batch_size=8",
    "samples=1024": "samples=16",
    "objects=3)": "objects=3, maximum_steps=2)",
    "num_samples=500": "num_samples=20",
    "num_samples=50)": "num_samples=5)",
    "num_samples=5, warmup_steps=5": "num_samples=1, warmup_steps=1",
    'compose("check", "data=data/pushes")': 'compose("check", "data=data/pushes", "windows=8")',
}
FILE = re.compile(r"# (\w+\.(?:py|yaml))\b(, continued)?")


def reason(line: Line) -> str | None:
    """Why a command does not run."""
    return next((why for part, why in NOT_RUN.items() if part in " ".join(line.tokens)), None)


def small(line: Line) -> Case:
    """A command with the options that make it small."""
    if line.command in ("data", "compare"):
        return Case({"data": "data.__main__"}.get(line.command, line.command), line.options)
    assert line.command is not None, line
    more = SMALL[line.command].split()
    options = [option.replace("runs/quickstart/pushes-20-0/data", "data/pushes") for option in line.options]
    given = {option.partition("=")[0] for option in options}
    more = [option for option in more if not (option.startswith("seed=") and "seed" in given)]
    if "planner=random" in line.options:
        more.remove("planner.samples=16")
    if re.search(OTHER_WORLD, " ".join(line.tokens)):
        more = [option for option in more if not option.startswith(("maximum_steps=", "windows.minimum_move="))]
    more += ["device=cpu"] if "device=cuda" in line.options else []
    more += ["planner.compile=false"] if "planner.compile=true" in line.options else []
    return Case(line.command, [*options, *more])


def runnable(page: Path) -> list[Line]:
    """The page's commands that run, each once."""
    return [*{line.tokens: line for line in commands(page) if reason(line) is None}.values()]


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Language and text of the blocks of Python and YAML."""
    found = FENCE.findall(page.read_text(encoding="utf-8"))
    yield from ((language, text) for language, text in found if language in ("python", "yaml"))


def write_files(page: Path, folder: Path) -> list[str]:
    """Write the page's named files; returns its other blocks of Python, shorter, and the scripts among the files."""
    others = []
    for language, text in blocks(page):
        if match := FILE.match(text):
            with open(folder / match[1], "a" if match[2] else "w", encoding="utf-8") as file:
                file.write(text)
            others += [f"import runpy; runpy.run_path({match[1]!r})\n"] if match[1] == "use_it.py" else []
        elif language == "python":
            others.append(text)
    script = "".join(others)
    for long, short in SHORTER.items():
        script = script.replace(long, short)
    return [script] if script else []


def run(lines: list[Line], folder: Path) -> None:
    """Run commands in one process; pictures are not drawn, which would take longer than all else."""
    cases = {f"{number}/..": small(line) for number, line in enumerate(lines)}
    answers = run_in_turn(cases, folder, pictures="blank")
    for line, answer in zip(lines, answers.values(), strict=True):
        assert answer.status == 0, f"{line}\n{answer.errors}"


@functools.cache
def trained(parent: Path) -> Path:
    """A folder in which the commands that make data and models have run."""
    folder = new_folder(parent / "made")
    run([line for line in runnable(TRAINING) if any(f"output={made}" in line.options for made in MADE)], folder)
    return folder


def new_folder(folder: Path) -> Path:
    folder.mkdir()
    for shared in ("docs", "checkpoints"):
        (folder / shared).symlink_to(ROOT / shared)
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if runnable(page) or list(blocks(page))], ids=name)
def test_the_page_runs(page: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    done = trained(tmp_path_factory.getbasetemp())
    folder, text = new_folder(tmp_path_factory.mktemp("page") / "of"), page.read_text(encoding="utf-8")
    known = set() if page == TRAINING else {line.tokens for line in runnable(TRAINING)}
    lines = [line for line in runnable(page) if line.tokens not in known]
    made_here = {option for line in lines for option in line.options}
    for made in MADE:
        if (made in text or page.name == "README.md") and f"output={made}" not in made_here:
            shutil.copytree(done / made, folder / made)
    scripts = write_files(page, folder)
    if lines:
        run(lines, folder)
    if "import minari" in text:  # it reads what `data export` writes
        return
    for script in scripts:
        (folder / "blocks.py").write_text(f"if __name__ == '__main__':\n{_indented(script)}", encoding="utf-8")
        ended = run_script(folder / "blocks.py", folder=folder)
        assert ended.status == 0, ended.errors


def _indented(script: str) -> str:
    return "".join(f"    {line}\n" if line else "\n" for line in script.splitlines())
