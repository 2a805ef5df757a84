"""The graph of a model program for the report, drawn by Pyro and Graphviz."""

from __future__ import annotations

import base64
import subprocess

import pyro

from cavin_pyro.models.model import Model
from cavin_pyro.models.state import Window

MISSING = "The graph of the program is not drawn: install Graphviz (its program dot) and the package graphviz."


def program_graph(model: Model, window: Window) -> dict[str, str | None]:
    """The sites of a model and what each depends on, as an `image` (a `data:` address), or a `line` that says why not.

    `window: [B]`, of which two are enough.
    """
    try:
        graph = pyro.render_model(model, model_args=(window.map(lambda field: field[:2]),))
        drawing = graph.pipe(format="svg")
    except (ImportError, RuntimeError, subprocess.CalledProcessError):  # no package, no program, or it fails
        return {"image": None, "line": MISSING}
    return {"image": f"data:image/svg+xml;base64,{base64.b64encode(drawing).decode()}", "line": None}
