#!/usr/bin/env python3
"""Measure sparse factorisations of one lattice's stiffness: time, memory of the factor, solves.

Compares the package's multifrontal Cholesky with scipy's SuperLU (by its own ordering and by
the same nested dissection) and, where they are installed, python-mumps, qdldl, cholespy (which
holds CHOLMOD) and pypardiso (which needs Intel's MKL).

    scripts/measure_factorisations.py --cells 26 6 40 --edge 2
"""

import argparse
import importlib.util
import time

import numpy as np
import scipy.sparse.linalg as linalg

from tkamb.contact.lattice.calibrated import CalibratedNetwork
from tkamb.contact.lattice.linear.compliance import SINGLE
from tkamb.contact.lattice.linear.operator import fixed_unknowns, prepare_operator
from tkamb.contact.lattice.meshing.cells import CORNERS
from tkamb.contact.materials import material


def block(counts, edge):
    """Return node positions (n, 3) m, their integer lattice indices (n, 3) and the block's cells.

    Args:
        counts: number of cells along x, y and z.
        edge: edge length of a cell, m.
    """
    sizes = np.array(counts) + 1
    index = np.stack(np.meshgrid(*[np.arange(n) for n in sizes], indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(len(index)).reshape(sizes)
    base = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), -1).reshape(-1, 3)
    cells = np.stack([number[tuple((base + corner).T)] for corner in CORNERS], axis=1)
    return index * edge, index, cells


def timed(label, make, right, entries):
    """Print the time to factorise and to solve for one right-hand side."""
    begun = time.perf_counter()
    solve, made = make()
    middle = time.perf_counter()
    solve(right)
    once = time.perf_counter()
    x = solve(right)
    end = time.perf_counter()
    print(f"{label:28s} factor {middle - begun:7.2f} s   first solve {once - middle:6.3f} s   "
          f"solve {end - once:6.3f} s   {entries(made):8.2f} M entries", flush=True)  # fmt: skip
    return x


def superlu(matrix, order):
    """Return a SuperLU factorisation in an order of unknowns; None: the order of SuperLU."""
    options = {"SymmetricMode": True}
    if order is None:
        made = linalg.splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options=options)
        return made.solve, made
    made = linalg.splu(
        matrix[order][:, order].tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0, options=options
    )

    def solve(right):
        x = np.empty_like(right)
        x[order] = made.solve(right[order])
        return x

    return solve, made


def mumps(matrix):
    """Return a MUMPS factorisation (python-mumps: BSD, MUMPS: CeCILL-C)."""
    import mumps as package

    made = package.Context()
    made.set_matrix(matrix, symmetric=True)
    made.factor()
    return made.solve, made


def qdldl(matrix):
    """Return a QDLDL factorisation (Apache-2.0)."""
    import qdldl as package

    made = package.Solver(matrix)
    return made.solve, made


def cholespy(matrix):
    """Return a cholespy factorisation (BSD; holds CHOLMOD and METIS)."""
    import cholespy as package

    coo = matrix.tocoo()
    made = package.CholeskySolverD(
        matrix.shape[0], coo.row, coo.col, coo.data, package.MatrixType.COO
    )

    def solve(right):
        x = np.zeros_like(right)
        made.solve(right, x)
        return x

    return solve, made


def pypardiso(matrix):
    """Return a PARDISO factorisation (pypardiso: BSD; MKL: Intel's own licence)."""
    import pypardiso as package
    import scipy.sparse as sparse

    made = package.PyPardisoSolver(mtype=2)  # real, symmetric, positive definite
    upper = sparse.triu(matrix, format="csr")
    made.factorize(upper)
    return lambda right: made.solve(upper, right), made


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--cells", type=int, nargs=3, default=[26, 5, 40], help="number of cells along x, y, z"
    )
    parser.add_argument("--edge", type=float, default=2.0, help="edge of a cell, mm")
    parser.add_argument("--skip", nargs="*", default=[], help="names of programs to skip")
    options = parser.parse_args()
    edge = options.edge * 1e-3
    nodes, index, cells = block(options.cells, edge)
    solid = CalibratedNetwork(nodes, cells, np.full(3, edge), material("polyethylene"))
    held = fixed_unknowns(nodes, np.flatnonzero(index[:, 1] == 0), "fixed")
    matrix = solid.stiffness[~held][:, ~held].tocsc()
    right = np.random.default_rng(0).normal(size=matrix.shape[0])
    print(f"{len(nodes)} nodes, {matrix.shape[0]} unknowns, {matrix.nnz / 1e6:.2f} M entries")
    none = np.zeros(0, np.int64)
    factor = prepare_operator(solid.stiffness, index, held, none).factor

    def own():
        made = prepare_operator(solid.stiffness, index, held, none).factor
        return made.solve, made

    def kept():
        made = prepare_operator(solid.stiffness, index, held, none, SINGLE, coarse=True).factor
        return made.solve, made

    runs = {
        "multifrontal": (own, lambda made: made.entries / 1e6),
        "multifrontal, 16 bits": (kept, lambda made: made.entries / 1e6),
        "superlu-dissection": (lambda: superlu(matrix, factor.order), lambda m: m.L.nnz / 1e6),
        "superlu-mmd": (lambda: superlu(matrix, None), lambda m: m.L.nnz / 1e6),
        "mumps": (lambda: mumps(matrix), lambda made: np.nan),
        "qdldl": (lambda: qdldl(matrix), lambda made: np.nan),
        "cholespy": (lambda: cholespy(matrix), lambda made: np.nan),
        "pypardiso": (lambda: pypardiso(matrix), lambda made: np.nan),
    }
    exact = factor.solve(right)
    for name, (make, entries) in runs.items():
        package = name.split("-")[0]
        outside = package in ("mumps", "qdldl", "cholespy", "pypardiso")
        if name in options.skip or (outside and importlib.util.find_spec(package) is None):
            continue
        x = timed(name, make, right, entries)
        allowed = 1e-3 if "16 bits" in name else 1e-8
        assert np.abs(x - exact).max() < allowed * np.abs(exact).max(), name


if __name__ == "__main__":
    main()
