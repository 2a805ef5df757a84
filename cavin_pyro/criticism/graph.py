"""The graph of a model program for the report, drawn by Pyro and Graphviz."""

from __future__ import annotations

import base64
from typing import Any

import pyro

from models.model import Model
from models.state import Window

PACKAGE_MISSING = "The graph of the program is not drawn: install the package graphviz (pip install graphviz)."
PROGRAM_MISSING = "The graph of the program is not drawn: install Graphviz, whose program dot draws it."


def program_graph(model: Model, window: Window) -> dict[str, Any]:
    """The sites of a model and what each depends on: `dot` (source), `image` (a `data:` address), or a `line`.

    `window: [B]`, of which two are enough. Where the Python package graphviz or the program `dot` lacks, `line` says so
    in the image's place.
    """
    try:
        import graphviz
    except ImportError:
        return {"dot": None, "image": None, "line": PACKAGE_MISSING}
    graph = pyro.render_model(model, model_args=(window.map(lambda field: field[:2]),))
    try:
        drawing = graph.pipe(format="svg")
    except (graphviz.ExecutableNotFound, graphviz.CalledProcessError):
        return {"dot": graph.source, "image": None, "line": PROGRAM_MISSING}
    return {
        "dot": graph.source,
        "image": f"data:image/svg+xml;base64,{base64.b64encode(drawing).decode()}",
        "line": None,
    }
