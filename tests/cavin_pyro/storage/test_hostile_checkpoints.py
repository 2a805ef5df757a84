"""Checkpoints that somebody made or changed on purpose: nothing in them runs, and each gets one line."""

from __future__ import annotations

import copy
import random
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
from cavin_pyro.storage import checkpoint as storage
from cavin_pyro.storage.checkpoint import load_checkpoint, shipped_folder
from cavin_pyro.storage.digests import MANIFEST, read_manifest, update_manifest
from cavin_pyro.storage.files import file_digest
from cavin_pyro.storage.geometry import load_pointnet
from tests.cavin_pyro.storage.test_checkpoint import rewritten

MODULE = """
import torch
import numpy
from models.priors.standard import StandardPrior
from my_parts.inner import Inner

class Own(StandardPrior):
    pass

def function(**given):
    raise AssertionError("a function ran")
"""


@pytest.fixture
def naming(small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path) -> Callable[[Any], Path]:
    """A checkpoint whose prior has another `_target_`."""

    def make(target: Any) -> Path:
        config = small.config()
        config["prior"]["_target_"] = target
        return rewritten(checkpoint_file, tmp_path, config)

    return make


@pytest.fixture
def my_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's package."""
    folder = tmp_path / "my_parts"
    folder.mkdir()
    (folder / "__init__.py").write_text(MODULE)
    (folder / "inner.py").write_text("from models.priors.standard import StandardPrior\nclass Inner(StandardPrior): 0")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("my_parts")
@pytest.mark.parametrize("name", ["torch.hub.load", "torch.load", "torch.nn.Linear", "numpy.save", "function", "Gone"])
def test_a_trusted_module_is_trusted_for_its_own_classes_and_not_for_what_it_imports(
    name: str, naming: Callable[[str], Path]
) -> None:
    path = naming(f"my_parts.{name}")
    with pytest.raises(UserError, match=r"trust=\[my_parts\] allows the classes that are defined there") as refused:
        load_checkpoint(path, trust=["my_parts"])
    assert f"my_parts.{name} is none of them" in str(refused.value)


@pytest.mark.usefixtures("my_parts")
@pytest.mark.parametrize("name", ["Own", "Inner", "inner.Inner"])
def test_classes_of_a_trusted_package_and_of_its_modules_are_built(name: str, naming: Callable[[str], Path]) -> None:
    model = build_model(load_checkpoint(naming(f"my_parts.{name}"), trust=["my_parts"]).config)
    assert type(model.prior_of_effects).__name__ == name.rpartition(".")[2]


@pytest.mark.parametrize("target", ["models.cascaded.nn.Linear", "cavin_pyro.train.main", "os.system", "envs.os"])
def test_the_line_never_suggests_to_trust_this_program_or_pythons_own_modules(
    target: str, naming: Callable[[str], Path]
) -> None:
    with pytest.raises(UserError, match="not part of this program$"):
        load_checkpoint(naming(target))
    with pytest.raises(UserError, match="is none of them$"):
        load_checkpoint(naming(target), trust=[target.partition(".")[0]])


@pytest.mark.parametrize("target", [5, ["os.system"], True])
def test_a_target_that_is_no_name_is_refused(target: Any, naming: Callable[[Any], Path]) -> None:
    with pytest.raises(UserError, match="asks to run"):
        load_checkpoint(naming(target))


@pytest.mark.parametrize(
    "value",
    [
        "${oc.create:{_target_:numpy.save,_args_:[written,3]}}",
        "${oc.env:HOME}",
        {"${oc.env:HOME}": 1},
        [{"deep": ["${scales}"]}],
    ],
)
def test_interpolations_in_a_stored_configuration_are_refused(
    value: Any, small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path
) -> None:
    config = small.config()
    config["model"]["more"] = value
    with pytest.raises(UserError, match="has an interpolation in its configuration, which is refused"):
        load_checkpoint(rewritten(checkpoint_file, tmp_path, config))


def test_numbers_far_above_the_weights_are_refused_before_a_layer_fills_the_memory(
    small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path
) -> None:
    config = small.config()
    config["guide"]["width"] = 30_000  # 3.6 gigabytes for one layer
    with pytest.raises(UserError, match=r"guide\.width=30000, but no layer in it has more than \d+ units"):
        load_checkpoint(rewritten(checkpoint_file, tmp_path, config))


def test_a_configuration_without_end_is_refused(small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path) -> None:
    config, deep = small.config(), {}
    config["model"]["more"] = deep
    for _ in range(50):
        deep["more"] = deep = {}
    with pytest.raises(UserError, match="over 20 levels deep"):
        load_checkpoint(rewritten(checkpoint_file, tmp_path, config))


def spoilt(path: Path, folder: Path, change: Callable[[dict[str, Tensor]], None], *, keep_digest: bool = True) -> Path:
    """A copy with changed weights, and the header as it was; without its digest on demand."""
    with safe_open(path, framework="pt") as file:
        header = {key: value for key, value in file.metadata().items() if keep_digest or key != "sha256"}
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, folder / "spoilt.safetensors", metadata=header)
    return folder / "spoilt.safetensors"


def a_nan(tensors: dict[str, Tensor]) -> None:
    tensors[sorted(tensors)[0]].view(-1)[0] = torch.nan


def integers(tensors: dict[str, Tensor]) -> None:
    name = next(name for name in sorted(tensors) if name.startswith("model."))
    tensors[name] = tensors[name].int()


def doubled(tensors: dict[str, Tensor]) -> None:
    tensors[sorted(tensors)[0]].mul_(2.0)


@pytest.mark.parametrize("change", [a_nan, integers, doubled])
def test_changed_weights_do_not_agree_with_the_digest(
    change: Callable[[dict[str, Tensor]], None], checkpoint_file: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="its weights are not those that were saved"):
        load_checkpoint(spoilt(checkpoint_file, tmp_path, change))


def test_a_flipped_bit_of_a_weight_is_found(checkpoint_file: Path, tmp_path: Path) -> None:
    content = bytearray(checkpoint_file.read_bytes())
    content[-1000] ^= 1
    (tmp_path / "flipped.safetensors").write_bytes(content)
    with pytest.raises(UserError, match="its weights are not those that were saved"):
        load_checkpoint(tmp_path / "flipped.safetensors")


def test_weights_that_are_no_finite_numbers_of_the_models_type_are_refused_without_a_digest(
    small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="holds values that are not finite"):
        load_checkpoint(spoilt(checkpoint_file, tmp_path, a_nan, keep_digest=False))
    path = spoilt(checkpoint_file, tmp_path, integers, keep_digest=False)
    with pytest.raises(UserError, match=r"model\.\S+ holds int32, not float32"):
        load_checkpoint(path).load_into("model", small.parts()["model"], path)
    assert load_checkpoint(spoilt(checkpoint_file, tmp_path, doubled, keep_digest=False))  # an older version's


def test_every_shipped_checkpoint_is_in_the_manifest() -> None:
    files = {path.relative_to(shipped_folder()).as_posix(): path for path in shipped_folder().rglob("*.safetensors")}
    assert len(files) >= 18
    assert read_manifest(shipped_folder()) == {name: file_digest(path) for name, path in files.items()}


def test_a_shipped_checkpoint_that_was_replaced_is_refused(
    checkpoint_file: Path, small: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(storage, "shipped_folder", lambda: tmp_path)
    path = tmp_path / "cavin.safetensors"
    path.write_bytes(checkpoint_file.read_bytes())
    update_manifest(tmp_path)
    assert load_checkpoint(path).config == small.config()
    replaced = rewritten(checkpoint_file, tmp_path, small.config())  # a good checkpoint, of another name
    load_checkpoint(replaced)
    replaced.rename(path)
    with pytest.raises(UserError, match=f"is not the one that was shipped: its SHA-256 .*{MANIFEST}"):
        load_checkpoint(path)


SPITEFUL = [None, -1, 0, 1e30, 10**9, 10**30, "", "x", "${a}", [], {}, [[]], {"_target_": "os.system"}, True]


@pytest.mark.parametrize("seed", range(20))
def test_a_configuration_with_a_spiteful_value_gives_one_line_or_a_model(
    seed: int, small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path
) -> None:
    """Whatever stands in the header, reading and building end in a `UserError`, soon, or not at all."""
    drawn = random.Random(seed)
    for _ in range(5):
        config: Any = copy.deepcopy(small.config())
        section = drawn.choice(["model", "guide", "prior", "scales"])
        config[section][drawn.choice([*config[section], "more"])] = drawn.choice(SPITEFUL)
        try:
            checkpoint = load_checkpoint(rewritten(checkpoint_file, tmp_path, config))
            model = build_model(checkpoint.config)
            checkpoint.load_into("model", model, "it")
            checkpoint.load_into("guide", build_guide(checkpoint.config, model), "it")
        except UserError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("seed", range(10))
def test_a_fuzzed_header_gives_one_line_or_the_same_weights(
    seed: int, checkpoint_file: Path, small: SimpleNamespace, tmp_path: Path
) -> None:
    drawn, content, path = random.Random(seed), checkpoint_file.read_bytes(), tmp_path / "fuzzed.safetensors"
    size = 8 + int.from_bytes(content[:8], "little")
    good, read = load_checkpoint(checkpoint_file).tensors, 0
    for _ in range(20):
        fuzzed = bytearray(content)
        for _ in range(drawn.randint(1, 4)):
            fuzzed[drawn.randrange(size)] = drawn.choice(b'0123456789{}[]",:\x00\xffabc')
        path.write_bytes(fuzzed)
        try:
            tensors = load_checkpoint(path).tensors
            load_pointnet(path)
            read += 1
        except UserError as error:
            assert "\n" not in str(error)
        else:
            assert all(torch.equal(value, good[name]) for name, value in tensors.items())
