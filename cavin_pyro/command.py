"""What all commands share: Hydra for the words, one line for bad input, exit status 2.

@command("plan")
def main(config: DictConfig) -> None: ...
"""

from __future__ import annotations

import difflib
import errno
import importlib.util
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cavin_pyro.errors import UserError

CONFIGURATION = "pkg://cavin_pyro.conf"
PACKAGES = ("models", "guides", "planning", "envs")
BAD_INPUT = 2  # exit status
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EFBIG, errno.EIO}
_KINDS = {bool: "true or false", int: "a whole number", float: "a number", list: "a list", dict: "a section"}
_OF_ANY_KIND = {"layout"}  # a number or a path
_CAN_BE_LEFT_OUT = {"robustness", "pushes_per_plan"}  # which null switches off

Body = Callable[[DictConfig], None]


def command(name: str) -> Callable[[Body], Callable[[], None]]:
    """Make a Hydra application of `body`, configured by `conf/<name>.yaml`."""

    def decorate(body: Body) -> Callable[[], None]:
        def main() -> None:
            # Third parties' deprecations are for developers, whose tests turn them into errors.
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            guarded(lambda: _check_words(name, [word for word in sys.argv[1:] if not word.startswith("-")]))
            hydra.main(version_base="1.3", config_path=CONFIGURATION, config_name=name)(
                lambda config: guarded(lambda: _run(body, config))
            )()

        main.__doc__ = body.__doc__
        return main

    return decorate


def guarded(action: Callable[[], None]) -> None:
    """Run; bad input, a full or forbidden disk and an interruption end in one line instead of a traceback."""
    try:
        action()
    except UserError as error:
        _stop(str(error), BAD_INPUT)
    except OSError as error:
        if error.errno not in _DISK_ERRORS:
            raise
        where = f" at {error.filename}" if error.filename else ""
        _stop(
            f"the disk refused to store results{where}: {error.strerror}; free some space or choose output=DIR",
            2,
        )
    except KeyboardInterrupt:
        _stop("interrupted; where the command can resume, the same command goes on", 130)


def _stop(line: str, status: int) -> None:
    print(f"error: {' '.join(line.split())}", file=sys.stderr, flush=True)
    raise SystemExit(status)


def compose(name: str, *words: str) -> DictConfig:
    """The configuration of `python -m cavin_pyro.<name> <words>`, for those who call the library from Python.

    Raises:
        UserError: a word that the command line would refuse.
    """
    _check_words(name, list(words))
    with hydra.initialize_config_module("cavin_pyro.conf", version_base="1.3"):
        config = hydra.compose(name, overrides=list(words), return_hydra_config=True)
    hydra_config = HydraConfig.instance()
    before = hydra_config.cfg
    try:
        hydra_config.set_config(config)  # as within a command: the default output names the planner that was chosen
        return _resolved(OmegaConf.masked_copy(config, [str(name) for name in config if name != "hydra"]))
    finally:
        hydra_config.cfg = before


def _run(body: Body, config: DictConfig) -> None:
    check_packages()
    body(_resolved(config))


def _resolved(config: DictConfig) -> DictConfig:
    try:
        # Plain, because Hydra's own interpolations mean nothing in a worker process.
        plain = OmegaConf.create(OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except OmegaConfBaseException as error:
        raise UserError(f"a word has no value: {str(error).splitlines()[0]}") from error
    assert isinstance(plain, DictConfig)
    return plain


def check_packages() -> None:
    """Make sure that the packages with common names are ours.

    Raises:
        UserError: a foreign package of the same name comes first on the path.
    """
    home = Path(__file__).resolve().parent.parent
    for package in PACKAGES:
        found = importlib.util.find_spec(package)
        places = [] if found is None else list(found.submodule_search_locations or [found.origin or ""])
        if not any(Path(place).resolve() == home / package for place in places):
            where = places[0] if places else "nowhere"
            raise UserError(
                f"the package {package!r} of this program is hidden by {where}: "
                "run from another folder, or rename or uninstall that package"
            )


def _check_words(name: str, overrides: list[str]) -> None:
    """Compose the configuration before Hydra's own application does, to explain what is wrong in one line."""
    with hydra.initialize_config_module("cavin_pyro.conf", version_base="1.3"):
        try:
            config = hydra.compose(name, overrides=overrides, return_hydra_config=True)
            _check_kinds(_plain(_defaults(name, overrides, config)), _plain(config))
        except MissingConfigException as error:
            raise UserError(_explain_choice(error)) from error
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            raise UserError(_explain_override(name, overrides, error)) from error
        finally:
            GlobalHydra.instance().clear()


def _defaults(name: str, overrides: list[str], config: DictConfig) -> DictConfig:
    """The configuration with the parts that the user chose and no other words; config tells which are parts."""
    groups = config.hydra.runtime.choices
    return hydra.compose(name, overrides=[word for word in overrides if word.partition("=")[0] in groups])


def _plain(config: DictConfig) -> dict[str, Any]:
    plain = OmegaConf.to_container(config, resolve=False)
    assert isinstance(plain, dict)
    return {str(name): value for name, value in plain.items()}


def _check_kinds(defaults: dict[str, Any], config: dict[str, Any], prefix: str = "") -> None:
    """Every value must be of its default's kind; whole numbers will do for numbers, and null defaults tell nothing."""
    for name, default in defaults.items():
        if name not in config:
            raise UserError(f"{prefix}{name} cannot be taken away: give it a value as {prefix}{name}=value")
        value = config[name]
        kind = _KINDS.get(type(default))
        interpolated = isinstance(value, str) and value.startswith("${")
        left_out = value is None and name in _CAN_BE_LEFT_OUT
        if kind is None or name in _OF_ANY_KIND or interpolated or left_out:
            continue
        if type(value) is not type(default) and not (kind == "a number" and type(value) is int):
            raise UserError(f"{prefix}{name} must be {kind}, not {value}")
        if isinstance(default, dict):
            _check_kinds(default, value, f"{prefix}{name}.")


def _explain_choice(error: MissingConfigException) -> str:
    group, _, choice = (error.missing_cfg_file or "").rpartition("/")
    options = ", ".join(error.options or ()) or "none"
    return f"unknown {group or 'configuration'} {choice!r}: choose from {options}"


def _explain_override(name: str, overrides: list[str], error: Exception) -> str:
    try:
        known = _defaults(name, overrides, hydra.compose(name, return_hydra_config=True))
    except (HydraException, ValueError):
        known = hydra.compose(name)
    for override in OverridesParser.create().parse_overrides(_parsable(overrides)):
        key = override.key_or_group
        if override.package or key.startswith("hydra") or override.type is not OverrideType.CHANGE or "@" in key:
            continue
        parent, _, last = key.rpartition(".")
        if last.startswith("_") or last in _words(known, parent):
            continue
        close = difflib.get_close_matches(last, _words(known, parent), n=1)
        while parent and not _words(known, parent):
            parent = parent.rpartition(".")[0]
        valid = f"valid{' under ' if parent else ''}{parent} are {', '.join(_words(known, parent))}"
        return f"unknown override {key!r}: {f'did you mean {close[0]}? ' if close else ''}{valid}"
    first = str(error).splitlines()[0].rstrip(".")
    return f"{first}: write overrides as name=value"


def _parsable(overrides: list[str]) -> list[str]:
    kept = []
    for word in overrides:
        try:
            OverridesParser.create().parse_override(word)
        except HydraException:
            continue
        kept.append(word)
    return kept


def _words(known: DictConfig, section: str) -> list[str]:
    """The words of a section, none if there is no such section."""
    found: Any = OmegaConf.select(known, section) if section else known
    return sorted(map(str, found)) if OmegaConf.is_dict(found) else []
