"""What the documentation names is there: files, classes and functions, options, links."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.composition import compose
from cavin_pyro.planning.optimizers import OPTIMIZERS
from tests.docs.pages import PAGES, ROOT, code_in_prose, links, name
from tests.test_repository import PACKAGES

FOLDERS = (*PACKAGES, "tests", "benchmarks", "checkpoints", "docs", "notebooks")
COMMANDS = ("check", "collect", "evaluate", "imagine", "plan", "pretrain", "quickstart", "reproduce", "train")
PLANNERS = ("cavin", "cavin_without_effects", "sectar", "cvae_mpc", "mpc", "random")
GROUPS = {"env/ranges", "model", "guide", "prior", "objective", "scales", "planner"}
TOO_GENERAL = re.compile(r"NAME|TASK_N|\*")
ALL = [pytest.param(page, id=name(page)) for page in PAGES]


def keys(config: DictConfig, prefix: str = "") -> set[str]:
    """The dotted names of all options of a configuration."""
    found = set()
    for key in config:
        found.add(f"{prefix}{key}")
        value = None if OmegaConf.is_missing(config, key) else config[key]
        if isinstance(value, DictConfig):
            found |= keys(value, f"{prefix}{key}.")
    return found


@pytest.fixture(scope="module")
def options() -> set[str]:
    """Every option of any command, with any planner, any optimizer and any model."""
    found = set().union(*(keys(compose(command)) for command in COMMANDS))
    found |= set().union(*(keys(compose("plan", f"planner={planner}")) for planner in PLANNERS))
    found |= set().union(*(keys(compose("plan", f"planner.optimizer={optimizer}")) for optimizer in OPTIMIZERS))
    found |= keys(compose("plan", "task=rearrange"))
    found |= keys(compose("train", "model=single_latent", "guide=single_latent", "objective=iwae"))
    found |= keys(compose("train", "dynamics=contact"))
    found |= {f"env.{name}" for world in ("pusht", "maze") for name in compose("plan", f"env={world}").world}
    return found | GROUPS


@pytest.mark.parametrize("page", ALL)
def test_files_that_the_page_names_are_there(page: Path) -> None:
    named = {code.rstrip("/") for code in code_in_prose(page) if code.partition("/")[0] in FOLDERS and "/" in code}
    files = {code for code in named if re.fullmatch(r"[\w./-]+", code) and not TOO_GENERAL.search(code)}
    assert not [code for code in sorted(files) if not (ROOT / code).exists()]


@pytest.mark.parametrize("page", ALL)
def test_classes_and_functions_that_the_page_names_are_there(page: Path) -> None:
    missing = []
    for code in code_in_prose(page):
        if not re.fullmatch(r"cavin_pyro(\.\w+)+", code):
            continue
        parts = code.split(".")
        for length in range(len(parts), 0, -1):
            try:
                thing = importlib.import_module(".".join(parts[:length]))
            except ModuleNotFoundError:
                continue
            for part in parts[length:]:
                thing = getattr(thing, part, None)
            missing += [] if thing is not None else [code]
            break
        else:
            missing.append(code)
    assert not missing


@pytest.mark.parametrize("page", ALL)
def test_options_that_the_page_names_exist(page: Path, options: set[str]) -> None:
    named = set()
    for code in code_in_prose(page):
        tokens = code.split()
        tokens = tokens[3:] if tokens[:2] == ["python", "-m"] else tokens
        tokens = [] if "(" in code else tokens  # Python
        for token in tokens:
            if match := re.fullmatch(r"'?([a-z_/]+(?:\.[a-z_]+)*\.?)=.*", token):
                named.add(match[1])
            elif re.fullmatch(r"(env|planner|windows|trainer|objective|model|guide|sizes)(\.[a-z_]+)+", token):
                named.add(token)
    named = {one for one in named if not one.endswith("._target_")}
    assert not sorted(named - options - {"name"})  # `name=value`


@pytest.mark.parametrize("page", ALL)
def test_links_of_the_page_lead_somewhere(page: Path) -> None:
    """`make docs` checks anchors, too; this sees the pages that are not part of the site."""
    targets = {target.partition("#")[0] for target in links(page)} - {""}
    generated = {ROOT / "docs" / "reference" / name for name in ("api/index.md", "commands.md")}
    found = {target: (page.parent / target).resolve() for target in targets}
    assert not [target for target, path in sorted(found.items()) if not path.exists() and path not in generated]


def test_every_picture_is_shown_on_a_page() -> None:
    shown = {(page.parent / target).resolve() for page in PAGES for target in links(page)}
    pictures = {*(ROOT / "docs" / "pictures").iterdir(), *(ROOT / "checkpoints").glob("*.png")}
    assert not sorted(pictures - shown)
