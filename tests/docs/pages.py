"""The documentation as a reader meets it: pages, the commands of their fenced blocks, and names in `code`."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "checkpoints" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Line:
    """One line of a block of commands, as a shell splits it; what continues after a backslash is part of it."""

    page: str
    tokens: tuple[str, ...]

    @property
    def command(self) -> str | None:
        """`plan` of `python -m cavin_pyro.plan`; None for other lines, also for modules of a subpackage."""
        is_ours = self.tokens[:2] == ("python", "-m") and re.fullmatch(r"cavin_pyro\.\w+", self.tokens[2])
        return self.tokens[2].removeprefix("cavin_pyro.") if is_ours else None

    @property
    def options(self) -> tuple[str, ...]:
        """What follows the command's name."""
        return self.tokens[3:]

    def __str__(self) -> str:
        return f"{self.page}: {shlex.join(self.tokens)}"


def name(page: Path) -> str:
    """The page's path from the repository's root."""
    return page.relative_to(ROOT).as_posix()


def commands(page: Path) -> list[Line]:
    """The lines of the blocks without a language, which are there to be pasted into a shell."""
    blocks = [block for language, block in FENCE.findall(page.read_text(encoding="utf-8")) if not language]
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    split = [tuple(shlex.split(line, comments=True)) for line in lines]
    return [Line(name(page), tokens) for tokens in split if tokens]


def code_in_prose(page: Path) -> Iterator[str]:
    """What stands between backticks, outside of blocks."""
    yield from re.findall(r"`([^`\n]+)`", FENCE.sub("", page.read_text(encoding="utf-8")))


def links(page: Path) -> Iterator[str]:
    """Where the page's links and pictures lead, other than to the web."""
    targets = re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", page.read_text(encoding="utf-8")))
    yield from (target for target in targets if not target.startswith(("http://", "https://")))
