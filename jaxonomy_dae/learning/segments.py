"""The horizon of each experiment cut into segments: where samples lie, where nodes are, and the rows of least squares
at a point."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .block_elimination import Blocks, condensed
from .evaluation import Evaluation
from .objective import Objective
from .program import Conditions, Owns, Shared
from .shooting_program import Cut, Ran, first_states, on_constraints, run_segments

ITERATIONS = 8  # Gauss–Newton steps onto the constraints


@dataclasses.dataclass(frozen=True)
class Point:
    """All unknowns, and what the programs found there; nothing is weighted."""

    z: Float[np.ndarray, " f"]  # the coordinates that are searched
    states: Float[np.ndarray, "e N n"]  # at the nodes, consistent
    bases: Float[np.ndarray, "e N n d"]  # in which nodes move
    blocks: Blocks


@dataclasses.dataclass(frozen=True)
class Segments:
    """The experiments that count, each cut into segments of the same duration."""

    objective: Objective
    count: int  # of segments

    @functools.cached_property
    def experiments(self) -> Int[np.ndarray, " e"]:
        """The experiments that count."""
        return np.unique(self.objective.rows[0])

    @functools.cached_property
    def nodes(self) -> Float[np.ndarray, "e _"]:
        """The times at which segments begin, and the last time."""
        s = self.objective.stacked
        first, last = s.t0[self.experiments, None], s.times[self.experiments, -1:]
        inner = first + (last - first) * np.arange(self.count) / self.count
        return np.concatenate([inner, last], axis=1)

    @functools.cached_property
    def _placed(self) -> tuple[Float[np.ndarray, "e N l"], tuple[np.ndarray, ...]]:
        """The times of each segment, from its start to its end, and (experiment, segment, row, output) of each sample
        that counts. A sample at a node is the last of a segment."""
        s, (experiment, index, output) = self.objective.stacked, self.objective.rows
        times, where = [], np.zeros((len(self.experiments), s.times.shape[1], 2), int)
        for e, nodes in zip(self.experiments, self.nodes, strict=True):
            own = s.times[e, : s.counts[e]]
            segment = np.searchsorted(nodes[1:-1], own, side="left")
            times.append([own[segment == k] for k in range(self.count)])
            row = np.arange(len(own)) - np.searchsorted(segment, segment, side="left")
            where[len(times) - 1, : len(own)] = np.stack([segment, 1 + row], axis=1)
        room = 2 + max(len(own) for by_segment in times for own in by_segment)
        padded = np.repeat(self.nodes[:, 1:, None], room, axis=2)
        padded[:, :, 0] = self.nodes[:, :-1]
        for e, by_segment in enumerate(times):
            for k, own in enumerate(by_segment):
                padded[e, k, 1 : 1 + len(own)] = own
        place = np.searchsorted(self.experiments, experiment)
        segment, row = where[place, index].T
        return padded, (place, segment, row, output)

    @property
    def samples(self) -> tuple[np.ndarray, ...]:
        """(experiment, segment, row, output) of each sample that counts."""
        return self._placed[1]

    @functools.cached_property
    def cut(self) -> Cut:
        """The conditions of all segments, for the programs."""
        c, dtype = self.objective.conditions, self.objective.system.parameters.values.dtype
        chosen = self.experiments
        inputs = {n: (t[chosen], v[chosen]) for n, (t, v) in c.inputs.items()}
        return Cut(jnp.asarray(self._placed[0], dtype), jnp.asarray(self.nodes[:, :-1], dtype), c.known[chosen], inputs)

    @functools.cached_property
    def columns(self) -> tuple[Int[np.ndarray, "e q"], Bool[np.ndarray, "e q"]]:
        """For the q numbers common to an experiment's segments, shared and its own: (their places among the coordinates
        that are searched, which of them are searched)."""
        c, free = self.objective.coordinates, self.objective.free
        own = c.n_shared + self.experiments[:, None] * c.n_own + np.arange(c.n_own)
        shared = np.broadcast_to(np.arange(c.n_shared), (len(own), c.n_shared))
        full = np.concatenate([shared, own], axis=1)
        place = np.cumsum(free) - 1
        return place[full], free[full]

    def common(self, z: Float[np.ndarray, " f"]) -> Float[np.ndarray, "e q"]:
        """The entries of an array by coordinates that are searched, by experiment; zero for others."""
        place, searched = self.columns
        return np.where(searched, z[place] if len(z) else 0.0, 0.0)

    def spread_out(self, rows: Float[np.ndarray, "e r q"]) -> Float[np.ndarray, "rows f"]:
        """Rows by experiment with the columns of all coordinates that are searched."""
        place, searched = self.columns
        out = np.zeros((*rows.shape[:2], int(self.objective.free.sum())))
        for e in range(len(rows)):
            out[e][:, place[e, searched[e]]] = rows[e][:, searched[e]]
        return out.reshape(-1, out.shape[-1])

    @functools.cached_property
    def moving(self) -> tuple[int, ...]:
        """The numbers common to segments that act on all of them: starts of variables act on the first segment
        alone."""
        layout, table = self.objective.layout, self.objective.system.parameters.table
        first, names = self.objective.coordinates.n_shared, set(table.names)
        plain = first - len(layout.shared)
        starts = [plain + k for k, name in enumerate(layout.shared) if name in names]
        own = [first + k for k, name in enumerate(layout.own) if name in names]
        return (*range(plain), *starts, *own)

    def by_sample(self, row: Float[np.ndarray, " m"]) -> Float[np.ndarray, "e N lk"]:
        """Weights of samples as the blocks have them: zero where there is none."""
        e, n, room = self._placed[0].shape
        out = np.zeros((e, n, room, len(self.objective.layout.outputs)))
        out[self.samples] = row
        return out.reshape(e, n, -1)

    # --- at a point --------------------------------------------------------------------------------------------

    def _numbers(self, z: Float[np.ndarray, " f"]) -> tuple[Shared, Owns]:
        c = self.objective.coordinates
        shared, own = self.objective.numbers(c.natural(self.objective.full(z)))
        return shared, own[self.experiments]

    def _slopes(self, z: Float[np.ndarray, " f"]) -> Float[np.ndarray, "e q"]:
        """d(natural value)/d(coordinate); zero for those that are not searched."""
        return self.common(self.objective.coordinates.slope(self.objective.full(z))[self.objective.free])

    def first(self, z: Float[np.ndarray, " f"]) -> tuple[np.ndarray, np.ndarray] | None:
        """The states at which experiments start, shape (e, n), and their derivatives, shape (e, n, q)."""
        o, c = self.objective, self.cut
        shared, own = self._numbers(z)
        start = Conditions(c.times[:, 0], c.t0[:, 0], c.known, c.inputs)
        found = first_states(o.setting, shared, own, start)
        x, by_shared, by_own = (np.asarray(a, np.float64) for a in found)
        with np.errstate(invalid="ignore", over="ignore"):
            slope = np.concatenate([by_shared, by_own], axis=-1) * self._slopes(z)[:, None]
        return (x, slope) if np.isfinite(x).all() and np.isfinite(slope).all() else None

    def evaluate(
        self, z: Float[np.ndarray, " f"], states: Float[np.ndarray, "e N n"], size: Float[np.ndarray, " n"]
    ) -> Point | None:
        """Everything at a point; `states[:, 0]` is not read. `size` is of the states, in which gaps and moves are
        measured. None where a segment cannot be run."""
        first = self.first(z)
        if first is None:
            return None
        states = np.concatenate([first[0][:, None], states[:, 1:]], axis=1)
        ran_all = self._run(z, states, size)
        if ran_all is None:
            return None
        directions, (ran, slopes) = ran_all
        o, q, n_first = self.objective, self._slopes(z), len(self.objective.system.plan.states)
        e, n, room, k = ran.outputs.shape

        count = len(self.moving)

        def common(name: str) -> np.ndarray:
            found = np.asarray(getattr(slopes, name), np.float64)
            out = np.zeros((*found.shape[:-1], q.shape[1]))
            out[..., list(self.moving)] = found[..., :count]
            with np.errstate(invalid="ignore", over="ignore"):
                return out * q.reshape(e, *(1,) * (found.ndim - 2), -1)

        def node(name: str) -> np.ndarray:
            return np.asarray(getattr(slopes, name), np.float64)[..., count:]

        outputs = np.asarray(ran.outputs, np.float64)
        data = np.zeros((e, n, room, k))
        data[self.samples] = outputs[self.samples] - o.stacked.values[o.rows]
        seen = np.zeros((e, n, room, k), bool)
        seen[self.samples] = True
        shape = (e, n, room * k)

        def at_samples(slopes: np.ndarray) -> np.ndarray:
            return np.where(seen[..., None], slopes, 0.0).reshape(*shape, slopes.shape[-1])

        # Algebraic unknowns follow from the differential states, and so do their gaps.
        scale = size[:n_first, None]
        start, end = np.asarray(ran.start, np.float64), np.asarray(ran.end, np.float64)
        gap = (end[:, :-1] - start[:, 1:])[..., :n_first] / scale[:, 0]
        ends, starts = ({"c": common(s)[:, :, :n_first], "d": node(s)[:, :, :n_first]} for s in ("end", "start"))
        # At constant coefficients, parameters move a projected state off its tangent space.
        along = first[1][:, :n_first] - starts["c"][:, 0]
        blocks = Blocks(
            residual=data.reshape(shape),
            by_node=at_samples(node("outputs")),
            by_common=at_samples(common("outputs")),
            gap=gap,
            leave=ends["d"][:, :-1] / scale,
            arrive=starts["d"][:, 1:] / scale,
            gap_by_common=(ends["c"][:, :-1] - starts["c"][:, 1:]) / scale,
            first=np.linalg.pinv(directions[:, 0, :n_first]) @ along,
        )
        if not all(np.isfinite(a).all() for a in dataclasses.asdict(blocks).values()):
            return None
        return Point(z, start, directions, blocks)

    def _run(
        self, z: Float[np.ndarray, " f"], states: Float[np.ndarray, "e N n"], size: Float[np.ndarray, " n"]
    ) -> tuple[np.ndarray, tuple[Ran, Ran]] | None:
        """The directions in which nodes move, and all segments run from states near the constraints."""
        o, (shared, own) = self.objective, self._numbers(z)
        states, directions = self._moves(shared, own, states, size)
        if not np.isfinite(states).all() or not np.isfinite(directions).all():
            return None
        x, bases = jnp.asarray(states, shared.dtype), jnp.asarray(directions, shared.dtype)
        return directions, run_segments(o.setting, self.moving, shared, own, x, bases, self.cut)

    def ends(self, z: Float[np.ndarray, " f"], states: Float[np.ndarray, "e N n"]) -> Float[np.ndarray, "e N n"]:
        """The states at the ends of segments that begin at `states`; NaN where a run fails."""
        found = self._run(z, states, np.ones(states.shape[-1]))
        return np.full_like(states, np.nan) if found is None else np.asarray(found[1][0].end, np.float64)

    def _moves(
        self, shared: Shared, own: Owns, states: Float[np.ndarray, "e N n"], size: Float[np.ndarray, " n"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The states on the constraints, and at each of them directions that keep to these, orthonormal in units of
        `size`, shape (e, N, n, d)."""
        o = self.objective
        n, f = len(size), len(o.system.plan.states)
        if not o.system.is_constrained:
            return states, np.broadcast_to(np.diag(size), (*states.shape, n))
        found = on_constraints(o.setting, ITERATIONS, shared, own, jnp.asarray(states, shared.dtype), self.cut)
        states, slope = (np.asarray(a, np.float64) for a in found)
        if not np.isfinite(slope).all():
            return states, slope
        # A projection's trace is its rank: how many degrees of freedom there are.
        rank = int(np.round(np.median(np.trace(slope[..., :f, :], axis1=-2, axis2=-1))))
        left = np.linalg.svd(slope[..., :f, :] / size[:f, None])[0][..., :rank]
        return states, np.concatenate([left * size[:f, None], np.zeros((*states.shape[:2], n - f, rank))], axis=2)

    def evaluation(self, point: Point) -> Evaluation:
        """Residuals, and their Jacobian by the coordinates that are searched where continuity holds, as single shooting
        has them."""
        e, n, _ = point.blocks.residual.shape
        k = len(self.objective.layout.outputs)
        place, segment, row, output = self.samples
        slopes = condensed(point.blocks).reshape(e, n, -1, k, point.blocks.by_common.shape[-1])[self.samples]
        jacobian = np.zeros((len(slopes), int(self.objective.free.sum())))
        column, searched = self.columns
        for one in range(e):
            mine = np.flatnonzero(place == one)
            jacobian[np.ix_(mine, column[one, searched[one]])] = slopes[mine][:, searched[one]]
        return Evaluation(point.blocks.residual.reshape(e, n, -1, k)[self.samples], jacobian)
