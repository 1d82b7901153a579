"""Solvers beneath the subproblem, behind one small protocol and chosen by name."""

from __future__ import annotations

import difflib
import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import sparse

from freeflyer_env.robot import FloatArray


class SolverStatus(enum.Enum):
    """What a solver said of one linear program."""

    SOLVED = "solved"
    INFEASIBLE = "infeasible"
    FAILED = "failed"


@dataclass(eq=False)
class LinearProgram:
    """``min c'x  s.t.  A x = b,  h_lower <= G x <= h_upper,  x_lower <= x <= x_upper``.

    The patterns of ``a`` and ``g`` and the values of ``c`` and ``a`` never change once given to a
    backend; everything else may be overwritten between solves.
    """

    c: FloatArray
    a: sparse.csc_matrix
    b: FloatArray
    g: sparse.csc_matrix
    h_lower: FloatArray
    h_upper: FloatArray
    x_lower: FloatArray
    x_upper: FloatArray


class Backend(Protocol):
    """Solves one linear program again and again, with new values each time."""

    def solve(self, program: LinearProgram) -> tuple[SolverStatus, FloatArray]:
        """Status and, where solved, the primal solution."""


class PIQPBackend:
    """PIQP, a proximal interior-point method; one solver object, updated in place."""

    def __init__(self) -> None:
        try:
            import piqp
        except ImportError as error:
            raise ModuleNotFoundError(
                'Planning needs PIQP: pip install "freeflyer-gym[planning]".'
            ) from error
        self._piqp = piqp
        self._solver = piqp.SparseSolver()
        self._solver.settings.max_iter = 100
        # The subproblem is scaled by hand. Ruiz scaling would leave traces of earlier programs in
        # the rounding of later ones: without it the same program has the same solution, bit for
        # bit.
        self._solver.settings.preconditioner_iter = 0
        self._is_set_up = False

    def solve(self, program: LinearProgram) -> tuple[SolverStatus, FloatArray]:
        values = (program.g, program.h_lower, program.h_upper, program.x_lower, program.x_upper)
        if self._is_set_up:
            self._solver.update(None, None, None, program.b, *values)
        else:
            n = len(program.c)
            zero = sparse.csc_matrix((n, n))
            self._solver.setup(zero, program.c, program.a, program.b, *values)
            self._is_set_up = True
        status = self._solver.solve()
        if status == self._piqp.PIQP_SOLVED:
            return SolverStatus.SOLVED, self._solver.result.x
        if status == self._piqp.PIQP_PRIMAL_INFEASIBLE:
            return SolverStatus.INFEASIBLE, self._solver.result.x
        # Rare, and mostly a program that is infeasible by a hair: the simplex method decides.
        return HiGHSBackend().solve(program)


class HiGHSBackend:
    """HiGHS, the simplex method by way of SciPy: slower, and exact about infeasibility."""

    def solve(self, program: LinearProgram) -> tuple[SolverStatus, FloatArray]:
        from scipy.optimize import linprog

        above, below = np.isfinite(program.h_upper), np.isfinite(program.h_lower)
        result = linprog(
            program.c,
            A_ub=sparse.vstack([program.g[above], -program.g[below]]),
            b_ub=np.concatenate([program.h_upper[above], -program.h_lower[below]]),
            A_eq=program.a,
            b_eq=program.b,
            bounds=np.column_stack([program.x_lower, program.x_upper]),
            method="highs-ds",
        )
        if result.status == 0:
            return SolverStatus.SOLVED, result.x
        failed = SolverStatus.INFEASIBLE if result.status == 2 else SolverStatus.FAILED
        return failed, np.zeros_like(program.c)


class OSQPBackend:
    """OSQP, a first-order method: made for quadratic programs, slow and rough on these linear ones.

    It is here for comparison. Its solutions hold to about 1e-4 of the largest delta-V.
    """

    def solve(self, program: LinearProgram) -> tuple[SolverStatus, FloatArray]:
        import osqp

        n = len(program.c)
        solver = osqp.OSQP()
        solver.setup(
            sparse.csc_matrix((n, n)),
            program.c,
            sparse.vstack([program.a, program.g, sparse.identity(n)], format="csc"),
            np.concatenate([program.b, program.h_lower, program.x_lower]),
            np.concatenate([program.b, program.h_upper, program.x_upper]),
            eps_abs=1e-5,
            eps_rel=1e-5,
            max_iter=50_000,
            verbose=False,
        )
        result = solver.solve(raise_error=False)
        if result.info.status == "solved":
            return SolverStatus.SOLVED, np.asarray(result.x)
        infeasible = "infeasible" in result.info.status
        return SolverStatus.INFEASIBLE if infeasible else SolverStatus.FAILED, np.zeros(n)


BACKENDS: dict[str, Callable[[], Backend]] = {
    "piqp": PIQPBackend,
    "highs": HiGHSBackend,
    "osqp": OSQPBackend,
}


def make_backend(name: str) -> Backend:
    """A new solver object.

    Raises:
        ValueError: If no backend has that name; the message names the nearest one.
    """
    if name not in BACKENDS:
        near = difflib.get_close_matches(name, BACKENDS, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(
            f"No solver backend is called {name!r}.{hint} Known: {', '.join(BACKENDS)}."
        )
    return BACKENDS[name]()
