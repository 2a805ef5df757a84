"""Load two checkpoints to be compared, with the held-out windows that they have in common."""

from __future__ import annotations

from typing import Any

import torch
from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.loading import Accept, Loaded, context_of, load_trained, unmasked_windows
from cavin_pyro.criticism.training_data import compare_data
from cavin_pyro.data.collection import collecting_world


def load_pair(config: DictConfig, accept: Accept | None = None) -> dict[str, tuple[CheckContext, dict[str, Any]]]:
    """Read what the options `a` and `b` name, as `load_context` does for `checkpoint`.

    Both have the same held-out windows: those that neither was trained on.

    Raises:
        UserError: see `load_context`; or their windows are not of the same data, or none is held out by both.
    """
    world = collecting_world(config.env)
    both = {name: load_trained(config, config[name], accept) for name in ("a", "b")}
    tables = {name: loaded.table for name, loaded in both.items()}
    lengths = {name: loaded.model.segment_length for name, loaded in both.items()}
    held_out_objects = [list(loaded.selection.held_out_objects) for loaded in both.values()]
    if len(set(lengths.values())) > 1 or held_out_objects[0] != held_out_objects[1]:
        raise UserError(
            f"a and b cannot be compared on the same windows: they have segments of {lengths['a']} and {lengths['b']} "
            f"pushes and hold out the objects {held_out_objects[0]} and {held_out_objects[1]}"
        )
    starts = [one.table.starts[unmasked_windows(one.table, _unseen(one))] for one in both.values()]
    common = starts[0][torch.isin(starts[0], starts[1])].sort().values
    if not len(common):
        raise UserError("no window was held out by both a and b: give other data=, on which neither was trained")
    contexts = {}
    for name, loaded in both.items():
        order = tables[name].starts.argsort()
        indices = order[torch.searchsorted(tables[name].starts[order], common)]
        contexts[name] = context_of(config, loaded, world, indices)
    return contexts


def _unseen(loaded: Loaded) -> torch.Tensor:
    """Indices of the windows that a model was not trained on: the held-out ones, or all of other data."""
    table, trained = loaded.table, loaded.checkpoint.provenance
    if all(compare_data(folder, trained)["same"] is False for folder in loaded.folders):
        return torch.cat((table.training, table.validation))
    return table.validation
