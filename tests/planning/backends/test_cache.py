"""Native code is made once for all processes, never taken from where others can write, and made anew if damaged."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from planning.backends.cache import MOST, CodeCache, UnsafeFolderError, default_folder
from planning.backends.compiled import Compiled
from tests.cavin_pyro.shell import NO_NATIVE_CODE
from tests.compiler import needs_a_compiler

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs owners of files as POSIX has them")

# Prints results bit by bit, whether they are of native code, and whether torch's compiler was loaded. The first
# argument scales the weights, the second says whether code that is not kept is to be made.
SCRIPT = """
import sys, torch
from planning.backends.compiled import Compiled
def product(layer, number, numbers):
    return (layer(numbers) * number, None), numbers.sum(-1) > 0
torch.manual_seed(0)
layer = torch.nn.Linear(4, 4).requires_grad_(False)
layer.weight *= float(sys.argv[1])
numbers = torch.linspace(-1, 2, 12).reshape(3, 4)
with torch.inference_mode():
    backend = Compiled(make=sys.argv[2] == "make")
    (found, nothing), positive = backend(product, layer, 3, numbers)
    expected = product(layer, 3, numbers)
    torch.testing.assert_close(found, expected[0][0])
    assert nothing is None and torch.equal(positive, expected[1])
print(found.tolist(), backend.native, "torch._inductor.compile_fx" in sys.modules)
"""


def start(folder: Path, factor: float = 1.0, what: str = "make", **surroundings: str) -> subprocess.Popen[str]:
    script = folder / "script.py"  # a function without a source has no key
    script.write_text(SCRIPT)
    return subprocess.Popen(
        [sys.executable, str(script), str(factor), what],
        env={**os.environ, "CAVIN_PYRO_CACHE": str(folder), "PYTHONPATH": os.getcwd(), **surroundings},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> tuple[str, str]:
    printed, complaints = process.communicate(timeout=600)
    assert process.returncode == 0, complaints
    return printed, complaints


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with the library that two processes wanted at once, and what both printed of their results."""
    folder = tmp_path_factory.mktemp("cache")
    (one, told), (other, also_told) = map(finish, [start(folder), start(folder)])
    assert sorted((told + also_told).splitlines()) == [
        f"compiling for the first plan, which takes one to three minutes; native code is cached in {folder / 'native'}"
    ]
    results = {text.rpartition(" ")[0] for text in (one, other)}  # without whether the compiler was loaded
    assert len(results) == 1
    return folder, results.pop()


def library_in(folder: Path) -> Path:
    (library,) = (folder / "native").iterdir()  # and nothing else
    return library


@needs_a_compiler
def test_a_later_process_compiles_nothing(made: tuple[Path, str]) -> None:
    folder, results = made
    library = library_in(folder)
    before = library.stat().st_ino, library.read_bytes()
    printed, complaints = finish(start(folder))
    assert printed == f"{results} False\n" and complaints == ""
    assert (library_in(folder).stat().st_ino, library.read_bytes()) == before


@needs_a_compiler
def test_code_that_is_kept_is_loaded_without_a_compiler(made: tuple[Path, str]) -> None:
    folder, results = made
    printed, complaints = finish(start(folder, what="load", PATH=str(folder / "empty")))
    assert printed == f"{results} False\n" and " True " in printed and complaints == ""


def test_what_is_not_kept_is_computed_directly_and_said_once(tmp_path: Path) -> None:
    printed, complaints = finish(start(tmp_path, what="load", PATH=str(tmp_path / "empty")))
    assert printed.endswith(" False False\n") and not (tmp_path / "native").exists()
    (line,) = complaints.splitlines()
    assert line.startswith(NO_NATIVE_CODE)


@pytest.mark.soak
@needs_a_compiler
def test_a_function_that_is_not_kept_runs_beside_one_that_is(tmp_path: Path) -> None:
    numbers = torch.arange(3.0)
    assert torch.equal(Compiled(tmp_path)(torch.neg, numbers), -numbers)
    backend = Compiled(tmp_path, make=False)
    assert not backend.native  # nothing has run yet
    assert torch.equal(backend(torch.neg, numbers), -numbers) and backend.native
    assert torch.equal(backend(torch.exp, numbers), numbers.exp()) and not backend.native


@needs_a_compiler
def test_others_can_neither_read_nor_write_it(made: tuple[Path, str]) -> None:
    library = library_in(made[0])
    assert stat.S_IMODE(library.stat().st_mode) == 0o600
    assert stat.S_IMODE(library.parent.stat().st_mode) == 0o700


@pytest.mark.soak
@needs_a_compiler
def test_other_weights_make_other_code(made: tuple[Path, str], tmp_path: Path) -> None:
    library = library_in(made[0])
    (tmp_path / "native").mkdir(mode=0o700)
    (tmp_path / "native" / library.name).write_bytes(library.read_bytes())
    printed, complaints = finish(start(tmp_path, 2.0))
    assert "compiling" in complaints and not printed.startswith(made[1])
    assert len([*(tmp_path / "native").iterdir()]) == 2


def flipped(content: bytes) -> bytes:
    """With another bit 5,000 bytes from the beginning."""
    return bytes([*content[:5000], content[5000] ^ 1, *content[5001:]])


@needs_a_compiler
def test_damaged_code_is_never_loaded(made: tuple[Path, str], tmp_path: Path) -> None:
    library = library_in(made[0])
    whole, key = library.read_bytes(), library.stem
    cache = CodeCache(tmp_path / "native")
    copy = tmp_path / "native" / library.name
    for content in (b"", b"x" * 100, whole[: len(whole) // 2], whole[:-1], whole + b"x", flipped(whole)):
        copy.write_bytes(content)
        assert cache.load(key) is None
    printed, complaints = finish(start(tmp_path, what="load"))
    assert " False " in printed and complaints.startswith(NO_NATIVE_CODE)
    copy.rename(tmp_path / "native" / ("0" * 64 + ".so"))
    (tmp_path / "native" / ("0" * 64 + ".so")).write_bytes(whole)
    assert cache.load("0" * 64) is None  # of another key


@pytest.mark.soak
@needs_a_compiler
def test_damaged_code_is_made_anew(made: tuple[Path, str], tmp_path: Path) -> None:
    library, cache = library_in(made[0]), CodeCache(tmp_path / "native")
    (tmp_path / "native" / library.name).write_bytes(flipped(library.read_bytes()))
    printed, complaints = finish(start(tmp_path))
    assert printed.startswith(made[1]) and "compiling" in complaints
    assert cache.load(library.stem) is not None


@needs_a_compiler
def test_code_that_others_could_have_written_is_not_loaded(
    made: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = library_in(made[0])
    cache = CodeCache(tmp_path)
    copy = tmp_path / library.name
    copy.write_bytes(library.read_bytes())
    copy.chmod(0o600)
    assert cache.load(library.stem) is not None
    copy.chmod(0o620)
    assert cache.load(library.stem) is None
    copy.unlink()
    copy.symlink_to(library)
    assert cache.load(library.stem) is None
    copy.unlink()
    copy.write_bytes(library.read_bytes())
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert cache.load(library.stem) is None


def test_a_sealed_file_that_is_no_library_is_not_loaded(tmp_path: Path) -> None:
    cache = CodeCache(tmp_path / "native")
    cache.store("key", b"no library")
    assert cache.load("key") is None and cache.load("another") is None
    assert [path.name for path in (tmp_path / "native").iterdir()] == ["key.so"]


def test_a_folder_that_others_could_have_filled_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for mode in (0o770, 0o707, 0o702):
        folder = tmp_path / str(mode)
        folder.mkdir()
        folder.chmod(mode)
        with pytest.raises(UnsafeFolderError, match=f"^{folder} can be written by other users$"):
            CodeCache(folder)
    above = tmp_path / "above"
    (above / "native").mkdir(parents=True, mode=0o700)
    above.chmod(0o777)
    with pytest.raises(UnsafeFolderError, match=f"^{above} can be written by other users$"):
        CodeCache(above / "native")
    above.chmod(0o1777)  # as /tmp: nobody replaces what belongs to another
    CodeCache(above / "native")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(UnsafeFolderError, match=f"^{tmp_path} belongs to another user$"):
        CodeCache(tmp_path)


@pytest.mark.soak
@needs_a_compiler
def test_a_refused_folder_is_one_line_and_code_is_made_for_the_process(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tmp_path.chmod(0o777)
    backend = Compiled(tmp_path)
    Compiled(tmp_path)
    assert capsys.readouterr().err == (
        f"native code is made for this process only: {tmp_path} can be written by other users "
        "(CAVIN_PYRO_CACHE=DIR names another folder)\n"
    )
    assert torch.equal(backend(torch.neg, torch.arange(3.0)), -torch.arange(3.0))
    assert not [*tmp_path.iterdir()]


def test_a_refused_folder_is_one_line_where_code_would_only_be_loaded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tmp_path.chmod(0o777)
    backend = Compiled(tmp_path, make=False)
    assert torch.equal(backend(torch.neg, torch.arange(3.0)), -torch.arange(3.0))
    assert capsys.readouterr().err == (
        f"native code is not loaded: {tmp_path} can be written by other users "
        "(CAVIN_PYRO_CACHE=DIR names another folder)\n"
    )


def test_the_folder_is_the_platforms_unless_one_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CAVIN_PYRO_CACHE")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_folder() == tmp_path / "xdg" / "cavin_pyro" / "native"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # which its specification says to ignore
    assert default_folder() == tmp_path / ".cache" / "cavin_pyro" / "native"
    monkeypatch.setattr(sys, "platform", "darwin")
    assert default_folder() == tmp_path / "Library" / "Caches" / "cavin_pyro" / "native"
    monkeypatch.setenv("CAVIN_PYRO_CACHE", "~/mine")
    assert default_folder() == tmp_path / "mine" / "native"


def test_the_oldest_go_first(tmp_path: Path) -> None:
    cache = CodeCache(tmp_path)
    for number in range(MOST + 3):
        cache.store(f"{number}", b"code")
        os.utime(tmp_path / f"{number}.so", (number, number))
    assert len([*tmp_path.iterdir()]) == MOST
    assert not (tmp_path / "1.so").exists() and (tmp_path / f"{MOST + 2}.so").exists()


def test_what_a_killed_process_had_begun_goes_after_a_day(tmp_path: Path) -> None:
    cache = CodeCache(tmp_path)
    for name in ("old", "new"):
        (tmp_path / f"{name}.partial").write_bytes(b"half")
        (tmp_path / f"{name}.made").mkdir()
        (tmp_path / f"{name}.made" / "code.cpp").write_bytes(b"half")
    for path in tmp_path.glob("old*"):
        os.utime(path, (0, 0))
    cache.store("key", b"code")
    assert {path.name for path in tmp_path.iterdir()} == {"key.so", "new.partial", "new.made"}
