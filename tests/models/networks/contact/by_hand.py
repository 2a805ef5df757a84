"""f of `dynamics=contact` with loops over objects and directions, in NumPy: slow, and easy to check."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.models.networks.contact.dynamics import MAXIMUM_DISPLACEMENT, ContactDynamics
from cavin_pyro.models.networks.contact.geometry import (
    CORNER,
    DISPLACEMENT_UNIT,
    PUSH_UNIT,
    REACH_HIGH,
    REACH_LOW,
    TOOL_RADIUS,
)
from cavin_pyro.models.networks.outline import (
    DIRECTIONS,
    HEIGHT_MEANS,
    HEIGHT_SPREADS,
    HEIGHTS,
    OUTLINE_UNIT,
    OUTLINES,
    PER_OUTLINE,
    PRODUCT,
    SPREAD,
    STANDARD_UNIT,
    TYPICAL,
    standard_values,
)

Numbers = NDArray[np.float64]
SHAPE = OUTLINES * PER_OUTLINE
ORDERS = np.arange(1, PER_OUTLINE // 2 + 1)


def outline_values(features: Tensor) -> Tensor:
    """`features: [..., 64]` -> `[..., 63]`: series of three outlines and heights, in units of 0.05 m."""
    values = standard_values(features.movedim(-1, 0)).movedim(0, -1)
    return TYPICAL.to(features) + SPREAD.to(features) * values


def reach(outline: Numbers, angle: float) -> float:
    """Metres from the centre, of an outline `[2 K + 1]` in units of 0.05 m."""
    real, imaginary = np.split(outline[1:], 2)
    return OUTLINE_UNIT * float(
        outline[0] + 2 * (real * np.cos(ORDERS * angle) - imaginary * np.sin(ORDERS * angle)).sum()
    )


def turn(shape: Numbers, angle: float) -> Numbers:
    """Series `[51]` of three outlines, in axes that are turned by an angle."""
    found = []
    for outline in np.split(shape, OUTLINES):
        real, imaginary = np.split(outline[1:], 2)
        new = (real + 1j * imaginary) * np.exp(1j * ORDERS * angle)
        found.append(np.concatenate((outline[:1], new.real, new.imag)))
    return np.concatenate(found)


def turn_moments(heights: Numbers, angle: float, means: Sequence[float]) -> Numbers:
    """Heights `[12]` with their second moments in axes that are turned by an angle."""
    means, spreads = np.array(means), np.array(HEIGHT_SPREADS)
    xx, yy, xy = (means + spreads * heights)[PRODUCT - 2 : PRODUCT + 1]
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    (xx, xy), (_, yy) = axes @ np.array([[xx, xy], [xy, yy]]) @ axes.T
    found = means + spreads * heights
    found[PRODUCT - 2 : PRODUCT + 1] = xx, yy, xy
    return (found - means) / spreads


def tool_contact(along: float, across: float, outline: Numbers, length: float) -> Numbers:
    """What `ToolContact` says of one object."""
    enters, leaves, gaps, beside = [], [], [], []
    for angle in np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS:
        x, y = np.cos(angle), np.sin(angle)
        gap = -(x * along + y * across) - reach(outline, angle) - TOOL_RADIUS
        if abs(x) < 1e-3:
            beside.append(gap)
            continue
        gaps.append(gap)
        (enters if x < 0 else leaves).append((-gap / x, x, y))
    times = np.array(enters)
    enter, leave = times[:, 0].max(), min(time for time, _, _ in leaves)
    chord = np.clip(-max(beside) if max(beside) > 0 else leave - enter, -0.2, 0.2)
    rest = np.clip(length - enter, -0.1, 0.2)
    hit = float(chord > 0 and rest > 0)
    weights = np.exp((times[:, 0] - enter) / CORNER)
    normal = weights @ times[:, 1:] / weights.sum()
    ways = np.array([np.clip(enter, -0.2, 0.3), rest, rest * hit, max(gaps)]) / PUSH_UNIT
    return np.array([ways[0], chord / DISPLACEMENT_UNIT, ways[1], ways[2], *normal, hit * normal[1], ways[3]])


def carrying(place: Numbers, aim: Numbers, way: float, own: Numbers, other: Numbers) -> Numbers:
    """If an object is carried and another is at `place` from it: the way until they meet, the gap, the push."""
    angle = float(np.arctan2(aim[1], aim[0]))
    along, across = place @ aim, aim[0] * place[1] - aim[1] * place[0]
    meet = along - reach(own, angle) - reach(other, angle + np.pi)
    left = across - reach(own, angle + np.pi / 2) - reach(other, angle - np.pi / 2)
    right = -across - reach(own, angle - np.pi / 2) - reach(other, angle + np.pi / 2)
    gap = max(left, right)
    push = max(way - max(meet, 0.0), 0.0) * (gap < 0 and meet > -0.05)
    return np.array([meet, gap, push])


def next_state(f: ContactDynamics, centers: Numbers, features: Numbers, action: Numbers) -> tuple[Numbers, Numbers]:
    """`centers: [M, 3]` metres, `features: [M, 64]` of real objects, `action: [4]` -> the same after the push."""
    weights = {name: value.detach().double().numpy() for name, value in f.state_dict().items()}

    def layer(name: str, values: Numbers) -> Numbers:
        return weights[f"{name}.weight"] @ values + weights.get(f"{name}.bias", 0.0)

    def connected(name: str, values: Numbers) -> Numbers:
        return np.maximum(layer(f"{name}.0", values), 0.0)

    low, high, clipped = np.array(REACH_LOW), np.array(REACH_HIGH), np.clip(action, -1, 1)
    start = low + (clipped[:2] + 1) / 2 * (high - low)
    motion = np.clip(start + PUSH_UNIT * clipped[2:], low, high) - start
    length = float(np.hypot(*motion))
    direction = motion / length
    phi = float(np.arctan2(motion[1], motion[0]))
    axes = np.array([direction, [-direction[1], direction[0]]])
    places = (centers[:, :2] - start) @ axes.T
    values = features[:, :-1] / (STANDARD_UNIT * np.maximum(features[:, -1:], 0.02))
    typical, spread = (constant.double().numpy()[:PER_OUTLINE] for constant in (TYPICAL, SPREAD))
    inputs, outlines = [], []
    for (along, across), center, value in zip(places, centers, values, strict=True):
        shape = turn(value[:SHAPE], phi)
        outlines.append(typical + spread * shape[:PER_OUTLINE])
        place = along / PUSH_UNIT, across / DISPLACEMENT_UNIT, (along - length) / PUSH_UNIT, length / PUSH_UNIT
        table = (center - np.array(SPACE.origin)) / SPACE.length
        contact = tool_contact(along, across, outlines[-1], length)
        heights = turn_moments(value[SHAPE:], phi, HEIGHT_MEANS) if f.equivariant else value[SHAPE:]
        on_table = table[2:] if f.equivariant else np.concatenate((direction, table))
        inputs.append(np.concatenate((place, shape, heights, on_table, contact)))
    each = [connected("object.1", connected("object.0", one)) for one in inputs]
    moves = [layer("alone", one) for one in each]
    ways = [np.sqrt(max(move @ move, 1e-6)) for move in moves]
    angles = [np.arctan2(move[1], move[0]) for move in moves]
    aims = [np.array([np.cos(angle), np.sin(angle)]) for angle in angles]
    new_centers, new_features = [], []
    for i in range(len(centers)):
        relation = np.zeros(len(weights["relation.0.bias"]))
        for j in range(len(centers)):
            if i == j:
                continue
            way, own_way = DISPLACEMENT_UNIT * ways[j], DISPLACEMENT_UNIT * ways[i]
            theirs = carrying(places[i] - places[j], aims[j], way, outlines[j], outlines[i])
            own = carrying(places[j] - places[i], aims[i], own_way, outlines[i], outlines[j])
            measures = np.concatenate((places[i] - places[j], theirs[2] * aims[j], theirs, own, [own_way, way]))
            pair = layer("pair", measures / DISPLACEMENT_UNIT)
            hidden = np.maximum(layer("own", inputs[i]) + layer("other", inputs[j]) + pair, 0.0)
            relation += connected("relation", hidden)
        move = layer("head", connected("second", np.concatenate((each[i], relation))))[:3]
        move[:2] += moves[i]
        moved = MAXIMUM_DISPLACEMENT * np.tanh(move * DISPLACEMENT_UNIT / MAXIMUM_DISPLACEMENT)
        new_centers.append(centers[i] + np.array([*(moved[:2] @ axes), moved[2]]))
        change = layer("shape_head", connected("shape.1", connected("shape.0", inputs[i])))[:-1]
        heights = turn_moments(change[SHAPE:], -phi, HEIGHTS * [0.0]) if f.equivariant else change[SHAPE:]
        changed = values[i] + np.concatenate((turn(change[:SHAPE], -phi), heights))
        feature = np.array([*(STANDARD_UNIT * changed), 1.0])
        new_features.append(feature / np.sqrt(feature @ feature))
    return np.array(new_centers), np.array(new_features)
