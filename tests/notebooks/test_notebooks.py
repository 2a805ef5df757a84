"""Every notebook runs from beginning to end, wherever it is started, and opens on something to look at."""

from __future__ import annotations

import ast
import os
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import nbformat
import pytest
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
KERNEL = "python3"  # ipykernel's own name for the interpreter that it is imported in
OFTEN = ("3",)  # numbers of notebooks that `make test` runs; of the others it imports what they import
TIME_LIMIT = 300  # seconds per cell; a whole notebook takes half a minute

every_notebook = pytest.mark.parametrize("path", [pytest.param(path, id=path.stem) for path in NOTEBOOKS])


def read(path: Path) -> Any:
    return nbformat.read(path, as_version=4)


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncKernelManager:
    """This interpreter as a kernel, without anything from the user's own Jupyter folders."""
    for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    # Without folders of installed kernels there is only the one that ipykernel brings.
    return AsyncKernelManager(kernel_name=KERNEL, kernel_spec_manager=KernelSpecManager(kernel_dirs=[]))


def test_notebooks_follow_a_workflow_and_each_leads_to_the_next() -> None:
    names = [path.name for path in NOTEBOOKS]
    assert [name[:2] for name in names] == [f"{number}_" for number in range(1, len(names) + 1)] and len(names) >= 5
    for path, following in pairwise(NOTEBOOKS):
        assert f"]({following.name})" in read(path).cells[-1].source


def test_the_kernel_is_the_interpreter_of_the_tests(kernel: AsyncKernelManager) -> None:
    assert kernel.format_kernel_cmd()[0] == sys.executable


@every_notebook
def test_a_notebook_is_stored_without_outputs(path: Path) -> None:
    notebook = read(path)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == KERNEL
    for cell in code_cells(notebook):
        assert cell.outputs == []
        assert cell.execution_count is None


@every_notebook
def test_what_a_notebook_imports_is_there(path: Path) -> None:
    lines = "\n".join(cell.source for cell in code_cells(read(path))).splitlines()
    written = ast.parse("\n".join(line for line in lines if not line.startswith("%")))
    imports = [node for node in ast.walk(written) if isinstance(node, ast.Import | ast.ImportFrom)]
    assert imports
    exec(compile(ast.Module(imports, type_ignores=[]), path.name, "exec"), {})


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=[] if path.stem[0] in OFTEN else pytest.mark.soak) for path in NOTEBOOKS],
)
def test_a_notebook_runs_and_opens_on_a_picture(path: Path, kernel: AsyncKernelManager, tmp_path: Path) -> None:
    notebook = read(path)
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    client = NotebookClient(notebook, km=kernel, timeout=TIME_LIMIT, resources={"metadata": {"path": str(folder)}})
    client.execute(cleanup_kc=True, env=environment)
    shown = [output.get("data", {}) for output in code_cells(notebook)[0].outputs]
    assert any("image/png" in data for data in shown)
    assert not list(folder.iterdir())  # what a notebook makes lies in a temporary folder
