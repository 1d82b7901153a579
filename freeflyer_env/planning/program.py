"""The convex program that the backends solve, and how good a solution of it is."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from freeflyer_env.planning.trajectory import Trajectory
from freeflyer_env.robot import FloatArray


class SolverStatus(enum.Enum):
    """What a solver said of one convex program."""

    SOLVED = "solved"
    INFEASIBLE = "infeasible"
    FAILED = "failed"


@dataclass(eq=False)
class Balls:
    """Second-order cone constraints ``||K_i x - k_i||_2 <= radius`` of equal dimension ``d``.

    Attributes:
        k: ``(n_balls * d, n)`` the stacked ``K_i``.
        centres: ``(n_balls, d)`` the ``k_i``.
        radius: The common radius.
    """

    k: sparse.csc_matrix
    centres: FloatArray
    radius: float = np.inf


@dataclass(eq=False)
class ConvexProgram:
    """``min c'x  s.t.  A x = b,  h_lower <= G x <= h_upper,  x_lower <= x <= x_upper``, and balls.

    The patterns of all matrices, the values of ``a`` and of ``balls.k``, and which limits are
    infinite never change once the program was given to a backend; everything else may be
    overwritten between solves.
    """

    c: FloatArray
    a: sparse.csc_matrix
    b: FloatArray
    g: sparse.csc_matrix
    h_lower: FloatArray
    h_upper: FloatArray
    x_lower: FloatArray
    x_upper: FloatArray
    balls: Balls | None = None

    @cached_property
    def transposes(self) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
        """Of ``A`` and ``G``; they share the values, also those that are written later."""
        return self.a.transpose(copy=False), self.g.transpose(copy=False)


@dataclass(frozen=True, eq=False)
class Solution:
    """What a backend found.

    The multipliers are those of the Lagrangian ``c'x + y'(Ax - b) + z'Gx + w'x + sum_i mu_i'(K_i x
    - k_i)`` with ``z`` and ``w`` positive at an upper limit and negative at a lower one.

    Attributes:
        status: Whether the program was solved; nothing else is meant to be read unless it was.
        x: ``(n,)`` the primal solution.
        y: Multipliers of ``A x = b``.
        z: Multipliers of the rows of ``G``.
        w: Multipliers of the limits on ``x``.
        mu: ``(n_balls, d)`` multipliers of the balls; empty without.
    """

    status: SolverStatus
    x: FloatArray
    y: FloatArray
    z: FloatArray
    w: FloatArray
    mu: FloatArray

    @classmethod
    def unsolved(cls, status: SolverStatus) -> Solution:
        nothing = np.empty(0)
        return cls(status, nothing, nothing, nothing, nothing, nothing)


@dataclass(frozen=True, eq=False)
class SubproblemSolution:
    """A solved (or failed) subproblem.

    Attributes:
        status: What the solver said.
        trajectory: The solution, None unless solved.
        slack: Sum over the nodes of the slack on keep-out in m; 0 in the hard form.
    """

    status: SolverStatus
    trajectory: Trajectory | None
    slack: float = 0.0


@dataclass(frozen=True)
class KKTResiduals:
    """How far a primal-dual pair is from satisfying the optimality (KKT) conditions.

    Attributes:
        primal: Largest violation of a constraint, in the scaled units of the program.
        stationarity: Largest component of the Lagrangian's gradient, relative to ``1 + ||c||_inf``.
        gap: Difference of primal and dual objective, relative to ``1 + |c'x|``: complementarity.
    """

    primal: float
    stationarity: float
    gap: float

    @property
    def worst(self) -> float:
        """The largest of the three."""
        return max(self.primal, self.stationarity, self.gap)


def kkt_residuals(program: ConvexProgram, solution: Solution) -> KKTResiduals:
    """Residuals of the KKT conditions, from the program's data and the solution alone.

    With zero residuals the solution is a global optimum of the (convex) program.
    """
    p, x = program, solution.x
    rows = p.g @ x
    excess = [
        np.abs(p.a @ x - p.b),
        np.maximum(rows - p.h_upper, p.h_lower - rows),
        np.maximum(x - p.x_upper, p.x_lower - x),
    ]
    a_transposed, g_transposed = p.transposes
    gradient = p.c + a_transposed @ solution.y + g_transposed @ solution.z + solution.w
    dual = -(solution.y @ p.b) - _support(solution.z, p.h_lower, p.h_upper)
    dual -= _support(solution.w, p.x_lower, p.x_upper)
    if p.balls is not None:
        offset = (p.balls.k @ x).reshape(p.balls.centres.shape) - p.balls.centres
        excess.append(np.linalg.norm(offset, axis=1) - p.balls.radius)
        gradient = gradient + p.balls.k.T @ solution.mu.ravel()
        lengths = np.linalg.norm(solution.mu, axis=1)
        dual -= float((solution.mu * p.balls.centres).sum() + p.balls.radius * lengths.sum())
    objective = float(p.c @ x)
    return KKTResiduals(
        primal=max(0.0, *(float(part.max(initial=0.0)) for part in excess)),
        stationarity=float(np.abs(gradient).max()) / (1.0 + float(np.abs(p.c).max())),
        gap=abs(objective - float(dual)) / (1.0 + abs(objective)),
    )


def _support(multiplier: FloatArray, lower: FloatArray, upper: FloatArray) -> float:
    """``max z'v`` over ``lower <= v <= upper``; multipliers at infinite limits are left out."""
    active = np.where(multiplier > 0.0, upper, lower)
    return float(multiplier @ np.where(np.isfinite(active), active, 0.0))


class StandardForm:
    """The program as ``min c'x  s.t.  A x = b,  F x <= f``, balls as second-order cones.

    ``F`` stacks the finite upper and lower limits of rows, then of variables, then the balls, each
    as ``d + 1`` rows of which the first is ``0 <= radius``. Its pattern is made once; :meth:`data`
    and :meth:`right_hand_side` follow the program's values.
    """

    def __init__(self, program: ConvexProgram) -> None:
        p, n = program, len(program.c)
        self._picks = [
            np.flatnonzero(np.isfinite(limit))
            for limit in (p.h_upper, p.h_lower, p.x_upper, p.x_lower)
        ]
        # Stacking the indices of the entries instead of their values tells where each one goes.
        count = p.g.nnz
        index = sparse.csc_matrix((np.arange(1.0, count + 1.0), p.g.indices, p.g.indptr), p.g.shape)
        index = index.tocsr()
        eye = sparse.identity(n, format="csr")
        blocks = [
            index[self._picks[0]],
            index[self._picks[1]],
            (count + 1.0) * eye[self._picks[2]],
            (count + 2.0) * eye[self._picks[3]],
        ]
        extra = np.array([1.0, -1.0])
        self.n_linear = sum(len(pick) for pick in self._picks)
        self.n_balls = 0
        if p.balls is not None:
            self.n_balls, dimension = p.balls.centres.shape
            lift = sparse.kron(
                sparse.identity(self.n_balls),
                sparse.vstack([sparse.csr_matrix((1, dimension)), sparse.identity(dimension)]),
            )
            entries = p.balls.k.tocsr(copy=True)
            extra = np.concatenate([extra, entries.data])
            entries.data = count + 3.0 + np.arange(entries.nnz)
            blocks.append(lift @ entries)
        self.matrix = sparse.vstack(blocks, format="csc")
        self.matrix.sort_indices()
        self._slots = np.rint(self.matrix.data).astype(int) - 1
        lower = np.zeros(self.matrix.shape[0], dtype=bool)
        first = len(self._picks[0])
        lower[first : first + len(self._picks[1])] = True
        self._signs = np.where(lower[self.matrix.indices], -1.0, 1.0)
        self._extra = extra
        self.matrix.data = self.data(program)

    def data(self, program: ConvexProgram) -> FloatArray:
        """Values of ``F``'s entries."""
        return np.concatenate([program.g.data, self._extra])[self._slots] * self._signs

    def right_hand_side(self, program: ConvexProgram) -> FloatArray:
        """``f``; for a ball its radius and centre."""
        p = program
        limits = (p.h_upper, -p.h_lower, p.x_upper, -p.x_lower)
        parts = [limit[pick] for limit, pick in zip(limits, self._picks)]
        if p.balls is not None:
            radius = np.full((self.n_balls, 1), p.balls.radius)
            parts.append(np.hstack([radius, p.balls.centres]).ravel())
        return np.concatenate(parts)

    def solution(
        self, program: ConvexProgram, x: FloatArray, y: FloatArray, s: FloatArray
    ) -> Solution:
        """A solved :class:`Solution` from the multipliers ``s >= 0`` of ``F x <= f``."""
        limits = []
        first = 0
        for pick, size, sign in zip(
            self._picks, 2 * [len(program.h_lower)] + 2 * [len(x)], (1.0, -1.0, 1.0, -1.0)
        ):
            part = np.zeros(size)
            part[pick] = sign * s[first : first + len(pick)]
            first += len(pick)
            limits.append(part)
        mu = s[first:].reshape(self.n_balls, -1)[:, 1:] if self.n_balls else np.empty((0, 0))
        return Solution(SolverStatus.SOLVED, x, y, limits[0] + limits[1], limits[2] + limits[3], mu)
