"""Statements about the repository as a whole: what its files may say, and what import-linter cannot check."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cavin_pyro", "models", "guides", "planning", "envs")
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())

# Where the name that is imported is not the name that is installed.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "gym_pusht": "gym-pusht",
    "gymnasium_robotics": "gymnasium-robotics",
    "hydra": "hydra-core",
    "pybullet_data": "pybullet",
    "pybullet_utils": "pybullet",
    "pyro": "pyro-ppl",
    "yaml": "pyyaml",
}
MACHINE_PATH = re.compile(rb"/(?:work|tmp|root|farm|home|Users)/[A-Za-z0-9_.]")


def repository_files() -> list[Path]:
    """Every file that is tracked, or would be with the next `git add --all`."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    files = {ROOT / name for name in listing.split("\0") if name}
    return sorted(file for file in files if file.is_file())


def modules(*packages: str) -> list[Path]:
    return sorted(file for package in packages for file in (ROOT / package).rglob("*.py"))


def parse(file: Path) -> ast.Module:
    return ast.parse(file.read_text(), filename=str(file))


def place(file: Path, line: int = 1) -> str:
    return f"{file.relative_to(ROOT)}:{line}"


def imports(file: Path) -> Iterator[tuple[str, int]]:
    """Names of modules that a file imports from elsewhere, with the line of each."""
    for node in ast.walk(parse(file)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module, node.lineno


def ranges(lines: list[str]) -> list[Requirement]:
    """What lines of pyproject.toml require: a range each, with a lower bound."""
    found = [Requirement(line) for line in lines]
    assert not [str(one) for one in found if ">=" not in str(one.specifier) or "==" in str(one.specifier)]
    return found


def lock() -> dict[str, Version]:
    """Exact versions by name; anything else is an error."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    lines = [line for line in lines if line and not line.startswith("#")]
    found = [re.fullmatch(r"([a-z0-9-]+)==([0-9][0-9.]*)(; python_version (?:<|>=) '3\.12')?", line) for line in lines]
    assert all(found), [line for line, match in zip(lines, found, strict=True) if not match]
    return {match[1]: Version(match[2]) for match in found if match}


def test_one_version_is_named_everywhere() -> None:
    version = PROJECT["project"]["version"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    releases = re.findall(r"^## \[(\d[^]]*)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    package = (ROOT / "cavin_pyro" / "__init__.py").read_text()
    assert citation["version"] == version
    assert releases[0] == version
    assert re.findall(r'^__version__ = "(.*)"$', package, re.MULTILINE) == [version]


def test_every_dependency_is_locked_at_a_version_that_the_project_admits() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    optional = [one for name in ("test", "assets", "docs", "live", "maze", "pusht", "slurm") for one in extras[name]]
    locked = lock()
    for one in ranges(PROJECT["project"]["dependencies"] + optional):
        assert one.name in locked and locked[one.name] in one.specifier, str(one)


def test_every_import_of_a_third_party_is_a_dependency_of_the_project() -> None:
    # What an optional extra brings is imported only on request.
    extras = PROJECT["project"]["optional-dependencies"]
    optional = [one for name in ("assets", "live", "maze", "minari", "pusht") for one in extras[name]]
    declared = {one.name for one in ranges(PROJECT["project"]["dependencies"] + optional)}
    known = {*sys.stdlib_module_names, "cavin_pyro"}
    strangers = [
        f"{place(file, line)} imports {name}"
        for file in modules(*PACKAGES)
        for name, line in imports(file)
        if (top := name.partition(".")[0]) not in known and DISTRIBUTIONS.get(top, top) not in declared
    ]
    assert not strangers


def test_every_dependency_says_why_it_was_chosen() -> None:
    text = (ROOT / "docs" / "reference" / "dependencies.md").read_text()
    reasons = {name for row in re.findall(r"^\| ([^|]+) \|", text, re.MULTILINE) for name in row.split(", ")}
    extras = PROJECT["project"]["optional-dependencies"]
    named = ranges(PROJECT["project"]["dependencies"] + extras["test"] + extras["assets"] + extras["docs"])
    assert {one.name for one in named} <= reasons


def test_every_command_is_a_console_script_and_every_console_script_has_its_main() -> None:
    scripts = dict(target.split(":") for target in PROJECT["project"]["scripts"].values())
    home = ROOT / "cavin_pyro"
    mains = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for file in (*home.glob("*.py"), *home.glob("*/__main__.py"))  # a room may be a command too
        for node in parse(file).body
        if isinstance(node, ast.FunctionDef) and node.name == "main"
    }
    assert scripts
    assert set(scripts.values()) == {"main"}
    assert set(scripts) <= mains
    assert mains - set(scripts) == {"cavin_pyro.__main__"}  # the list of commands


def test_a_wheel_carries_every_file_that_the_packages_read() -> None:
    setuptools = PROJECT["tool"]["setuptools"]
    globs = [glob for globs in setuptools["data-files"].values() for glob in globs]
    carried = {file for glob in globs for file in ROOT.glob(glob)}
    for package, globs in setuptools["package-data"].items():
        carried |= {file for glob in globs for file in map(Path.resolve, (ROOT / package).glob(glob))}
    data = {file for file in repository_files() if file.suffix != ".py"}
    data = {file for file in data if file.relative_to(ROOT).parts[0] in {*PACKAGES, "checkpoints"}}
    data = {file for file in data if file.parent.name not in ("reproduction", "standard_prior")}  # models of figures
    assert data
    assert not [place(file) for file in sorted(data - carried)]


def test_planning_starts_without_pyro_pybullet_and_the_other_packages() -> None:
    """import-linter reads what files import; this sees what in fact was imported."""
    names = [".".join(("cavin_pyro", *file.relative_to(ROOT).with_suffix("").parts)) for file in modules("planning")]
    names = [name.removesuffix(".__init__") for name in names]
    program = f"import sys, {', '.join(names)}\nprint(*sys.modules)"
    command = [sys.executable, "-c", program]
    output = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    loaded = set(output.split())
    assert names
    assert set(names) <= loaded
    assert not loaded & {"pyro", "pybullet"}
    others = {name for name in loaded - set(names) if name.startswith("cavin_pyro.")}
    assert others <= {"cavin_pyro.models", "cavin_pyro.models.checks", "cavin_pyro.models.state"}


def make(folder: Path, *arguments: str) -> str:
    """What `make -n` would run with the repository's Makefile in another folder."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        (folder / name).write_bytes((ROOT / name).read_bytes())
    command = ["make", "-n", *arguments]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def test_make_says_what_an_installation_takes_before_it_begins(tmp_path: Path) -> None:
    lines = make(tmp_path, "demo").splitlines()
    said = next(number for number, line in enumerate(lines) if re.search(r"echo .* minutes.* GB", line))
    installs = [number for number, line in enumerate(lines) if " -m venv " in line or "pip install" in line]
    assert said < min(installs)


def test_make_installs_again_what_is_no_longer_editable(tmp_path: Path) -> None:
    packages = tmp_path / ".venv" / "lib" / "python3.11" / "site-packages"
    packages.mkdir(parents=True)
    (packages / "__editable__.cavin_pyro-0.2.0.pth").touch()
    make(tmp_path, "demo")
    (tmp_path / ".venv" / "installed").touch()
    assert "pip install" not in make(tmp_path, "demo", "-o", "pyproject.toml", "-o", "constraints.txt")
    (packages / "cavin_pyro").mkdir()
    assert "--editable" in make(tmp_path, "demo", "-o", "pyproject.toml", "-o", "constraints.txt")


def test_documented_extras_keep_the_installation_editable() -> None:
    pages = [file for file in repository_files() if file.suffix == ".md"]
    lines = re.findall(r"pip install[^`\n]*'\.\[.*", "\n".join(page.read_text() for page in pages))
    assert lines and all("--editable" in line or "--dry-run" in line for line in lines)


def test_the_site_keeps_names_of_options_whole_is_searched_from_disk_and_its_tables_have_heads() -> None:
    style = (ROOT / "docs" / "assets" / "extra.css").read_text()
    assert re.search(r"td code[^}]*\{[^}]*word-break: normal", style, re.DOTALL)
    configuration = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    assert configuration["extra_css"] == ["assets/extra.css"] and {"search", "offline"} <= {
        plugin for plugin in configuration["plugins"] if isinstance(plugin, str)
    }
    assert configuration["use_directory_urls"] is False
    headless = re.compile(r"^\|(?: *\|)+\n\| *:?---", re.MULTILINE)
    assert not [
        place(file) for file in repository_files() if file.suffix == ".md" and headless.search(file.read_text())
    ]


def test_no_file_names_a_path_of_somebodys_machine() -> None:
    found = []
    for file in repository_files():
        lines = file.read_bytes().splitlines()
        found += [place(file, number) for number, line in enumerate(lines, 1) if MACHINE_PATH.search(line)]
    assert not found


def test_tests_mirror_the_folders_and_have_names_of_their_own() -> None:
    """pytest's importlib mode wants no `__init__.py` and files that cannot be mistaken for one another."""
    files = sorted((ROOT / "tests").rglob("*.py"))
    folders = {file.relative_to(ROOT / "tests").parts[0] for file in files if file.parent != ROOT / "tests"}
    names = Counter(file.name for file in files if file.name.startswith("test_"))
    assert folders <= {*PACKAGES, "benchmarks", "notebooks", "how_to", "docs"}
    assert not [place(file) for file in files if file.name == "__init__.py"]
    assert not [name for name, count in names.items() if count > 1]
