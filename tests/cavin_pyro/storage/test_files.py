from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.files import atomic_write, output_folder, read_json, write_json


@pytest.mark.parametrize("old", [None, b"old"])
@pytest.mark.parametrize("fails", [False, True])
def test_a_file_is_the_new_one_or_the_old_one_and_nothing_else_remains(
    old: bytes | None, fails: bool, tmp_path: Path
) -> None:
    path = tmp_path / "results.csv"
    if old is not None:
        path.write_bytes(old)
    with suppress(ZeroDivisionError), atomic_write(path) as temporary:
        assert temporary.suffix == path.suffix  # writers choose formats by it
        temporary.write_bytes(b"new")
        if fails:
            raise ZeroDivisionError
    assert (path.read_bytes() if path.exists() else None) == (old if fails else b"new")
    assert set(path.parent.iterdir()) <= {path}


def test_json_is_read_as_it_was_written_or_named(tmp_path: Path) -> None:
    content = {"text": "größer", "numbers": [1, 2.5, None], "nested": {"true": True}}
    write_json(tmp_path / "a.json", content)
    assert read_json(tmp_path / "a.json") == content
    (tmp_path / "damaged.json").write_bytes(b"\xff\xfe\x00")
    for name in ("damaged.json", "absent.json"):
        with pytest.raises(UserError, match=name):
            read_json(tmp_path / name)


def test_an_output_folder_is_made_and_cleared_of_what_a_kill_left_but_not_of_files_of_others(tmp_path: Path) -> None:
    others = {".hidden", ".film.0123abcd.partial.mkv", ".notes.cavin-old.partial", "a.partial"}
    with output_folder(tmp_path / "deep" / "down") as folder:
        for name in ("results.csv", *others):
            (folder / name).write_text("whole")
        with atomic_write(folder / "plan.png") as temporary:
            temporary.write_text("whole")
            killed = folder / temporary.name.replace("plan", "killed")
            killed.write_text("half")
    assert killed.exists()
    with output_folder(str(folder)) as again:
        assert again == folder
    assert {path.name for path in folder.iterdir()} == {"results.csv", "plan.png", *others}


def test_an_output_folder_in_which_nothing_was_written_is_deleted_if_it_was_made_for_it(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for place in ("empty", "deep/down"):
        with pytest.raises(ZeroDivisionError), output_folder(tmp_path / place):
            raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_a_run_that_fails_before_its_first_result_leaves_no_options_in_a_folder_made_for_it(tmp_path: Path) -> None:
    (tmp_path / "earlier").mkdir()
    for place, names in {"earlier": ["config.yaml"], "new": ["config.yaml"], "half": ["config.yaml", "row"]}.items():
        with pytest.raises(MemoryError), output_folder(tmp_path / place) as folder:
            for name in names:
                (folder / name).touch()
            raise MemoryError
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert left == ["earlier/config.yaml", "half/config.yaml", "half/row"]
    with output_folder(tmp_path / "whole") as folder:
        (folder / "config.yaml").touch()
    with pytest.raises(UserError, match="holds a run, not a dataset"), output_folder(tmp_path / "whole", "a dataset"):
        pass
