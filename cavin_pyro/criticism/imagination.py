"""What do the two codes mean? Effects and motions of one scene: where h and f say they lead, and where physics does.

Letters: E effects, Z motions of each, T actions, M objects, P numbers of a position.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.subgoals import execute
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.envs.world import World, begin
from cavin_pyro.models.model import Model
from cavin_pyro.planning import rollout
from cavin_pyro.planning.sampling import sample_codes
from cavin_pyro.visualization.drawing import (
    FONT,
    PREDICTED,
    REACHED,
    SUBGOALS,
    draw_ground,
    draw_paths,
    empty_rows,
    finish,
    named,
    panels_of,
    project,
)

Floats = NDArray[np.float32]
MARGIN = 0.12  # of a picture's width, around all that is drawn
CODES = ("effect_code", "motion_code")


class Imagined(NamedTuple):
    """Effects and motions of a scene.

    Attributes:
        picture: of the scene, None where the world has none. centers: [M, P] and mask: [M], as observed in it.
        actions: [E, Z, T, A] normalised. subgoals: [E, M, P], by h. predicted: [E, Z, T, M, P], by f after each action.
        reached: [E, Z, T, M, P], in physics.
    """

    picture: Any
    centers: Floats
    mask: NDArray[np.bool_]
    actions: Floats
    subgoals: Floats
    predicted: Floats
    reached: Floats

    @property
    def errors(self) -> Floats:
        """[E, Z], from f's last state to that of physics: the largest distance over the objects."""
        return np.linalg.norm(self.predicted[:, :, -1] - self.reached[:, :, -1], axis=-1)[..., self.mask].max(axis=-1)


@torch.inference_mode()
def imagine(model: Model, world: World, *, seed: int = 0, effects: int = 8, motions: int = 4) -> Imagined:
    """Sample c ~ p(c | s) and z ~ p(z | s, c) in the scene of a seed, and carry out a = g(s, c, z) from it.

    Raises UserError: the model has other codes than these two.
    """
    if model.codes != CODES:
        raise UserError(
            f"imagine needs a checkpoint of model=cascaded, which has effect and motion codes, not {model.name}"
        )
    observation = begin(world, seed)
    picture, (centers, mask) = world.render(), world.positions(observation)
    state = world.state(observation).expand_plans(1)
    generators = [torch.Generator().manual_seed(seed)]
    code = sample_codes(model.effect_prior, [state.expand_plans(effects)], None, generators)
    subgoals = model.subgoal(state.expand_plans(effects), code).centers[0].numpy()
    here, code = state.expand_plans(effects * motions), code.repeat_interleave(motions, dim=1)
    motion_code = sample_codes(model.motion_prior, [here, code], None, generators)
    actions = rollout.project(model.actions(here, effect_code=code, motion_code=motion_code), None)  # as executed
    predicted = rollout.predict_states(model, here, actions)[1][0].numpy()
    reached = []
    for plan in actions[0].numpy():
        world.reset(seed=seed)
        reached.append(execute(world, plan, to_the_end=True)[0])
    objects, shape = subgoals.shape[1], (effects, motions)
    return Imagined(
        picture,
        centers[:objects],
        mask[:objects],
        actions[0].unflatten(0, shape).numpy(),
        subgoals,
        predicted.reshape(*shape, *predicted.shape[1:]),
        np.stack(reached)[:, :, :objects].reshape(*shape, *predicted.shape[1:]),
    )


def draw_imagination(
    path: Path, model: Model, world: World, *, seed: int = 0, effects: int = 8, motions: int = 4
) -> pd.DataFrame:
    """`imagine`, with a panel per effect: its subgoal, and where each motion ends as predicted and as reached.

    Returns `Imagined.errors`, a row per effect and a column per motion; in centimetres on the table.
    """
    imagined = imagine(model, world, seed=seed, effects=effects, motions=motions)
    (left, top), (right, bottom) = _box(imagined, world)
    size = None if imagined.picture is None else np.zeros((bottom - top, right - left, 3), np.uint8)
    figure, panels = panels_of(effects, size)
    factor, unit = (100, " (cm)") if world.space == SPACE else (1, "")
    errors = factor * imagined.errors
    for number, panel in enumerate(panels[:effects]):
        draw_ground(panel, imagined.picture)
        if size is not None:
            panel.set(xlim=(left, right), ylim=(bottom, top))
        draw_paths(panel, world, imagined, imagined.subgoals[number][None], SUBGOALS)
        for motion in range(motions):
            draw_paths(panel, world, imagined, imagined.predicted[number, motion, -1:], PREDICTED)
            draw_paths(panel, world, imagined, imagined.reached[number, motion, -1:], REACHED)
        off = ", ".join(f"{error:.1f}" for error in errors[number])
        panel.set_title(f"effect {number + 1}: f is off by {off} {unit.strip(' ()')}", fontsize=FONT)
    styles = {"subgoal h(s, c)": SUBGOALS, "predicted by f": PREDICTED, "reached in physics": REACHED}
    finish(path, figure, [Line2D([], [], label=label, **style) for label, style in styles.items()])
    columns = [f"motion {number}" for number in range(1, motions + 1)]
    rows = pd.RangeIndex(1, effects + 1, name=f"predicted to reached{unit}, effect")
    return pd.DataFrame(errors, rows, columns)


def _box(imagined: Imagined, world: World) -> NDArray[np.intp]:
    """The part of the picture in which something is drawn: its corners, columns and rows [2, 2]."""
    if imagined.picture is None:
        return np.zeros((2, 2), np.intp)
    objects = [index for index in named(world) if index < len(imagined.mask) and imagined.mask[index]]
    ends = [part[..., -1, :, :].reshape(-1, *imagined.centers.shape) for part in (imagined.predicted, imagined.reached)]
    drawn = np.concatenate([imagined.centers[None], imagined.subgoals, *ends])[:, objects]
    pixels, size = project(world, drawn).reshape(-1, 2), imagined.picture.shape[1::-1]
    margin = MARGIN * size[0]
    corners = np.stack([pixels.min(axis=0) - margin, pixels.max(axis=0) + margin])
    corners[0, 1] = max(corners[0, 1], min(empty_rows(imagined.picture), corners[0, 1] + 0.9 * margin))
    return np.clip(corners, 0, size).astype(np.intp)
