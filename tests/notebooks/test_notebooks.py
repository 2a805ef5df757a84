"""Every notebook runs from beginning to end, smaller, wherever it is started, and opens on something to look at."""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output

FEWER = {r"transitions=(150|200)": "transitions=110", r"steps=[46]0\b": "steps=20", r"windows=200": "windows=20"}
NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "notebooks").glob("*.ipynb"))


class Shell(InteractiveShell):
    """IPython in this process: a kernel would import everything again."""

    def enable_gui(self, gui: str | None = None) -> None:
        """Pictures are captured, none is shown in a window."""


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shell]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IPYTHONDIR", str(tmp_path_factory.mktemp("ipython")))
        patch.setitem(sys.modules, "__main__", sys.modules["__main__"])  # which IPython replaces
        yield Shell.instance()
    Shell.clear_instance()


every_notebook = pytest.mark.parametrize("path", [pytest.param(path, id=path.stem) for path in NOTEBOOKS])


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@every_notebook
def test_a_notebook_is_stored_with_what_its_cells_show(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == [*range(1, len(cells) + 1)]
    assert any("image/png" in output.get("data", ()) for output in cells[0].outputs)
    assert not [
        one for cell in cells for one in cell.outputs if one.output_type == "error" or one.get("name") == "stderr"
    ]


@every_notebook
def test_a_notebook_runs_and_opens_on_a_picture(
    path: Path, shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    shell.reset(new_session=False)
    shown = []
    for cell in code_cells(nbformat.read(path, as_version=4)):
        source = cell.source
        for many, fewer in FEWER.items():
            source = re.sub(many, fewer, source)
        with capture_output() as captured:
            result = shell.run_cell(source)
        assert result.success, f"{source}\n{captured.stdout}\n{captured.stderr}"
        shown.append([output.data for output in captured.outputs])
    assert any("image/png" in data for data in shown[0])
    assert not list((tmp_path / "elsewhere").iterdir())  # what a notebook makes lies in a temporary folder
