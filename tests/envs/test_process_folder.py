"""Files for PyBullet are gone when their process has ended, also a worker."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ALONE = "from envs.process_folder import process_folder; (process_folder('meshes') / 'a.obj').write_text('v 0 0 0')"
WORKER = """
import multiprocessing

from envs.objects.object_sets import load_object_set


def work():
    objects = load_object_set("builtin")
    print(objects.asset(objects.names[0]).collision)


if __name__ == "__main__":
    worker = multiprocessing.get_context("{method}").Process(target=work)
    worker.start()
    worker.join()
"""


@pytest.mark.soak
@pytest.mark.parametrize("method", [None, "fork", "spawn"])
def test_no_folder_is_left_when_a_process_ends(tmp_path: Path, method: str | None) -> None:
    script = tmp_path / "script.py"
    script.write_text(ALONE if method is None else WORKER.replace("{method}", method))
    folder = tmp_path / "temporary"
    folder.mkdir()
    root = Path(__file__).parents[2]
    environment = {**os.environ, "TMPDIR": str(folder), "PYTHONPATH": str(root)}
    answer = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, check=True)
    if method is not None:
        assert str(folder / "cavin_pyro_meshes_") in answer.stdout
    assert list(folder.glob("cavin_pyro_*")) == []
