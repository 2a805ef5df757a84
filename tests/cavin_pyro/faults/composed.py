"""Configurations composed once for all forks of a process: composing takes up to half of a small command's time."""

from __future__ import annotations

import json
import os

from omegaconf import DictConfig

from cavin_pyro.config import composition


class Composed:
    """Remembers what forks have composed, so that later forks begin with it: composing only reads."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, ...], DictConfig] = {}
        self._asked, self._asking = os.pipe()  # lines of JSON from forks: the command and its overrides
        os.set_blocking(self._asked, False)
        self._compose = composition.check_overrides

    def use(self) -> None:
        """Let this fork take what is remembered. What is not it composes itself, and tells."""
        composition.check_overrides = self._recall

    def learn(self) -> None:
        """Compose what forks have asked for, in the process that forks."""
        try:
            lines = os.read(self._asked, 2**16).decode().splitlines()
        except BlockingIOError:
            return
        for key in {tuple(json.loads(line)) for line in lines} - set(self._kept):
            self._kept[key] = self._compose(key[0], list(key[1:]))

    def _recall(self, name: str, overrides: list[str], config_dir: str | None = None) -> DictConfig:
        key = name, *overrides
        if config_dir is None and key in self._kept:
            return self._kept.pop(key)  # once, because the caller may change it; other forks have their own
        if config_dir is None:
            os.write(self._asking, f"{json.dumps(key)}\n".encode())
        return self._compose(name, overrides, config_dir)
