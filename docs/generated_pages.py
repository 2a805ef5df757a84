"""A hook of MkDocs that writes pages at build time.

The API reference has a page for each folder of the five packages, from the docstrings. The reference of the commands
lists every option as its configuration declares it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("cavin_pyro", "models", "guides", "planning", "envs")
FOLDER = "reference/api"

sys.path.insert(0, str(ROOT))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page per folder, which lists the folder's modules, an index of all folders, and the commands' options."""
    folders = [folder for package in PACKAGES for folder in _folders(ROOT / package)]
    for folder in folders:
        files.append(File.generated(config, f"{FOLDER}/{_name(folder)}.md", content=_page(folder)))
    files.append(File.generated(config, f"{FOLDER}/index.md", content=_index(folders)))
    files.append(File.generated(config, "reference/commands.md", content=_commands()))
    return files


def _commands() -> str:
    from cavin_pyro.config.commands import COMMANDS

    lines = [
        "# Commands",
        "",
        "Options are given as `name=value`. `--help=all` lists those of a command with its presets, too.",
    ]
    for name, schema in COMMANDS.items():
        lines += ["", f"## {name}", "", f"`python -m cavin_pyro.{name} ...`", ""]
        lines += ["| option | default | meaning |", "| --- | --- | --- |"]
        lines += _rows(schema)
    return "\n".join(lines) + "\n"


def _rows(schema: type) -> list[str]:
    from cavin_pyro.config.options import options, shown

    rows = []
    for one in options(schema):
        unit = f", in {one.about.unit}" if one.about.unit else ""
        choices = f"; one of {', '.join(one.about.names)}" if one.about.names else ""
        default = shown(one.default)
        if default.startswith("${"):  # it follows another option; the meaning says which
            default = "..."
        meaning = f"{one.about.help}{unit}{choices}".replace("|", "\\|")
        rows.append(f"| `{one.name}` | `{default}` | {meaning} |")
    return rows


def _folders(package: Path) -> list[Path]:
    return sorted(file.parent for file in package.rglob("__init__.py"))


def _modules(folder: Path) -> list[Path]:
    return sorted(file for file in folder.glob("*.py") if file.stem != "__init__")


def _name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts if parts[0] == "cavin_pyro" else ("cavin_pyro", *parts))


def _page(folder: Path) -> str:
    blocks = [f"# {_name(folder)}"]
    blocks += [f"::: {_name(path)}" for path in [folder, *_modules(folder)]]
    return "\n\n".join(blocks) + "\n"


def _index(folders: list[Path]) -> str:
    lines = [
        "# API reference",
        "",
        "One page per folder, made from the docstrings.",
        "",
        "| folder | modules |",
        "| --- | --- |",
    ]
    for folder in folders:
        names = ", ".join(f"`{file.stem}`" for file in _modules(folder)) or "-"
        lines.append(f"| [{_name(folder)}]({_name(folder)}.md) | {names} |")
    return "\n".join(lines) + "\n"
