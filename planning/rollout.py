"""Candidate plans, rolled out segment by segment, for every planner and every optimizer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import records
from cavin_pyro.planning.backends import Backend, eager
from cavin_pyro.planning.checks import OptimizerError
from cavin_pyro.planning.protocol import Evidence, SearchObjective, SearchSpace, SegmentRollout, TransitionModel, unwrap
from cavin_pyro.planning.returns import Progress
from cavin_pyro.planning.sampling import noise_each, uniform_each


class SegmentRecord(NamedTuple):
    """One segment of R candidates."""

    noise: Tensor | None  # [B, R, D]
    rollout: SegmentRollout
    score_state: Any  # after the segment


def actions_of(segment: SegmentRecord) -> Tensor:
    """The actions `[B, R, T, A]` of a segment, for a search space that has them."""
    assert segment.rollout.actions is not None
    return segment.rollout.actions


def project(actions: Tensor, decimals: int | None) -> Tensor:
    """Actions as they are executed: within [-1, 1], rounded to so many decimals. What is not finite becomes NaN."""
    projected = torch.where(torch.isfinite(actions), actions.clamp(-1.0, 1.0), torch.nan)
    return projected if decimals is None else projected.double().round(decimals=decimals).to(actions.dtype)


def predict_states(
    model: TransitionModel, here: State, actions: Tensor, features: bool = False
) -> tuple[State, Tensor]:
    """T `actions: [B, n, T, A]` from `here: [B, n]` or `[B, 1]`: the last state `[B, n]`, the path `[B, n, T, M, P]`.

    Step by step. `features`: the path has these too, as in `State.values`.
    """
    steps = []
    for action in actions.unbind(-2):
        here = model.next_state(here, action).expand(actions.shape[:2])
        steps.append(here.values(features))
    return here, torch.stack(steps, -3)


class ExtendedSegment(NamedTuple):
    """Candidates after one more segment."""

    rollout: SegmentRollout
    score_state: Any  # after the segment
    ancestors: Tensor | None  # [B, n] int64, if copies of active candidates replace failed ones
    plans: State  # [B, n] after replacement
    next_score_state: Any  # after replacement
    early_stopped: Tensor | None  # [B] bool, see `SearchProblem.evaluate`


def extend_segment(
    space: SearchSpace,
    objective: SearchObjective,
    number: int,
    here: State,
    before: State,
    score_state: Any,
    noise: Tensor | None,
    uniforms: Tensor | None,
    early_stopped: Tensor | None,
    generators: Sequence[torch.Generator] = (),
) -> ExtendedSegment:
    """Roll out segment `number` of candidates in the states `before: [B, n]`; terminated ones stay.

    For `uniforms` and `early_stopped` see `Candidates.extend_and_replace`, for `here` see `SearchSpace.extend`. The
    `generators` are used without noise only.
    """
    rollout = space.extend(number, here, before, noise, generators)
    going = score_state.active
    if early_stopped is not None:
        going = going & ~early_stopped.unsqueeze(-1)
        nothing = records.apply((rollout.code, rollout.actions), torch.zeros_like)
        code, actions = records.where(early_stopped, nothing, (rollout.code, rollout.actions))
        rollout = rollout._replace(code=code, actions=actions)
    rollout = _stay(rollout, before, going)
    after = objective.advance(score_state, number, before, rollout)
    failed = after.failed
    if early_stopped is not None:
        after, failed = records.where(early_stopped, score_state, after), failed & ~early_stopped.unsqueeze(-1)
        early_stopped = objective.early_stopped(after)
    if uniforms is None:
        return ExtendedSegment(rollout, after, None, rollout.states, after, early_stopped)
    ancestors = choose_ancestors(failed, after.active, uniforms)
    return ExtendedSegment(rollout, after, ancestors, *records.take((rollout.states, after), ancestors), early_stopped)


def has_features(rollout: SegmentRollout) -> bool:
    """Whether its path records features as well."""
    return rollout.path.shape[-1] > rollout.states.centers.shape[-1]


def _stay(rollout: SegmentRollout, before: State, active: Tensor) -> SegmentRollout:
    """Keep the states of terminated candidates, those outside `active: [B, n]`."""
    going = active[..., None, None]
    states = State(
        torch.where(going, rollout.states.centers, before.centers),
        torch.where(going, rollout.states.features, before.features),
        rollout.states.mask,
    )
    stays = before.values(has_features(rollout)).unsqueeze(-3)
    path = torch.where(going.unsqueeze(-1), rollout.path, stays)
    return rollout._replace(states=states, path=path)


def choose_ancestors(failed: Tensor, active: Tensor, uniforms: Tensor) -> Tensor:
    """The ancestor of every candidate, the index of the candidate that it continues: `[B, N]` int64.

    "Episodes which fail early will be replaced by duplicating episodes that are still active" (section 3.2).
    `failed`, `active`: `[B, N]` bool. `uniforms`: `[B, N]`, uniform in [0, 1). A failed candidate continues an active
    one, all equally likely; every other candidate continues itself, successful ones too. An environment without an
    active candidate keeps all of its candidates.
    """
    own = torch.arange(failed.shape[-1], device=failed.device).expand_as(failed)
    actives = active.cumsum(-1)  # counts active candidates up to and including each
    count = actives[:, -1:]
    rank = (uniforms * count).long().clamp(max=(count - 1).clamp(min=0))  # a product may be rounded up to its factor
    ancestors = torch.searchsorted(actives, rank + 1).clamp(max=failed.shape[-1] - 1)
    return torch.where(failed & (count > 0), ancestors, own)


@dataclass(frozen=True)
class SearchProblem:
    """A search for plans of K segments from `state: [B]`, the argument of an optimizer.

    An optimizer needs `noise`, `generators` and the call itself: noise `[B, n, K, D]` in, returns `[B, n]` out.
    `evaluate` and `sample` also replace failed candidates; with `begin` an optimizer extends candidates segment by
    segment. `evaluated` collects all evaluated candidates, from which the planner chooses.
    """

    space: SearchSpace
    objective: SearchObjective
    state: State
    generators: Sequence[torch.Generator]  # one per environment
    segments: int  # K
    reparameterized: bool = False  # force reparameterised sampling (needed by early stopping and compilation)
    early_stopping: bool = False  # whether a search may stop when no candidate can become the best
    backend: Backend = eager  # runs the extension of reparameterised candidates
    evaluated: list[Candidates] = field(default_factory=list, init=False, compare=False)  # whole candidates
    evidence: list[Evidence] = field(default_factory=list, init=False, compare=False)  # of optimizers that estimate it

    def __call__(self, noise: Tensor) -> Tensor:
        """The returns `[B, n]` of the candidates that standard normal `noise: [B, n, K, D]` determines.

        Raises OptimizerError for noise of another shape, or with NaN.
        """
        environments, segments, dimension = len(self.generators), self.segments, self.dimension
        fits = noise.ndim == 4 and (noise.shape[0], *noise.shape[2:]) == (environments, segments, dimension)
        if not fits or noise.isnan().any():
            raise OptimizerError(
                f"candidates must be noise [B, n, K, D] = [{environments}, n, {segments}, {dimension}], "
                f"not {list(noise.shape)}{' with NaN' if fits else ''}"
            )
        return self.evaluate(noise).returns

    @property
    def dimension(self) -> int:
        """D, the dimension of the noise per segment."""
        return self.space.dimension

    @property
    def device(self) -> torch.device:
        """Where the candidates are, and where all numbers go that are sampled with the generators."""
        return self.state.centers.device

    def noise(self, count: int) -> Tensor:
        """Standard normal noise `[B, n, K, D]` of n = `count` candidates, from every environment's own generator."""
        return noise_each((count, self.segments, self.dimension), self.generators, self.device)

    def sample(self, count: int, *, replacement: bool) -> Candidates:
        """n = `count` whole candidates, sampled from the prior segment by segment; for `replacement` see `evaluate`."""
        return self._roll_out(count, [None] * self.segments, replacement, None)

    def evaluate(self, noise: Tensor, *, replacement: bool = False, early_stopping: bool = False) -> Candidates:
        """The candidates that `noise: [B, n, k, D]` determines; their returns are `candidates.returns: [B, n]`.

        `replacement`: candidates that fail before the last segment become copies of active ones, and continue with
        their own noise (section 3.2); `candidates.noise` is the noise after replacement. `early_stopping`: an
        environment's rollouts stop when no active candidate can still reach a higher return than the best terminated
        one. The best candidate is the same; the others' returns are counted up to where their rollouts stopped.
        """
        early_stopped = torch.zeros(len(noise), dtype=torch.bool, device=noise.device) if early_stopping else None
        return self._roll_out(noise.shape[1], noise.unbind(2), replacement, early_stopped)

    def begin(self, count: int) -> Candidates:
        """n = `count` candidates without a segment. Call `add_candidates` with their extensions."""
        plans = self.state.expand_plans(count)
        return Candidates(self, plans, self.objective.start(plans))

    def add_candidates(self, candidates: Candidates) -> None:
        """Add whole candidates, from which the planner then also chooses."""
        self.evaluated.append(candidates)

    def pop_candidates(self) -> Candidates:
        """Remove and return all whole candidates so far, in order (they refer to this problem).

        Raises OptimizerError if there are none.
        """
        if not self.evaluated:
            raise OptimizerError("it has evaluated no candidate, call problem(noise) at least once")
        candidates = join(self.evaluated)
        self.evaluated.clear()
        return candidates

    def _roll_out(
        self, count: int, noise: Sequence[Tensor | None], replacement: bool, early_stopped: Tensor | None
    ) -> Candidates:
        uniforms: Sequence[Tensor | None] = [None] * len(noise)
        if replacement and len(noise) > 1:
            # All at once, beforehand: an environment's random numbers must not depend on when others stop early.
            uniforms = uniform_each((len(noise), count), self.generators, self.device).unbind(1)
        candidates = self.begin(count)
        for number, (segment, uniform) in enumerate(zip(noise, uniforms, strict=True), 1):
            if early_stopped is not None and all(early_stopped.tolist()):
                candidates = candidates.stay(segment)
            else:
                last = number == len(noise)
                candidates, early_stopped = candidates.extend_and_replace(segment, uniform, early_stopped, last=last)
        self.add_candidates(candidates)
        return candidates


@dataclass(frozen=True)
class Candidates:
    """n candidates per environment, k segments long: extend, select, concatenate and truncate them.

    Each segment is stored once, under the indices of its candidates then; `ancestors` map the indices from one segment
    to the next. Copies of a candidate cost nothing.
    """

    problem: SearchProblem
    plans: State  # [B, n, M, .] their last states
    score_state: Any  # fields [B, n]
    segments: tuple[SegmentRecord, ...] = ()  # k of them, of [B, R, ...]
    # k of [B, .] int64: for each candidate of the next segment (after the last, for each of `plans`) the index of
    # its ancestor; None if the indices do not change.
    ancestors: tuple[Tensor | None, ...] = ()

    @property
    def count(self) -> int:
        """n."""
        return self.plans.batch_shape[-1]

    @property
    def returns(self) -> Tensor:
        """`[B, n]`, the higher the better."""
        return self.score_state.returns

    @property
    def progress(self) -> Progress:
        """Their cumulative reward, fields `[B, n]`, of a search by reward."""
        return unwrap(self.score_state, Progress)

    @property
    def codes(self) -> Tensor:
        """`[B, n, k, D]` effect or motion codes, or the concatenated actions of each segment."""
        return self.history(lambda segment: segment.rollout.code)

    @property
    def actions(self) -> Tensor:
        """`[B, n, k T, A]`, for a search space that has actions."""
        return self.history(actions_of).flatten(2, 3)

    @property
    def path(self) -> Tensor:
        """`[B, n, k T, M, P]` the predicted centres after every step."""
        size = self.plans.centers.shape[-1]
        return self.history(lambda segment: segment.rollout.path[..., :size]).flatten(2, 3)

    @property
    def centers(self) -> Tensor:
        """`[B, n, k, M, P]` the predicted centres at the end of every segment."""
        return self.history(lambda segment: segment.rollout.states.centers)

    @property
    def states(self) -> State:
        """`[B, n, k, M, .]` the predicted states at the end of every segment."""
        features = self.history(lambda segment: segment.rollout.states.features)
        mask = self.plans.mask.unsqueeze(2).expand(-1, -1, len(self.segments), -1)  # real objects stay real
        return State(self.centers, features, mask)

    @property
    def noise(self) -> Tensor:
        """`[B, n, k, D]`; only for reparameterised candidates."""
        return self.history(attrgetter("noise"))

    @cached_property
    def rows(self) -> tuple[Tensor | None, ...]:
        """The indices of the candidates in each segment, k of `[B, n]` int64; None if they did not change since."""
        rows: list[Tensor | None] = []
        later: Tensor | None = None
        for ancestor in reversed(self.ancestors):
            later = later if ancestor is None else ancestor if later is None else ancestor.gather(1, later)
            rows.append(later)
        return tuple(reversed(rows))

    def extend(self, noise: Tensor | None = None) -> Candidates:
        """One more segment, from `noise: [B, n, D]` or sampled from the prior. Terminated candidates stay."""
        return self.extend_and_replace(noise, None, None)[0]

    def extend_and_replace(
        self, noise: Tensor | None, uniforms: Tensor | None, early_stopped: Tensor | None, *, last: bool = False
    ) -> tuple[Candidates, Tensor | None]:
        """One more segment; then copies of active candidates, by `uniforms: [B, n]` in [0, 1), replace failed ones.

        Without `uniforms`, and after the `last` segment, failed candidates stay. In
        `early_stopped: [B]` environments, if given, all stay. Also returns the environments that have stopped by then.
        """
        problem, before, number = self.problem, self.plans, len(self.segments)
        # In the first segment all candidates start from one state, which the model reads once.
        here = before if self.segments else problem.state.expand_plans(1)
        run, generators = (eager, problem.generators) if noise is None else (problem.backend, ())
        after = run(
            extend_segment,
            problem.space,
            problem.objective,
            number,
            here,
            before,
            self.score_state,
            noise,
            uniforms,
            early_stopped,
            generators,
        )
        segments = (*self.segments, SegmentRecord(noise, after.rollout, after.score_state))
        ancestors = None if last else after.ancestors
        plans, score_state = after.plans, after.next_score_state
        if ancestors is None:
            plans, score_state = after.rollout.states, after.score_state
        return Candidates(problem, plans, score_state, segments, (*self.ancestors, ancestors)), after.early_stopped

    def stay(self, noise: Tensor | None) -> Candidates:
        """One more segment in which no candidate moves; `noise` is only recorded."""
        last = self.segments[-1].rollout
        shape = self.plans.batch_shape
        rollout = SegmentRollout(
            last.code.new_zeros(*shape, last.code.shape[-1]),
            None if last.actions is None else last.actions.new_zeros(*shape, *last.actions.shape[2:]),
            self.plans,
            self.plans.values(has_features(last)).unsqueeze(-3).expand(-1, -1, last.path.shape[-3], -1, -1),
        )
        segments = (*self.segments, SegmentRecord(noise, rollout, self.score_state))
        return Candidates(self.problem, self.plans, self.score_state, segments, (*self.ancestors, None))

    def take(self, indices: Tensor) -> Candidates:
        """The candidates `indices: [B, m]` int64; a repeated index gives copies."""
        plans, score_state = records.take((self.plans, self.score_state), indices)
        ancestors = self.ancestors
        if ancestors:
            last = ancestors[-1]
            ancestors = (*ancestors[:-1], indices if last is None else last.gather(1, indices))
        return Candidates(self.problem, plans, score_state, self.segments, ancestors)

    def back(self, segments: int) -> Candidates:
        """The same candidates before their last `segments` segments."""
        left = len(self.segments) - segments
        if left == 0:
            return self.problem.begin(self.count)
        row, last = self.rows[left - 1], self.segments[left - 1]
        last = last if row is None else records.take(last, row)
        ancestors = (*self.ancestors[: left - 1], row)
        return Candidates(self.problem, last.rollout.states, last.score_state, self.segments[:left], ancestors)

    def compact(self) -> Candidates:
        """The same candidates, with every segment stored under their current indices."""
        pairs = zip(self.segments, self.rows, strict=True)
        segments = tuple(segment if row is None else records.take(segment, row) for segment, row in pairs)
        return Candidates(self.problem, self.plans, self.score_state, segments, (None,) * len(segments))

    def at(self, segment: int, read: Callable[[SegmentRecord], Tensor]) -> Tensor:
        """A field of one segment for every candidate: `read` gets `[B, R, ...]` from the record -> `[B, n, ...]`."""
        row, values = self.rows[segment], read(self.segments[segment])
        return values if row is None else values[self._environments, row]

    @cached_property
    def _environments(self) -> Tensor:
        """Indices of the environments, `[B, 1]`."""
        mask = self.plans.mask
        return torch.arange(len(mask), device=mask.device).unsqueeze(-1)

    def history(self, read: Callable[[SegmentRecord], Tensor]) -> Tensor:
        """The same field for all k segments: `[B, n, k, ...]`."""
        return torch.stack([self.at(segment, read) for segment in range(len(self.segments))], dim=2)


def join(parts: Sequence[Candidates]) -> Candidates:
    """Concatenate candidates of one problem and one length: `[B, n_1], [B, n_2], ... -> [B, n_1 + ...]`."""
    if len(parts) == 1:
        return parts[0]
    compact = [part.compact() for part in parts]
    segments = tuple(records.join(same) for same in zip(*(part.segments for part in compact), strict=True))
    score_state = records.join([part.score_state for part in parts])
    plans = records.join([part.plans for part in parts])
    return Candidates(parts[0].problem, plans, score_state, segments, (None,) * len(segments))
