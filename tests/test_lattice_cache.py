"""The cache of prepared operators: equal results, no damaged files, a size limit."""

import errno
import os
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest

from lattice_blocks import block
from tkamb.contact.lattice.bbar import BbarHexahedra
from tkamb.contact.lattice.calibrated import CalibratedNetwork
from tkamb.contact.lattice.linear import cache
from tkamb.contact.lattice.linear.compliance import SINGLE
from tkamb.contact.lattice.linear.operator import fixed_unknowns, operator_error, prepare_operator
from tkamb.contact.materials import material

EDGES = np.full(3, 1e-3)


def parts(counts=(5, 3, 6), nu=0.45, kind=CalibratedNetwork):
    """Return solid, lattice index, held unknowns and top nodes of a block."""
    nodes, index, cells, _ = block(counts, EDGES, 0.3)
    solid = kind(nodes, cells, EDGES, material("polyethylene", poisson_ratio=nu))
    held = fixed_unknowns(nodes, np.flatnonzero(index[:, 1] == 0), "fixed")
    top = np.flatnonzero(index[:, 1] == counts[1])
    return solid, index, held, top


def cached(counts=(5, 3, 6), limit=1e9, nu=0.45):
    """Return the operator of a block, whether it was computed, and the solid."""
    solid, index, held, top = parts(counts, nu)
    calls = []

    def make():
        calls.append(True)
        return prepare_operator(solid.stiffness, index, held, top, SINGLE, coarse=True)

    return cache.cached_operator(solid, held, top, make, True, limit), bool(calls), solid


def solve_in_process(_):
    """Return a displacement, in a process that shares the cache with others."""
    cache.FACTOR_CACHE = cache.FactorCacheSettings(least_unknowns=1)
    operator, _, solid = cached()
    return operator.solve(np.ones_like(solid.nodes))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Return the folder of the cache, which stores small operators too."""
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(tmp_path / "operators"))
    settings = cache.FactorCacheSettings(least_unknowns=1)
    monkeypatch.setattr(cache, "FACTOR_CACHE", settings)
    return tmp_path / "operators"


def test_operator_from_disk_gives_the_same_results(folder):
    first, computed, solid = cached()
    assert computed
    second, computed, _ = cached()
    assert not computed
    force = np.random.default_rng(0).normal(size=solid.nodes.shape)
    assert second.solve(force) == pytest.approx(first.solve(force), rel=1e-13, abs=0)
    assert np.array_equal(second.half.compliance(), first.half.compliance())
    assert len(list(folder.iterdir())) == 1


def test_key_depends_on_material_boundary_shape_and_precision():
    solid, _, held, top = parts()
    keys = {
        cache.operator_key(solid, held, top),
        cache.operator_key(parts(nu=0.4)[0], held, top),
        cache.operator_key(parts((5, 3, 7))[0], held, top),
        cache.operator_key(solid, ~held, top),
        cache.operator_key(solid, held, top[:-1]),
        cache.operator_key(solid, held, top, coarse=False),
    }
    assert len(keys) == 6


def only_file(folder):
    """Return the only file in the folder."""
    (path,) = folder.iterdir()
    return path


def check_recomputed_with_one_notice(folder, caplog, words=""):
    """Check that an unusable file is replaced once, with a one-line notice."""
    caplog.clear()
    assert cached()[1]
    assert len(caplog.records) == 1, caplog.text
    assert "the operator is computed again" in caplog.text and words in caplog.text
    assert not cached()[1]
    assert only_file(folder).is_file() and not only_file(folder).is_symlink()


def test_a_truncated_file_is_replaced(folder, caplog):
    cached()
    path = only_file(folder)
    content = path.read_bytes()
    for size in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        path.chmod(0o600)
        check_recomputed_with_one_notice(folder, caplog)


def test_a_flipped_bit_in_an_array_is_detected(folder, caplog):
    first = cached()[0].half.compliance()
    path = only_file(folder)
    content, generator = path.read_bytes(), np.random.default_rng(4)
    for position in generator.integers(1000, len(content) - 2000, 12).tolist():
        damaged = bytearray(content)
        damaged[position] ^= 1 << int(generator.integers(8))
        path.write_bytes(damaged)
        caplog.clear()
        again, computed, _ = cached()
        assert computed and len(caplog.records) == 1
        assert np.array_equal(again.half.compliance(), first)


def test_an_operator_under_another_name_is_not_used(folder, caplog):
    cached()
    path = only_file(folder)
    cached((5, 3, 7))
    (other,) = set(folder.iterdir()) - {path}
    other.replace(path)
    check_recomputed_with_one_notice(folder, caplog, "another key")


def test_only_regular_files_of_the_user_are_used(folder, caplog, tmp_path):
    cached()
    path = only_file(folder)
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    check_recomputed_with_one_notice(folder, caplog)
    assert (tmp_path / "elsewhere").exists()
    path.unlink()
    os.mkfifo(path)
    check_recomputed_with_one_notice(folder, caplog, "FIFO")
    path.chmod(0o666)
    check_recomputed_with_one_notice(folder, caplog, "not the user's own")


def test_a_file_that_is_cut_short_while_it_is_in_use_does_no_harm(folder):
    """A mapped file would end the process (SIGBUS)."""
    force = np.ones_like(parts()[0].nodes)
    expected = cached()[0].solve(force)
    operator, computed, _ = cached()
    os.truncate(only_file(folder), 0)
    assert not computed and operator.solve(force) == pytest.approx(expected, rel=1e-13, abs=0)


def test_a_too_large_file_is_not_read(folder, caplog):
    cached()
    os.truncate(only_file(folder), 800_000_000_000)
    check_recomputed_with_one_notice(folder, caplog, "MB large")


@pytest.mark.parametrize("error", ["fronts", "half", "one block", "another material"])
def test_a_wrong_operator_with_valid_sums_is_detected(folder, caplog, error):
    """The comparison with the cells' stiffness finds errors that the file's sums do not show."""
    operator, _, solid = cached()
    path = only_file(folder)
    factor, half = operator.factor, operator.half
    if error == "fronts":
        factor = replace(factor, scale=factor.scale * np.float32(0.9))
    elif error == "half":
        half = replace(half, values=half.values * np.float32(0.9))
    elif error == "one block":
        values = factor.values.copy()
        values[factor.firsts[1] : factor.firsts[2]] = 0
        factor = replace(factor, values=values)
    else:
        operator = cached(nu=0.3)[0]
        factor, half = operator.factor, operator.half
        path = next(p for p in folder.iterdir() if p != path)
        path.unlink()
        path = only_file(folder)
    wrong = replace(operator, factor=factor, half=half)
    cache.write_operator(path, path.stem, wrong)
    check_recomputed_with_one_notice(folder, caplog)
    assert operator_error(cached()[0], solid) < 1e-3


@pytest.mark.parametrize("nu", [0.0, 0.45, 0.4999])
@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_the_error_of_an_operator_is_its_rounding(nu, bearing):
    """It does not depend on the condition of the stiffness."""
    for kind in (CalibratedNetwork, BbarHexahedra):
        solid, index, _, top = parts((8, 3, 7), nu, kind)
        held = fixed_unknowns(solid.nodes, np.flatnonzero(index[:, 1] == 0), bearing)
        boundary = solid.stiffness, index, held, top
        assert operator_error(prepare_operator(*boundary, SINGLE), solid) < 1e-6
        coarse = prepare_operator(*boundary, SINGLE, coarse=True)
        assert operator_error(coarse, solid) < 5e-4


def test_old_unfinished_files_are_removed(folder):
    folder.mkdir(parents=True)
    old, young = (folder / f".tkamb-{name}.part" for name in ("old", "young"))
    for path in (old, young):
        path.write_bytes(bytes(3))
    os.utime(old, (1e9, 1e9))
    cached()
    assert not old.exists() and young.exists()


def test_the_size_limit_removes_the_least_recently_used_file(folder):
    cached()
    size = next(folder.iterdir()).stat().st_size
    cached((5, 3, 7), limit=1.5 * size)
    assert sum(p.stat().st_size for p in folder.iterdir()) <= 1.5 * size
    assert cached(limit=1.5 * size)[1]


def test_an_operator_on_a_read_only_disk_is_used(folder, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EROFS, "Read-only file system")

    cached()
    monkeypatch.setattr(cache.os, "utime", refuse)
    assert not cached()[1]


def test_an_operator_larger_than_the_limit_is_not_stored(folder):
    cached(limit=1000)
    assert not folder.exists()


def test_two_processes_can_share_the_cache(folder):
    with get_context("spawn").Pool(2) as pool:
        a, b = pool.map(solve_in_process, range(2))
    assert a == pytest.approx(b, rel=1e-13, abs=0)
    assert [p.suffix for p in folder.iterdir()] == [".operator"]


def test_small_operators_are_not_stored(folder, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(folder))
    assert cached()[1] and cached()[1]
    assert not folder.exists()


def test_a_notice_tells_that_the_folder_cannot_be_written(folder, caplog):
    folder.parent.mkdir(exist_ok=True)
    folder.write_text("a file")
    assert cached()[1]
    assert "not stored" in caplog.text
