"""Solvers beneath the subproblem, behind one small protocol and chosen by name.

Which one to use when, with measured times, is in the planning guide (``docs/planning.md``).
"""

from __future__ import annotations

import difflib
import importlib
from typing import Any, ClassVar, Protocol

import numpy as np
from scipy import sparse

from freeflyer_env.planning.program import (
    ConvexProgram,
    Solution,
    SolverStatus,
    StandardForm,
    kkt_residuals,
)
from freeflyer_env.robot import FloatArray


class Backend(Protocol):
    """Solves one convex program again and again, with new values each time."""

    #: Whether second-order cones, that is a ball-shaped trust region, can be solved.
    cones: ClassVar[bool]

    def solve(self, program: ConvexProgram) -> Solution:
        """Solves the program; an outcome that can be expected is a status, not an exception."""


class PIQPBackend:
    """PIQP, a proximal interior-point method; one solver object, updated in place."""

    cones: ClassVar[bool] = False

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

    def solve(self, program: ConvexProgram) -> Solution:
        limits = (program.h_lower, program.h_upper, program.x_lower, program.x_upper)
        if self._is_set_up:
            self._solver.update(None, program.c, None, program.b, program.g, *limits)
        else:
            n = len(program.c)
            zero = sparse.csc_matrix((n, n))
            self._solver.setup(zero, program.c, program.a, program.b, program.g, *limits)
            self._is_set_up = True
        status = self._solver.solve()
        if status == self._piqp.PIQP_PRIMAL_INFEASIBLE:
            return Solution.unsolved(SolverStatus.INFEASIBLE)
        if status != self._piqp.PIQP_SOLVED:
            return _judge(program)  # rare, and mostly a program that is infeasible by a hair
        found = self._solver.result
        z, w = found.z_u - found.z_l, found.z_bu - found.z_bl
        return Solution(SolverStatus.SOLVED, found.x, found.y, z, w, np.empty((0, 0)))


class HiGHSBackend:
    """HiGHS, the dual simplex method; starts from the basis of the program solved last.

    Exact about infeasibility; some degenerate infeasible programs are beyond it. Where a program
    has several optima, which one it gives may depend on the programs solved before.

    Args:
        time_limit: In s, for all solves together.
    """

    cones: ClassVar[bool] = False

    def __init__(self, time_limit: float = np.inf) -> None:
        import highspy

        self._highspy = highspy
        self._solver = highspy.Highs()
        options: dict[str, Any] = {"output_flag": False, "solver": "simplex", "threads": 1}
        options["time_limit"] = time_limit
        for option, value in options.items():
            self._solver.setOptionValue(option, value)
        self._basis: Any = None

    def solve(self, program: ConvexProgram) -> Solution:
        p, n_rows = program, len(program.b)
        matrix = sparse.vstack([p.a, p.g], format="csc")
        lp = self._highspy.HighsLp()
        lp.num_col_, lp.num_row_ = len(p.c), matrix.shape[0]
        lp.col_cost_, lp.col_lower_, lp.col_upper_ = p.c, p.x_lower, p.x_upper
        lp.row_lower_ = np.concatenate([p.b, p.h_lower])
        lp.row_upper_ = np.concatenate([p.b, p.h_upper])
        lp.a_matrix_.format_ = self._highspy.MatrixFormat.kColwise
        lp.a_matrix_.start_ = matrix.indptr
        lp.a_matrix_.index_ = matrix.indices
        lp.a_matrix_.value_ = matrix.data
        self._solver.passModel(lp)
        if self._basis is not None:
            self._solver.setBasis(self._basis)
        self._solver.run()
        status, kinds = self._solver.getModelStatus(), self._highspy.HighsModelStatus
        infeasible = (kinds.kInfeasible, kinds.kUnboundedOrInfeasible)
        if status not in (kinds.kOptimal, *infeasible) and self._basis is not None:
            self._solver.clearSolver()  # a basis of another program can lead astray
            self._solver.run()
            status = self._solver.getModelStatus()
        if status == kinds.kOptimal:
            found = self._solver.getSolution()
            self._basis = self._solver.getBasis()
            rows = -np.asarray(found.row_dual)
            return Solution(
                SolverStatus.SOLVED,
                np.asarray(found.col_value),
                rows[:n_rows],
                rows[n_rows:],
                -np.asarray(found.col_dual),
                np.empty((0, 0)),
            )
        failed = SolverStatus.INFEASIBLE if status in infeasible else SolverStatus.FAILED
        return Solution.unsolved(failed)


class ClarabelBackend:
    """Clarabel, an interior-point method with second-order cones; updated in place."""

    cones: ClassVar[bool] = True

    def __init__(self, *, is_judge: bool = False) -> None:
        self._is_judge = is_judge
        self._clarabel = _import_solver("clarabel")
        self._solver: Any = None

    def solve(self, program: ConvexProgram) -> Solution:
        clarabel, n_equal = self._clarabel, len(program.b)
        if self._solver is None:
            self._form = form = StandardForm(program)
            # The pattern of [A; F] column by column, and where the entries of F are in it.
            stacked = sparse.vstack([program.a, form.matrix], format="csc")
            stacked.sort_indices()
            self._is_f = stacked.indices >= n_equal
            self._data = stacked.data.copy()
            cones = [clarabel.ZeroConeT(n_equal), clarabel.NonnegativeConeT(form.n_linear)]
            if program.balls is not None:
                dimension = program.balls.centres.shape[1] + 1
                cones += form.n_balls * [clarabel.SecondOrderConeT(dimension)]
            settings = clarabel.DefaultSettings()
            settings.verbose = settings.presolve_enable = settings.input_sparse_dropzeros = False
            settings.max_threads = 1
            n = len(program.c)
            self._solver = clarabel.DefaultSolver(
                sparse.csc_matrix((n, n)), program.c, stacked, self._right(program), cones, settings
            )
        else:
            self._data[self._is_f] = self._form.data(program)
            self._solver.update(q=program.c, A=self._data, b=self._right(program))
        found = self._solver.solve()
        if found.status == clarabel.SolverStatus.Solved:
            x, z = np.asarray(found.x), np.asarray(found.z)
            return self._form.solution(program, x, z[:n_equal], z[n_equal:])
        if found.status == clarabel.SolverStatus.PrimalInfeasible:
            return Solution.unsolved(SolverStatus.INFEASIBLE)
        if program.balls is None and not self._is_judge:
            return _judge(program)
        infeasible = found.status == clarabel.SolverStatus.AlmostPrimalInfeasible
        return Solution.unsolved(SolverStatus.INFEASIBLE if infeasible else SolverStatus.FAILED)

    def _right(self, program: ConvexProgram) -> FloatArray:
        return np.concatenate([program.b, self._form.right_hand_side(program)])


class QOCOBackend:
    """QOCO, an interior-point method with second-order cones; set up anew for each program.

    (Updated in place, version 0.3 calls solutions of earlier data solved.) It does not detect
    infeasibility and is at times too easily content: where it does not converge, or the optimality
    conditions do not hold to 1e-6, HiGHS decides, or Clarabel if there are cones.
    """

    cones: ClassVar[bool] = True

    def __init__(self) -> None:
        self._qoco = _import_solver("qoco")
        self._form: StandardForm | None = None

    def solve(self, program: ConvexProgram) -> Solution:
        if self._form is None:
            self._form = StandardForm(program)
        form, solver = self._form, self._qoco.QOCO()
        form.matrix.data = form.data(program)
        right = form.right_hand_side(program)
        dimension = 0 if program.balls is None else program.balls.centres.shape[1] + 1
        cones = np.full(form.n_balls, dimension, dtype=np.int32)
        solver.setup(
            len(program.c),
            form.matrix.shape[0],
            len(program.b),
            None,
            program.c,
            program.a,
            program.b,
            form.matrix,
            right,
            form.n_linear,
            form.n_balls,
            cones,
            abstol=1e-9,
            reltol=1e-9,
        )
        found = solver.solve()
        if found.status in ("QOCO_SOLVED", "QOCO_SOLVED_INACCURATE"):
            solution = form.solution(
                program, *(np.array(part) for part in (found.x, found.y, found.z))
            )
            if kkt_residuals(program, solution).worst < 1e-6:
                return solution
        return _judge(program)


class OSQPBackend:
    """OSQP, a first-order method: made for quadratic programs, slow and rough on these linear ones.

    It is here for comparison. Its solutions hold to about 1e-4 of the largest delta-V.
    """

    cones: ClassVar[bool] = False

    def solve(self, program: ConvexProgram) -> Solution:
        import osqp

        n, n_equal = len(program.c), len(program.b)
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
        found = solver.solve(raise_error=False)
        if found.info.status == "solved":
            y, z, w = np.split(np.asarray(found.y), [n_equal, n_equal + len(program.h_lower)])
            return Solution(SolverStatus.SOLVED, np.asarray(found.x), y, z, w, np.empty((0, 0)))
        infeasible = "infeasible" in found.info.status
        return Solution.unsolved(SolverStatus.INFEASIBLE if infeasible else SolverStatus.FAILED)


def _judge(program: ConvexProgram) -> Solution:
    """Solves a program that a backend was not sure about: the simplex method, else Clarabel."""
    if program.balls is None:
        solution = HiGHSBackend(time_limit=1.0).solve(program)
        if solution.status is not SolverStatus.FAILED:
            return solution
    return ClarabelBackend(is_judge=True).solve(program)


#: Backends by name. A name ``cvxpy:<SOLVER>`` is none of these: the reference statement is solved.
BACKENDS: dict[str, type[Backend]] = {
    "piqp": PIQPBackend,
    "clarabel": ClarabelBackend,
    "qoco": QOCOBackend,
    "highs": HiGHSBackend,
    "osqp": OSQPBackend,
}

#: Prefix of the names that solve the CVXPY statement with one of CVXPY's solvers.
CVXPY_PREFIX = "cvxpy:"


def _import_solver(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ModuleNotFoundError(
            f'Backend {module!r} needs a package: pip install "freeflyer-gym[solvers]".'
        ) from error


def check_backend(name: str, *, cones: bool = False) -> None:
    """Raises unless there is a backend of that name which can do what is asked.

    Args:
        name: A name in :data:`BACKENDS`, or ``cvxpy:`` and the name of a solver of CVXPY's.
        cones: Whether second-order cones are needed (a ball-shaped trust region).

    Raises:
        ValueError: With the nearest name, or the names of the backends that can.
    """
    if name.startswith(CVXPY_PREFIX):
        import cvxpy

        solver = name.removeprefix(CVXPY_PREFIX).upper()
        if solver not in cvxpy.installed_solvers():
            known = ", ".join(cvxpy.installed_solvers())
            raise ValueError(f"CVXPY has no solver {solver!r} here. Installed: {known}.")
        return
    if name not in BACKENDS:
        near = difflib.get_close_matches(name, BACKENDS, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(
            f"No solver backend is called {name!r}.{hint} Known: {', '.join(BACKENDS)}, "
            f"{CVXPY_PREFIX}<SOLVER>."
        )
    if cones and not BACKENDS[name].cones:
        able = ", ".join(other for other, backend in BACKENDS.items() if backend.cones)
        raise ValueError(
            f"Backend {name!r} has no second-order cones, which a ball-shaped trust region needs; "
            f"use one of {able}, or {CVXPY_PREFIX}CLARABEL."
        )


def make_backend(name: str) -> Backend:
    """A new solver object.

    Raises:
        ValueError: If no backend has that name; the message names the nearest one.
    """
    check_backend(name)
    return BACKENDS[name]()
