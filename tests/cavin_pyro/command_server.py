"""A process that has imported what commands need and forks one process per command: a start costs seconds otherwise.

Reads jobs, a line of JSON each, and prints the exit status of each. A job has `folder`, `output` and `errors` (files),
and either `command` and `overrides`, which runs as `python -m cavin_pyro.<command> <overrides>` in the folder; or
`script` and `overrides`, which runs as `python <script> <overrides>`; or `cases`, which run in turn in one process,
each from its own `folder`, with their answers as JSON in `output`.
With `file_limit`, no file can grow beyond so many bytes; with `pictures` "blank", matplotlib draws none; with
`kill_at`, a file and a number, the process is killed when the file has so many lines.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import io
import json
import os
import resource
import runpy
import signal
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.plugins import Plugins
from matplotlib.figure import Figure
from PIL import Image

from cavin_pyro.config.composition import compose

IMPORTED = (  # what the commands import when they are run; not the commands themselves, which are run anew
    "cavin_pyro.config.help",
    "cavin_pyro.criticism.loading",
    "cavin_pyro.criticism.report",
    "cavin_pyro.criticism.sections",
    "cavin_pyro.data.collection",
    "cavin_pyro.evaluation.comparison",
    "cavin_pyro.evaluation.evaluation",
    "cavin_pyro.reproduction.pipeline",
    "cavin_pyro.reproduction.results",
    "cavin_pyro.training.pretraining",
    "cavin_pyro.training.run",
    "cavin_pyro.visualization.rendering",
    "cavin_pyro.visualization.training",
    "cavin_pyro.guides.cascaded",
    "imageio.plugins.ffmpeg",
    "cavin_pyro.models.cascaded",
    "pandas",  # by pyarrow, which writes tables
    "torch._dynamo",  # by torch's optimizers
)
LIMIT = 300  # seconds per job


def main() -> None:
    gc.disable()  # what imports make stays
    for name in IMPORTED:
        importlib.import_module(name)
    _warm_up()
    gc.enable()
    for line in sys.stdin:
        gc.freeze()  # so that children's collections neither look at all of this nor copy it
        child = os.fork()
        if not child:
            run(json.loads(line))
            return
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _warm_up() -> None:
    """Fill what libraries cache for the whole process: Hydra's plugins, `inspect`'s modules and Pillow's formats."""
    Plugins.instance()
    compose("evaluate")
    Image.init()


def run(job: dict[str, Any]) -> None:
    signal.alarm(LIMIT)
    writing = os.O_WRONLY | os.O_CREAT | (os.O_APPEND if job.get("append") else os.O_TRUNC)
    for number, (path, flags) in enumerate(
        [(os.devnull, os.O_RDONLY), (job["output"], writing), (job["errors"], writing)]
    ):
        os.dup2(os.open(path, flags), number)
    os.chdir(job["folder"])
    if job.get("file_limit"):  # as inherited by a command that a user starts under `ulimit -f`
        resource.setrlimit(resource.RLIMIT_FSIZE, (job["file_limit"], resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    if job.get("pictures") == "blank":  # how they reach the disk is tested, not what they show
        Figure.savefig = save_blank
    if job.get("kill_at"):
        threading.Thread(target=kill_at, args=job["kill_at"], daemon=True).start()
    if "cases" in job:
        sys.path[0] = ""  # the folder of each case
        print(json.dumps([run_case(**case) for case in job["cases"]]))
        return
    if "script" in job:
        sys.path[0] = str(Path(job["script"]).parent)
        sys.argv = [job["script"], *job["overrides"]]
        runpy.run_path(job["script"], run_name="__main__")
        return
    sys.path[0] = job["folder"]  # as `python -m` has it
    sys.argv = [job["command"], *job["overrides"]]
    runpy.run_module(f"cavin_pyro.{job['command']}", run_name="__main__", alter_sys=True)


def kill_at(path: str, lines: int) -> None:
    """Kill this process as soon as a file has so many whole lines; with 0, as soon as it is there."""
    while not Path(path).exists() or Path(path).read_bytes().count(b"\n") < lines:
        time.sleep(0.001)
    os.kill(os.getpid(), signal.SIGKILL)


def save_blank(figure: Figure, target: Any, **_: Any) -> None:
    """Write an empty picture of a figure's size: drawing takes longer than all else in a small run."""
    Image.new("RGB", tuple(map(int, figure.get_size_inches() * figure.dpi))).save(target, format="PNG")


def run_case(command: str, overrides: Sequence[str], folder: str) -> dict[str, Any]:
    """Run a command in this process."""
    gc.disable()  # a third of the time, for a process that ends soon
    output, errors, status = io.StringIO(), io.StringIO(), 0
    Path(folder).mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    sys.argv = [command, *overrides]
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            importlib.import_module(f"cavin_pyro.{command}").main()
        except SystemExit as stop:
            status = stop.code
        except BaseException:
            status = 1
            traceback.print_exc()
    return {"status": status, "output": output.getvalue(), "errors": errors.getvalue()}


if __name__ == "__main__":
    main()
