"""Prepared operators on disk: the same answers, whole files only, a limit that holds."""

from multiprocessing import get_context

import numpy as np
import pytest

from lattice_blocks import block
from tkamb.contact.lattice import cache
from tkamb.contact.lattice.network import CalibratedNetwork
from tkamb.contact.lattice.operator import fixed_unknowns, prepare_operator
from tkamb.contact.materials import material

EDGES = np.full(3, 1e-3)


def parts(counts=(5, 3, 6), nu=0.45):
    nodes, index, cells, _ = block(counts, EDGES, 0.3)
    solid = CalibratedNetwork(nodes, cells, EDGES, material("polyethylene", poisson_ratio=nu))
    held = fixed_unknowns(nodes, np.flatnonzero(index[:, 1] == 0), "fixed")
    top = np.flatnonzero(index[:, 1] == counts[1])
    return solid, index, held, top


def cached(counts=(5, 3, 6), limit=1e9):
    solid, index, held, top = parts(counts)
    made = []

    def make():
        made.append(True)
        return prepare_operator(solid.stiffness, index, held, top)

    key = cache.operator_key(solid, held, top)
    return cache.cached_operator(key, make, 10**9, limit), bool(made), solid


def solve_twice(_):
    operator, _, solid = cached()
    return operator.solve(np.ones_like(solid.nodes))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(tmp_path / "operators"))
    return tmp_path / "operators"


def test_operator_from_disk_gives_the_same_answers(folder):
    first, made, solid = cached()
    assert made
    second, made, _ = cached()
    assert not made
    force = np.random.default_rng(0).normal(size=solid.nodes.shape)
    assert second.solve(force) == pytest.approx(first.solve(force), rel=1e-13, abs=0)
    assert np.array_equal(second.half.compliance(), first.half.compliance())
    assert len(list(folder.iterdir())) == 1


def test_key_knows_material_boundary_and_shape():
    solid, _, held, top = parts()
    keys = {
        cache.operator_key(solid, held, top),
        cache.operator_key(parts(nu=0.4)[0], held, top),
        cache.operator_key(parts((5, 3, 7))[0], held, top),
        cache.operator_key(solid, ~held, top),
        cache.operator_key(solid, held, top[:-1]),
    }
    assert len(keys) == 5


def test_broken_file_counts_as_absent(folder):
    cached()
    path = next(folder.iterdir())
    path.write_bytes(path.read_bytes()[:-800])
    assert cached()[1]
    assert not cached()[1]


def test_limit_drops_the_least_recently_used(folder):
    cached()
    size = next(folder.iterdir()).stat().st_size
    cached((5, 3, 7), limit=1.5 * size)
    assert sum(p.stat().st_size for p in folder.iterdir()) <= 1.5 * size
    assert cached(limit=1.5 * size)[1]


def test_operator_larger_than_the_limit_is_not_kept(folder):
    cached(limit=1000)
    assert not folder.exists()


def test_two_processes_at_once_agree(folder):
    with get_context("spawn").Pool(2) as pool:
        a, b = pool.map(solve_twice, range(2))
    assert a == pytest.approx(b, rel=1e-13, abs=0)
    assert [p.suffix for p in folder.iterdir()] == [".operator"]


def test_small_operators_leave_no_file(folder):
    solid, index, held, top = parts()
    cache.cached_operator(
        cache.operator_key(solid, held, top),
        lambda: prepare_operator(solid.stiffness, index, held, top),
        int((~held).sum()),
    )
    assert not folder.exists()
