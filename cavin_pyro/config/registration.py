"""Registration of the commands' options with Hydra, and of presets with the defaults of their classes.

A preset has `_target_`, the class, and its differences from the class's defaults. Hydra receives both, so every option
of a part can be overridden on the command line and is in a run's `config.yaml`, and no default is written twice.
"""

from __future__ import annotations

import copy
from typing import Any

from hydra._internal.core_plugins.importlib_resources_config_source import ImportlibResourcesConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from cavin_pyro.config.commands import COMMANDS
from cavin_pyro.config.constructors import with_defaults

SCHEME = "presets"
_LOADED: dict[str, ConfigResult] = {}  # by path: they do not change while a process runs


class PresetSource(ImportlibResourcesConfigSource):
    """Reads a package's YAML files, and adds to each part the defaults of its constructor."""

    @staticmethod
    def scheme() -> str:
        """The beginning of the search path's entry."""
        return SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        """A preset by its path, such as `planner/cavin`."""
        if config_path not in _LOADED:
            result = super().load_config(config_path)
            given: Any = OmegaConf.to_container(result.config)
            result.config = OmegaConf.create(with_defaults(given, config_path.partition("/")[0]))
            _LOADED[config_path] = result
        # Hydra takes the defaults list and the package out of what it is given.
        return copy.deepcopy(_LOADED[config_path])


class PresetPath(SearchPathPlugin):
    """Puts our presets on Hydra's search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Called by Hydra for every composition."""
        search_path.append(provider="cavin_pyro", path=f"{SCHEME}://cavin_pyro.config.presets")


def register() -> None:
    """Register the commands' options and our presets with Hydra."""
    Plugins.instance().register(PresetSource)
    Plugins.instance().register(PresetPath)
    # For every composition Hydra copies all it knows, this store included, which takes a fifth of the time. It copies
    # again what it takes out of the store.
    ConfigStore.__deepcopy__ = lambda store, memo: store  # type: ignore[attr-defined]
    for name, schema in COMMANDS.items():
        ConfigStore.instance().store(name, schema, provider="cavin_pyro")
