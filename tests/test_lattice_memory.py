"""The estimate of the memory of a lattice, and the proposed resolution."""

import re
import tracemalloc

import numpy as np
import pytest
import scipy.sparse as sparse

from lattice_blocks import block
from lattice_bodies import box_insert, pair, sphere_cap
from tkamb.contact.lattice.calibrated import CalibratedNetwork
from tkamb.contact.lattice.linear import operator
from tkamb.contact.lattice.linear.compliance import SINGLE
from tkamb.contact.lattice.linear.multifrontal import Dissection
from tkamb.contact.lattice.linear.operator import fixed_unknowns, prepare_operator
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.errors import InputError
from tkamb.geometry import memory

LINEAR = material("polyethylene-linear")


@pytest.mark.parametrize("counts", [(12, 6, 12), (30, 8, 20)])
def test_the_estimate_is_one_to_three_times_the_peak_memory(counts, monkeypatch):
    nodes, index, cells, _ = block(counts, np.full(3, 1e-3), 0.3)
    stiffness = CalibratedNetwork(nodes, cells, np.full(3, 1e-3), LINEAR).stiffness
    held = fixed_unknowns(nodes, np.flatnonzero(index[:, 1] == 0), "fixed")
    top = np.flatnonzero(index[:, 1] == counts[1])
    needs = []
    monkeypatch.setattr(operator, "check_memory", needs.append)
    tracemalloc.start()
    prepare_operator(stiffness, index, held, top, SINGLE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < operator.MEMORY_NEED.safety_factor * needs[0] < 3 * peak


def test_memory_of_one_front_is_its_matrix_in_8_bytes_and_in_4():
    """The front has 30 nodes. Its numbers are computed in 8 bytes and stored in 4."""
    nodes = np.arange(30)
    joined = sparse.csr_matrix(np.ones((30, 30)))
    tree = Dissection([nodes], [-1])
    need = operator.factor_memory(tree, joined, np.zeros(30, bool), 4)
    assert need == operator.MEMORY_NEED.entry_bytes * 90**2 + (8 + 4) * 90**2


def test_memory_includes_updates_that_wait_for_their_parent():
    """Two fronts of 10 nodes have one parent. The update of the first waits for the parent."""
    first, second, between = np.arange(10), np.arange(10, 20), np.arange(20, 30)
    joined = np.ones((30, 30))
    joined[:10, 10:20] = joined[10:20, :10] = 0.0
    tree = Dissection([first, second, between], [2, 2, -1])
    need = operator.factor_memory(tree, sparse.csr_matrix(joined), np.zeros(30, bool), 4)
    own, update = 60 * 30, 30 * 30
    last = 4 * (2 * own + 30**2) + 8 * (2 * update + 30**2)
    at_second = 4 * 2 * own + 8 * (update + own + update)
    assert at_second > last
    assert need == operator.MEMORY_NEED.entry_bytes * 9 * joined.sum() + at_second


@pytest.mark.parametrize("available", [2e8, 6e7, 1.5e7])
def test_the_proposed_resolution_fits_into_the_memory(monkeypatch, available):
    bodies = pair(sphere_cap(22e-3), box_insert(0.04, 0.01, 0.06), LINEAR)
    monkeypatch.setattr(operator, "available_memory", lambda: available)
    size = 0.5 if available > 1e8 else 1.0
    with pytest.raises(InputError, match=r"GB are left; take .* mm or coarser") as error:
        contact_model("lattice-linear", resolution=size * 1e-3, cache=False).prepare(bodies)
    proposal = float(re.search(r"take ([\d.]+) mm", str(error.value))[1])
    contact_model("lattice-linear", resolution=proposal * 1e-3, cache=False).prepare(bodies)


def test_without_memory_no_resolution_is_proposed(monkeypatch):
    bodies = pair(sphere_cap(22e-3), box_insert(0.02, 0.01, 0.02), LINEAR)
    monkeypatch.setattr(operator, "available_memory", lambda: 1e3)
    with pytest.raises(InputError, match="free some memory"):
        contact_model("lattice-linear", resolution=2e-3, cache=False).prepare(bodies)


def test_available_memory_is_the_smallest_of_three_limits(tmp_path, monkeypatch):
    """The limits are those of the machine, of the control group and of the process."""
    statistics = tmp_path / "meminfo"
    statistics.write_text("MemTotal: 9000 kB\nMemAvailable: 4000 kB\n")
    monkeypatch.setattr(memory, "STATISTICS", statistics)
    monkeypatch.setattr(memory, "GROUP", tmp_path)
    unlimited = (memory.resource.RLIM_INFINITY,) * 2
    monkeypatch.setattr(memory.resource, "getrlimit", lambda which: unlimited)
    assert memory.available_memory() == 4000 * 1024
    (tmp_path / "memory.current").write_text("1000000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available_memory() == 4000 * 1024
    (tmp_path / "memory.max").write_text("3000000\n")
    assert memory.available_memory() == 2_000_000
    own = tmp_path / "statm"
    own.write_text("10 5 1\n")
    monkeypatch.setattr(memory, "OWN", own)
    page = memory.os.sysconf("SC_PAGE_SIZE")
    monkeypatch.setattr(memory.resource, "getrlimit", lambda which: (15 * page, 15 * page))
    assert memory.available_memory() == 5 * page
