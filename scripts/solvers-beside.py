#!/usr/bin/env python3
"""QP solvers compared on the problems that MPC solved in a loop.

    cargo bench -p cellpos-benches --bench solvers -- --problems FOLDER
    pip install numpy scipy daqp osqp quadprog piqp clarabel proxsuite
    scripts/solvers-beside.py FOLDER

Each solver is set up once where it can be, then given the vectors of one problem after another; timed is the call that solves,
with the conversion of its arguments from Python (some us), and, where the solver states one, the time that it states itself.
"off" is the largest difference of the first move from the active-set solver of this repository. A solver that is not installed is left out, and said to be.
"""
import argparse
import pathlib
import time

import numpy as np

ABSENT = 1e5


class Problems:
    def __init__(self, path):
        with open(path) as file:
            variables, rows, count = map(int, file.readline().split())
            numbers = np.loadtxt(file.readlines()[: variables + rows])
        self.hessian, self.rows = numbers[:variables], numbers[variables:]
        table = np.loadtxt(path, skiprows=1 + variables + rows, ndmin=2)
        assert len(table) == count
        self.linear, self.low, self.high, self.first = np.split(
            table, [variables, variables + rows, variables + 2 * rows], axis=1)
        # Rows that no problem bounds are left out for all.
        used = (np.abs(self.low) < ABSENT).any(axis=0) | (np.abs(self.high) < ABSENT).any(axis=0)
        self.rows, self.low, self.high = self.rows[used], self.low[:, used], self.high[:, used]


def daqp_of(p):
    import daqp
    h, a = np.ascontiguousarray(p.hessian), np.ascontiguousarray(p.rows)
    sense = np.zeros(len(a), dtype=np.int32)

    def solve(f, low, high):
        x, _, flag, info = daqp.solve(h, f, a, high, low, sense)
        return x, flag == 1, info["solve_time"]
    return solve


def osqp_of(p):
    import osqp
    from scipy import sparse
    solver = osqp.OSQP()
    solver.setup(sparse.triu(p.hessian, format="csc"), p.linear[0], sparse.csc_matrix(p.rows), p.low[0], p.high[0],
                 verbose=False, eps_abs=1e-5, eps_rel=1e-5, max_iter=10000)

    def solve(f, low, high):
        solver.update(q=f, l=low, u=high)
        result = solver.solve()
        return result.x, result.info.status_val == 1, result.info.run_time
    return solve


def quadprog_of(p):
    import quadprog
    constraints = np.ascontiguousarray(np.vstack([p.rows, -p.rows]).T)

    def solve(f, low, high):
        x = quadprog.solve_qp(p.hessian, -f, constraints, np.concatenate([low, -high]))[0]
        return x, True, None
    return solve


def piqp_of(p):
    import piqp
    solver = piqp.DenseSolver()
    none = np.zeros((0, len(p.hessian))), np.zeros(0)
    solver.settings.compute_timings = True
    wide = np.full(len(p.hessian), 1e30)
    solver.setup(p.hessian, p.linear[0], none[0], none[1], p.rows, p.low[0], p.high[0], -wide, wide)

    def solve(f, low, high):
        solver.update(c=f, h_l=low, h_u=high)
        status = solver.solve()
        return solver.result.x, status == piqp.PIQP_SOLVED, solver.result.info.run_time
    return solve


def clarabel_of(p):
    import clarabel
    from scipy import sparse
    both = sparse.csc_matrix(np.vstack([p.rows, -p.rows]))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    hessian = sparse.triu(p.hessian, format="csc")
    cones = [clarabel.NonnegativeConeT(both.shape[0])]
    settings.presolve_enable = False
    solver = clarabel.DefaultSolver(hessian, p.linear[0], both, np.concatenate([p.high[0], -p.low[0]]), cones, settings)

    def solve(f, low, high):
        solver.update(q=f, b=np.concatenate([high, -low]))
        result = solver.solve()
        return np.array(result.x), str(result.status) == "Solved", result.solve_time
    return solve


def proxqp_of(p):
    import proxsuite
    solver = proxsuite.proxqp.dense.QP(len(p.hessian), 0, len(p.rows))
    solver.settings.eps_abs = 1e-7
    solver.settings.compute_timings = True
    solver.init(p.hessian, p.linear[0], None, None, p.rows, p.low[0], p.high[0])

    def solve(f, low, high):
        solver.update(g=f, l=low, u=high)
        solver.solve()
        solved = solver.results.info.status == proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED
        return solver.results.x, solved, solver.results.info.run_time * 1e-6
    return solve


def row(name, make, problems, count):
    try:
        solve = make(problems)
    except ImportError as error:
        print(f"{name:<24} not installed: {error}")
        return
    took, stated, off, unsolved = [], [], 0.0, 0
    for i in range(min(count, len(problems.linear))):
        arguments = problems.linear[i].copy(), problems.low[i].copy(), problems.high[i].copy()
        start = time.perf_counter()
        x, solved, own_s = solve(*arguments)
        took.append(time.perf_counter() - start)
        if own_s is not None:
            stated.append(own_s)
        if solved:
            off = max(off, abs(x[0] - problems.first[i, 0]))
        else:
            unsolved += 1
    def text(seconds):
        if not seconds:
            return f"{'-':>8} {'-':>8} {'-':>8}"
        return " ".join(f"{1e6 * np.percentile(seconds, q):8.1f}" for q in (50, 99, 99.9))
    print(f"{name:<24} {text(took)}   {text(stated)}   {off:9.1e} {unsolved:9}")


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folder", type=pathlib.Path)
    arguments.add_argument("--count", type=int, default=20000)
    given = arguments.parse_args()
    print(f"{'':<24} {'call, us: p50, 99 %, 99.9 %':^26}   {'stated, us':^26}   {'off, um':>9} {'unsolved':>9}")
    for kind in ("easy", "constrained"):
        problems = Problems(given.folder / f"{kind}.txt")
        for name, make in [("daqp", daqp_of), ("quadprog", quadprog_of), ("piqp", piqp_of), ("proxqp", proxqp_of),
                           ("osqp (1e-5)", osqp_of), ("clarabel (as it comes)", clarabel_of)]:
            row(f"{name}, {kind}", make, problems, given.count)


if __name__ == "__main__":
    main()
