"""Prepared operators on disk: the same answers, whole files only, a limit that holds."""

import errno
import fcntl
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
    nodes, index, cells, _ = block(counts, EDGES, 0.3)
    solid = kind(nodes, cells, EDGES, material("polyethylene", poisson_ratio=nu))
    held = fixed_unknowns(nodes, np.flatnonzero(index[:, 1] == 0), "fixed")
    top = np.flatnonzero(index[:, 1] == counts[1])
    return solid, index, held, top


def cached(counts=(5, 3, 6), limit=1e9, nu=0.45):
    solid, index, held, top = parts(counts, nu)
    made = []

    def make():
        made.append(True)
        return prepare_operator(solid.stiffness, index, held, top, SINGLE, coarse=True)

    return cache.cached_operator(solid, held, top, make, True, limit), bool(made), solid


def solve_twice(_):
    cache.FACTOR_CACHE = cache.FactorCacheSettings(least_unknowns=1)
    operator, _, solid = cached()
    return operator.solve(np.ones_like(solid.nodes))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(tmp_path / "operators"))
    settings = cache.FactorCacheSettings(least_unknowns=1)
    monkeypatch.setattr(cache, "FACTOR_CACHE", settings)
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
        cache.operator_key(solid, held, top, coarse=False),
    }
    assert len(keys) == 6


def only_file(folder):
    (path,) = folder.iterdir()
    return path


def check_made_again_with_one_notice(folder, caplog, words=""):
    """A file that cannot be used is replaced once, with a one-line notice."""
    caplog.clear()
    assert cached()[1]
    assert len(caplog.records) == 1, caplog.text
    assert "the operator is computed again" in caplog.text and words in caplog.text
    assert not cached()[1]
    assert only_file(folder).is_file() and not only_file(folder).is_symlink()


def test_a_file_cut_short_is_made_again(folder, caplog):
    cached()
    path = only_file(folder)
    whole = path.read_bytes()
    for size in (0, 10, 60, 200, len(whole) - 800, len(whole) - 1):
        path.write_bytes(whole[:size])
        path.chmod(0o600)
        check_made_again_with_one_notice(folder, caplog)


@pytest.mark.parametrize("flips", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_flipped_bits_anywhere_are_noticed(folder, caplog, flips):
    first = cached()[0].half.compliance()
    path = only_file(folder)
    whole, chance = path.read_bytes(), np.random.default_rng(4)
    places = [*range(0, 80, 5), *chance.integers(80, len(whole), flips).tolist()]
    for place in places:
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << int(chance.integers(8))
        path.write_bytes(spoilt)
        caplog.clear()
        again, made, _ = cached()
        assert made and len(caplog.records) == 1
        assert np.array_equal(again.half.compliance(), first)


def test_words_that_changed_places_are_noticed(folder, caplog):
    """Their plain sum is the same."""
    cached()
    path = only_file(folder)
    words = np.frombuffer(path.read_bytes(), np.uint64).copy()
    first, second = np.flatnonzero(words[len(words) // 2 :])[[0, 40]] + len(words) // 2
    assert words[first] != words[second]
    words[[first, second]] = words[[second, first]]
    path.write_bytes(words.tobytes())
    check_made_again_with_one_notice(folder, caplog, "its sums differ")


def test_an_operator_under_another_name_is_noticed(folder, caplog):
    cached()
    path = only_file(folder)
    cached((5, 3, 7))
    (other,) = set(folder.iterdir()) - {path}
    other.replace(path)
    check_made_again_with_one_notice(folder, caplog, "another key")


def test_what_is_no_regular_file_of_the_user_is_not_opened(folder, caplog, tmp_path):
    cached()
    path = only_file(folder)
    path.rename(tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    check_made_again_with_one_notice(folder, caplog)
    assert (tmp_path / "elsewhere").exists()
    path.unlink()
    os.mkfifo(path)
    check_made_again_with_one_notice(folder, caplog, "FIFO")
    path.chmod(0o666)
    check_made_again_with_one_notice(folder, caplog, "not the user's own")


def test_sizes_are_checked_before_anything_is_read(folder, caplog):
    """A header of 800 GB, and a file of 800 GB with nothing in it."""
    cached()
    path = only_file(folder)
    whole = bytearray(path.read_bytes())
    whole[32:40] = (800_000_000_000).to_bytes(8, "little")
    path.write_bytes(whole)
    check_made_again_with_one_notice(folder, caplog, "no valid header")
    os.truncate(path, 800_000_000_000)
    check_made_again_with_one_notice(folder, caplog, "MB large")


@pytest.mark.parametrize("what", ["fronts", "half", "one block", "indices", "another material"])
def test_a_wrong_operator_with_a_right_hash_is_noticed(folder, caplog, what):
    """Whoever knows the format can sign anything: the cells' own stiffness does not agree."""
    operator, _, solid = cached()
    path = only_file(folder)
    factor, half = operator.factor, operator.half
    if what == "fronts":
        factor = replace(factor, scale=factor.scale * np.float32(0.9))
    elif what == "half":
        half = replace(half, values=half.values * np.float32(0.9))
    elif what == "one block":
        values = factor.values.copy()
        values[factor.firsts[1] : factor.firsts[2]] = 0
        factor = replace(factor, values=values)
    elif what == "indices":
        factor = replace(factor, boundary=factor.boundary + 10**6)
    else:
        operator = cached(nu=0.3)[0]
        factor, half = operator.factor, operator.half
        path = next(p for p in folder.iterdir() if p != path)
        path.unlink()
        path = only_file(folder)
    wrong = replace(operator, factor=factor, half=half)
    cache.write_operator(path, path.stem, wrong)
    check_made_again_with_one_notice(folder, caplog)
    assert operator_error(cached()[0], solid) < 1e-3


@pytest.mark.parametrize("nu", [0.0, 0.45, 0.4999])
@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_a_sound_operator_agrees_with_the_cells(nu, bearing):
    """Its numbers' rounding alone is left, whatever the condition of the stiffness."""
    for kind in (CalibratedNetwork, BbarHexahedra):
        solid, index, _, top = parts((8, 3, 7), nu, kind)
        held = fixed_unknowns(solid.nodes, np.flatnonzero(index[:, 1] == 0), bearing)
        boundary = solid.stiffness, index, held, top
        assert operator_error(prepare_operator(*boundary, SINGLE), solid) < 1e-6
        coarse = prepare_operator(*boundary, SINGLE, coarse=True)
        assert operator_error(coarse, solid) < 5e-4


def test_orphans_go_and_are_counted(folder, caplog):
    folder.mkdir(parents=True)
    orphan, young, held = (folder / f".tkamb-{name}.part" for name in ("old", "young", "held"))
    for path in (orphan, young, held):
        path.write_bytes(bytes(3_000_000))
    for path in (orphan, held):
        os.utime(path, (1e9, 1e9))
    (folder / ".tkamb-link.part").symlink_to(orphan)
    with open(held) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        cached()
    assert "1 unfinished file(s) removed, 3 MB" in caplog.text
    assert not orphan.exists() and young.exists() and held.exists()


def test_limit_drops_the_least_recently_used(folder):
    cached()
    size = next(folder.iterdir()).stat().st_size
    cached((5, 3, 7), limit=1.5 * size)
    assert sum(p.stat().st_size for p in folder.iterdir()) <= 1.5 * size
    assert cached(limit=1.5 * size)[1]


def test_an_operator_that_another_process_removes_meanwhile_is_used(folder, monkeypatch):
    cached()
    check = cache._operator_of

    def removed_meanwhile(arrays):
        next(folder.iterdir()).unlink()
        return check(arrays)

    monkeypatch.setattr(cache, "_operator_of", removed_meanwhile)
    assert not cached()[1]


def test_an_operator_on_a_disk_that_nobody_writes_to_is_used(folder, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EROFS, "Read-only file system")

    cached()
    monkeypatch.setattr(cache.os, "utime", refuse)
    assert not cached()[1]


def test_operator_larger_than_the_limit_is_not_kept(folder):
    cached(limit=1000)
    assert not folder.exists()


def test_two_processes_at_once_agree(folder):
    with get_context("spawn").Pool(2) as pool:
        a, b = pool.map(solve_twice, range(2))
    assert a == pytest.approx(b, rel=1e-13, abs=0)
    assert [p.suffix for p in folder.iterdir()] == [".operator"]


def test_small_operators_leave_no_file(folder, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("TKAMB_CACHE_DIR", str(folder))
    assert cached()[1] and cached()[1]
    assert not folder.exists()


def test_a_folder_that_cannot_be_written_is_said(folder, caplog):
    folder.parent.mkdir(exist_ok=True)
    folder.write_text("a file")
    assert cached()[1]
    assert "not stored" in caplog.text
