"""Checkpoints that somebody made or changed on purpose: nothing in them runs, and each gets one line."""

from __future__ import annotations

import copy
import functools
import json
import random
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.storage.checkpoint import load

Rewrite = Callable[[dict[str, Any]], Path]
MODULE = """
import torch
from cavin_pyro.models.priors.standard import StandardPrior
from my_parts.inner import Inner

class Own(StandardPrior):
    pass

def function(**given):
    raise AssertionError("a function ran")
"""


@pytest.fixture
def rewritten(checkpoint_file: Path, tmp_path: Path) -> Rewrite:
    """A checkpoint whose header holds another configuration."""

    def rewrite(config: dict[str, Any]) -> Path:
        header = {"format": "cavin_pyro checkpoint", "version": "1", "config": json.dumps(config), "provenance": "{}"}
        save_file(load_file(checkpoint_file), tmp_path / "rewritten.safetensors", metadata=header)
        return tmp_path / "rewritten.safetensors"

    return rewrite


@pytest.fixture
def naming(small: SimpleNamespace, rewritten: Rewrite) -> Callable[[str], Path]:
    """A checkpoint whose prior has another `_target_`."""
    return lambda target: rewritten({**small.config(), "prior": {"_target_": target}})


def test_classes_by_the_names_that_they_had_before_are_found(small: SimpleNamespace, rewritten: Rewrite) -> None:
    config = small.config()
    before = json.dumps(config).replace("cavin_pyro.models.", "models.").replace("cavin_pyro.guides.", "guides.")
    assert '"models.' in before
    assert load(rewritten(json.loads(before))).config == config


@pytest.mark.parametrize(
    "target",
    [
        "builtins.exec",
        "cavin_pyro.models.networks.pointnet.torch.save",  # what our modules import is not ours
        "cavin_pyro.models.cascaded",
        "cavin_pyro.models.networks.pointnet.chamfer_distance",
        "cavin_pyro.models.nothing.Nothing",
        "modelsandmore.Trojan",
        "",
    ],
)
def test_a_checkpoint_may_name_classes_of_this_program_only(
    target: str, small: SimpleNamespace, rewritten: Rewrite
) -> None:
    never_built = {**small.config(), "objective": {"_target_": target}}
    assert load(rewritten(never_built)).config == never_built
    for section in ("model", "prior", "guide"):
        for where in ({"_target_": target}, {"scales": {"_target_": target}}, {"list": [{"_target_": target}]}):
            config = small.config()
            config[section] |= where
            with pytest.raises(UserError, match=r"asks to run .*, which is not part of this program"):
                load(rewritten(config))


def test_a_trusted_package_is_trusted_for_its_own_classes_and_not_for_what_it_imports(
    naming: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "my_parts"
    folder.mkdir()
    (folder / "__init__.py").write_text(MODULE)
    (folder / "inner.py").write_text(
        "from cavin_pyro.models.priors.standard import StandardPrior\nclass Inner(StandardPrior): 0"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match=r"pass 'trust=\[my_parts\]'"):
        load(naming("my_parts.Own"))
    assert "my_parts" not in sys.modules  # not even imported
    with pytest.raises(UserError, match=r"^trust must be of type Sequence.str., not 'my_parts'$"):
        load(naming("my_parts.Own"), trust="my_parts")
    for name in ("Own", "Inner", "inner.Inner"):
        model = build_model(load(naming(f"my_parts.{name}"), trust=["my_parts"]).config)
        assert type(model.prior_of_effects).__name__ == name.rpartition(".")[2]
    for name in ("torch.load", "torch.nn.Linear", "function", "Gone"):
        with pytest.raises(UserError, match=r"trust=\[my_parts\] allows the classes that are defined there") as refused:
            load(naming(f"my_parts.{name}"), trust=["my_parts"])
        assert f"my_parts.{name} is none of them" in str(refused.value)


DEEP: dict[str, Any] = functools.reduce(lambda inner, _: {"more": inner}, range(50), {})


@pytest.mark.parametrize(
    ("section", "name", "value", "said"),
    [
        ("model", "more", "${oc.create:{_target_:numpy.save,_args_:[written,3]}}", "has an interpolation"),
        ("model", "more", {"${oc.env:HOME}": 1}, "has an interpolation in its configuration, which is refused"),
        ("model", "more", DEEP, "over 20 levels deep"),
        ("guide", "width", 30_000, r"guide\.width=30000, but no layer in it has more than \d+ units"),  # 3.6 gigabytes
        *(("prior", name, [0], f"has {name} in its") for name in ("_args_", "_recursive_", "_convert_")),
        ("prior", "_target_", 5, "asks to run"),
        ("prior", "_target_", ["os.system"], "asks to run"),
        ("prior", "_target_", "os.system", "not part of this program$"),  # nobody is told to trust Python's modules
    ],
)
def test_a_stored_configuration_that_could_do_harm_is_refused_before_anything_is_built(
    section: str, name: str, value: Any, said: str, small: SimpleNamespace, rewritten: Rewrite
) -> None:
    config = small.config()
    config[section][name] = value
    with pytest.raises(UserError, match=said):
        load(rewritten(config))


def with_nan(tensors: dict[str, Tensor]) -> None:
    tensors[sorted(tensors)[0]].view(-1)[0] = torch.nan


def integers(tensors: dict[str, Tensor]) -> None:
    name = next(name for name in sorted(tensors) if name.startswith("model."))
    tensors[name] = tensors[name].int()


def spoilt(path: Path, folder: Path, change: Callable[[dict[str, Tensor]], None], *, keep_digest: bool) -> Path:
    """A copy with changed weights, and the header as it was, with or without its digest."""
    with safe_open(path, framework="pt") as file:
        header = {key: value for key, value in file.metadata().items() if keep_digest or key != "sha256"}
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, folder / "spoilt.safetensors", metadata=header)
    return folder / "spoilt.safetensors"


def test_changed_weights_are_refused(small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path) -> None:
    content = bytearray(checkpoint_file.read_bytes())
    content[-1000] ^= 1
    (tmp_path / "flipped.safetensors").write_bytes(content)
    for path in (tmp_path / "flipped.safetensors", spoilt(checkpoint_file, tmp_path, integers, keep_digest=True)):
        with pytest.raises(UserError, match="its weights are not those that were saved"):
            load(path)
    with pytest.raises(UserError, match="holds values that are not finite"):
        load(spoilt(checkpoint_file, tmp_path, with_nan, keep_digest=False))
    path = spoilt(checkpoint_file, tmp_path, integers, keep_digest=False)
    with pytest.raises(UserError, match=r"model\.\S+ holds int32, not float32"):
        load(path).load_into("model", small.parts()["model"])


SPITEFUL = [None, -1, 0, 1e30, 10**9, 10**30, "", "x", "${a}", [], {}, [[]], {"_target_": "os.system"}, True]


def test_a_spiteful_value_in_the_configuration_gives_one_line_or_a_model(
    small: SimpleNamespace, rewritten: Rewrite
) -> None:
    """Whatever stands in the header, reading and building end in a `UserError`, soon, or not at all."""
    sampled = random.Random(0)
    for _ in range(25):
        config: Any = copy.deepcopy(small.config())
        section = sampled.choice(["model", "guide", "prior", "scales"])
        config[section][sampled.choice([*config[section], "more"])] = sampled.choice(SPITEFUL)
        try:
            checkpoint = load(rewritten(config))
            model = build_model(checkpoint.config)
            checkpoint.load_into("model", model)
            checkpoint.load_into("guide", build_guide(checkpoint.config, model))
        except UserError as error:
            assert "\n" not in str(error)


def test_a_fuzzed_header_gives_one_line_or_the_same_weights(checkpoint_file: Path, tmp_path: Path) -> None:
    sampled, content, path = random.Random(0), checkpoint_file.read_bytes(), tmp_path / "fuzzed.safetensors"
    size = 8 + int.from_bytes(content[:8], "little")
    good = load(checkpoint_file).tensors
    for _ in range(80):
        fuzzed = bytearray(content)
        for _ in range(sampled.randint(1, 4)):
            fuzzed[sampled.randrange(size)] = sampled.choice(b'0123456789{}[]",:\x00\xffabc')
        path.write_bytes(fuzzed)
        try:
            tensors = load(path).tensors
            assert load(path).pointnet
        except UserError as error:
            assert "\n" not in str(error)
        else:
            # Where both the digest's name and a weight's were hit, building the part refuses the weight.
            assert all(torch.equal(value, good[name]) for name, value in tensors.items() if name in good)
