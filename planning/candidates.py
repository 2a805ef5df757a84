"""Plans under way: the one place where planners of all kinds roll out, segment by segment, what is considered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from models.state import State
from planning import fields
from planning.engine import Engine, directly
from planning.extension import extended
from planning.sampling import noise_each, uniform_each
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
    best_only: bool = False  # whether nobody asks for more than the best plan
    engine: Engine = directly  # calls what extends plans from noise by a segment

    @property
    def dimension(self) -> int:
        """D, the numbers of noise per segment."""
        return self.level.dimension

    def begin(self, count: int) -> Candidates:
        """n = `count` plans without a segment yet."""
        plans = self.state.expand_plans(count)
        return Candidates(self, plans, self.score.start(plans))

    def noise(self, count: int) -> Tensor:
        """Standard normal noise of `count` whole plans, with every environment's own generator: `[B, n, K, D]`."""
        return noise_each((count, self.segments, self.dimension), self.generators)

    def draw(self, count: int, *, replacement: bool) -> Candidates:
        """n = `count` whole plans, drawn from the prior a segment at a time. For `replacement` see `evaluate`."""
        return self._whole(count, [None] * self.segments, replacement, None)

    def evaluate(self, noise: Tensor, *, replacement: bool = False, for_best: bool = False) -> Candidates:
        """The plans that `noise: [B, n, k, D]` stands for; their returns are `candidates.returns: [B, n]`.

        With `replacement` plans that die before the last segment become copies of living ones, and go on with the
        noise that was theirs (section 3.2); `candidates.noise` tells what has become of them. With `for_best` an
        environment's plans stay where they are from when none of them can still come to a higher return than the best
        that has ended. The best is the same; the others' returns are of as far as they have come.
        """
        nowhere = torch.zeros(len(noise), dtype=torch.bool, device=noise.device) if for_best else None
        return self._whole(noise.shape[1], noise.unbind(2), replacement, nowhere)

    def _whole(
        self, count: int, noise: Sequence[Tensor | None], replacement: bool, settled: Tensor | None
    ) -> Candidates:
        chances: Sequence[Tensor | None] = [None] * len(noise)
        if replacement and len(noise) > 1:
            # All at once and beforehand: what an environment draws must not depend on when others are settled.
            chances = uniform_each((len(noise), count), self.generators).unbind(1)
        candidates = self.begin(count)
        for number, segment in enumerate(noise, 1):
            if settled is not None and all(settled.tolist()):
                candidates = candidates.rest(segment)
            else:
                candidates, settled = candidates.step(segment, chances[number - 1], settled, last=number == len(noise))
        return candidates


@dataclass(frozen=True)
class Candidates:
    """n plans per environment, k segments long, that can be prolonged, chosen among, joined and taken back.

    What they went through is kept where it was computed, with the numbers that plans had there (`sources`): copies of
    a plan cost nothing.
    """

    search: Search
    plans: State  # [B, n, M, .] where they are
    standing: Any  # fields [B, n]
    kept: tuple[Segment, ...] = ()  # k of them, of [B, R, ...]
    # k of [B, .] int64: for each plan of the next segment (of the last, for each of `plans`) the number of the plan
    # that it goes on from; None where each goes on from itself.
    sources: tuple[Tensor | None, ...] = ()

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

    @cached_property
    def rows(self) -> tuple[Tensor | None, ...]:
        """The numbers that plans had in each segment, k of `[B, n]` int64; None where they have them still."""
        rows: list[Tensor | None] = []
        later: Tensor | None = None
        for source in reversed(self.sources):
            later = later if source is None else source if later is None else source.gather(1, later)
            rows.append(later)
        return tuple(reversed(rows))

    def extend(self, noise: Tensor | None = None) -> Candidates:
        """One segment on, along `noise: [B, n, D]` or along draws from the prior. Plans that have ended stay."""
        return self.step(noise, None, None)[0]

    def step(
        self, noise: Tensor | None, chances: Tensor | None, settled: Tensor | None, *, last: bool = False
    ) -> tuple[Candidates, Tensor | None]:
        """One segment on, and copies of living plans in the place of the dead, chosen by `chances: [B, n]` in [0, 1).

        Without chances, and after the `last` segment, the dead stay. In environments that are `settled: [B]` bool, if
        it is given, all stay; which ones are settled afterwards comes second.
        """
        search, before, number = self.search, self.plans, len(self.kept)
        # Until the first segment all plans are in one state, so the model need not read it n times.
        here = before if self.kept else search.state.expand_plans(1)
        what = search.level, search.score, number, here, before, self.standing, noise, chances, settled
        after = extended(*what, search.generators) if noise is None else search.engine(extended, *what)
        kept = (*self.kept, Segment(noise, after.stretch, after.standing))
        if after.parents is None or last:
            candidates = Candidates(search, after.stretch.states, after.standing, kept, (*self.sources, None))
        else:
            candidates = Candidates(search, after.plans, after.onward, kept, (*self.sources, after.parents))
        return candidates, after.settled

    def rest(self, noise: Tensor | None) -> Candidates:
        """One segment on in which no plan does anything; `noise` is only kept."""
        last = self.kept[-1].stretch
        shape = self.plans.batch_shape
        stretch = Stretch(
            last.code.new_zeros(*shape, last.code.shape[-1]),
            None if last.actions is None else last.actions.new_zeros(*shape, *last.actions.shape[2:]),
            self.plans,
            self.plans.centers.unsqueeze(-3).expand(-1, -1, last.path.shape[-3], -1, -1),
        )
        kept = (*self.kept, Segment(noise, stretch, self.standing))
        return Candidates(self.search, self.plans, self.standing, kept, (*self.sources, None))

    def take(self, numbers: Tensor) -> Candidates:
        """Plans by number, `[B, m]` int64: m plans, copies where a number comes twice."""
        plans, standing = fields.take((self.plans, self.standing), numbers)
        sources = self.sources
        if sources:
            last = sources[-1]
            sources = (*sources[:-1], numbers if last is None else last.gather(1, numbers))
        return Candidates(self.search, plans, standing, self.kept, sources)

    def back(self, segments: int) -> Candidates:
        """The same plans before their last `segments` segments."""
        left = len(self.kept) - segments
        if left == 0:
            return self.search.begin(self.count)
        row, last = self.rows[left - 1], self.kept[left - 1]
        last = last if row is None else fields.take(last, row)
        sources = (*self.sources[: left - 1], row)
        return Candidates(self.search, last.stretch.states, last.standing, self.kept[:left], sources)

    def compact(self) -> Candidates:
        """The same plans, with everything that they went through under their present numbers."""
        pairs = zip(self.kept, self.rows, strict=True)
        kept = tuple(segment if row is None else fields.take(segment, row) for segment, row in pairs)
        return Candidates(self.search, self.plans, self.standing, kept, (None,) * len(kept))

    def at(self, segment: int, read: Callable[[Segment], Tensor]) -> Tensor:
        """What plans went through in one segment: `read` takes `[B, R, ...]` from its record -> `[B, n, ...]`."""
        row, values = self.rows[segment], read(self.kept[segment])
        return values if row is None else values[self._environments, row]

    @cached_property
    def _environments(self) -> Tensor:
        """Numbers of the environments, `[B, 1]`."""
        mask = self.plans.mask
        return torch.arange(len(mask), device=mask.device).unsqueeze(-1)

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
    return Candidates(parts[0].search, plans, standing, kept, (None,) * len(kept))
