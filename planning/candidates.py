"""Plans under way: the one place where planners of all kinds roll out, segment by segment, what is considered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from models.state import State
from planning import fields
from planning.engine import Engine, directly
from planning.replacement import draw_parents
from planning.sampling import noise_each
from planning.segments import Level, Score, Segment, Stretch


@dataclass(frozen=True)
class Search:
    """A search for plans of K segments from `state: [B]`; all that an optimiser is given."""

    level: Level
    score: Score
    state: State
    generators: Sequence[torch.Generator]
    segments: int
    from_noise: bool = False  # whether plans have to be made from noise, for who remembers or compiles
    hints: Tensor | None = None  # [B, h, K, D] noise of plans that may be good, for optimisers with a memory
    engine: Engine = directly  # calls what extends plans from noise by a segment

    @property
    def dimension(self) -> int:
        """D, the numbers of noise per segment."""
        return self.level.dimension(self.state)

    def begin(self, count: int) -> Candidates:
        """n = `count` plans without a segment yet."""
        plans = self.state.expand_plans(count)
        return Candidates(self, plans, self.score.start(plans))

    def noise(self, count: int) -> Tensor:
        """Standard normal noise of `count` whole plans, with every environment's own generator: `[B, n, K, D]`."""
        return noise_each((count, self.segments, self.dimension), self.generators)

    def draw(self, count: int, *, replacement: bool) -> Candidates:
        """n = `count` whole plans, drawn from the prior a segment at a time. For `replacement` see `evaluate`."""
        return self._whole(count, [None] * self.segments, replacement)

    def evaluate(self, noise: Tensor, *, replacement: bool = False) -> Candidates:
        """The plans that `noise: [B, n, k, D]` stands for; their returns are `candidates.returns: [B, n]`.

        With `replacement` plans that die before the last segment become copies of living ones, and go on with the
        noise that was theirs (section 3.2); `candidates.noise` tells what has become of them.
        """
        return self._whole(noise.shape[1], noise.unbind(2), replacement)

    def _whole(self, count: int, noise: Sequence[Tensor | None], replacement: bool) -> Candidates:
        candidates = self.begin(count)
        for number, segment in enumerate(noise, 1):
            candidates = candidates.extend(segment)
            standing = candidates.standing
            # After the last segment nobody goes on in the place of the dead.
            if replacement and number < len(noise) and bool(standing.failed.any()):
                candidates = candidates.take(draw_parents(standing.failed, standing.active, self.generators))
        return candidates


@dataclass(frozen=True)
class Candidates:
    """n plans per environment, k segments long, that can be prolonged, chosen among, joined and taken back.

    What they went through is kept where it was computed, with a number per plan and segment (`rows`): copies
    of a plan cost nothing.
    """

    search: Search
    plans: State  # [B, n, M, .] where they are
    standing: Any  # fields [B, n]
    kept: tuple[Segment, ...] = ()  # k of them, of [B, R, ...]
    rows: tuple[Tensor, ...] = ()  # k of [B, n] int64: the number that a plan has there

    @property
    def count(self) -> int:
        """n."""
        return self.plans.batch_shape[-1]

    @property
    def returns(self) -> Tensor:
        """`[B, n]`, the higher the better."""
        return self.standing.returns

    @property
    def noise(self) -> Tensor:
        """`[B, n, k, D]`; only of plans that were made from noise."""

        def noise_of(segment: Segment) -> Tensor:
            assert segment.noise is not None
            return segment.noise

        return self.history(noise_of)

    def extend(self, noise: Tensor | None = None) -> Candidates:
        """One segment on, along `noise: [B, n, D]` or along draws from the prior. Plans that have ended stay."""
        search, before, number = self.search, self.plans, len(self.kept)
        # Until the first segment all plans are in one state, so the model need not read it n times.
        here = before if self.kept else search.state.expand_plans(1)
        what = search.level, search.score, number, here, before, self.standing, noise
        stretch, standing = _extended(*what, search.generators) if noise is None else search.engine(_extended, *what)
        own = torch.arange(self.count, device=before.mask.device).expand(before.batch_shape)
        kept = (*self.kept, Segment(noise, stretch, standing))
        return Candidates(search, stretch.states, standing, kept, (*self.rows, own))

    def take(self, numbers: Tensor) -> Candidates:
        """Plans by number, `[B, m]` int64: m plans, copies where a number comes twice."""
        rows = tuple(row.gather(1, numbers) for row in self.rows)
        standing = fields.take(self.standing, numbers)
        return Candidates(self.search, self.plans.take_plans(numbers), standing, self.kept, rows)

    def back(self, segments: int) -> Candidates:
        """The same plans before their last `segments` segments."""
        left = len(self.kept) - segments
        if left == 0:
            return self.search.begin(self.count)
        last = fields.take(self.kept[left - 1], self.rows[left - 1])
        return Candidates(self.search, last.stretch.states, last.standing, self.kept[:left], self.rows[:left])

    def compact(self) -> Candidates:
        """The same plans, with everything that they went through under their present numbers."""
        own = torch.arange(self.count, device=self.plans.mask.device).expand(self.plans.batch_shape)
        kept = tuple(
            segment if row.shape == own.shape and torch.equal(row, own) else fields.take(segment, row)
            for segment, row in zip(self.kept, self.rows, strict=True)
        )
        return Candidates(self.search, self.plans, self.standing, kept, (own,) * len(kept))

    def at(self, segment: int, read: Callable[[Segment], Tensor]) -> Tensor:
        """What plans went through in one segment: `read` takes `[B, R, ...]` from its record -> `[B, n, ...]`."""
        row = self.rows[segment]
        return read(self.kept[segment])[torch.arange(len(row), device=row.device).unsqueeze(-1), row]

    def history(self, read: Callable[[Segment], Tensor]) -> Tensor:
        """The same of all k segments: `[B, n, k, ...]`."""
        return torch.stack([self.at(segment, read) for segment in range(len(self.kept))], dim=2)


def join(parts: Sequence[Candidates]) -> Candidates:
    """Plans of one search and of one length, one after the other: `[B, n_1], [B, n_2], ... -> [B, n_1 + ...]`."""
    if len(parts) == 1:
        return parts[0]
    compact = [part.compact() for part in parts]
    kept = tuple(fields.join(segments) for segments in zip(*(part.kept for part in compact), strict=True))
    standing = fields.join([part.standing for part in parts])
    plans = fields.join([part.plans for part in parts])
    own = torch.arange(plans.batch_shape[-1], device=plans.mask.device).expand(plans.batch_shape)
    return Candidates(parts[0].search, plans, standing, kept, (own,) * len(kept))


def _extended(
    level: Level,
    score: Score,
    number: int,
    here: State,
    before: State,
    standing: Any,
    noise: Tensor | None,
    generators: Sequence[torch.Generator] = (),
) -> tuple[Stretch, Any]:
    """Segment `number` of plans that have come to `before: [B, n]`, and how they stand after it.

    `here`: see `Level.extend`. The `generators` are read where there is no noise.
    """
    stretch = level.extend(number, here, before, noise, generators)
    stretch = _stay(stretch, before, standing.active)
    return stretch, score.advance(standing, number, before, stretch)


def _stay(stretch: Stretch, before: State, active: Tensor) -> Stretch:
    """Keep plans where they are that have ended: not `active: [B, n]`; no copy where all go on."""
    if not torch.compiler.is_compiling() and bool(active.all()):
        return stretch
    going = active[..., None, None]
    states = State(
        torch.where(going, stretch.states.centers, before.centers),
        torch.where(going, stretch.states.features, before.features),
        stretch.states.mask,
    )
    path = torch.where(going.unsqueeze(-1), stretch.path, before.centers.unsqueeze(-3))
    return stretch._replace(states=states, path=path)
