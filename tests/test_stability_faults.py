"""Faults in the contact models: the stability study must detect each of them.

The study compares with closed forms, stored results of CalculiX and the load, because a reference
by the same solver has the same fault.
"""

from dataclasses import replace

import numpy as np
import pytest

from tkamb.contact.lattice import model, report, solver
from tkamb.contact.lattice.active_set import _forces_of, solve_contact
from tkamb.contact.lattice.linear import cache
from tkamb.contact.materials import RambergOsgood
from tkamb.studies.cases import Extreme
from tkamb.studies.references import KEPT_GRID_MM, ClosedForm, closed_forms, press_closed_form
from tkamb.studies.stability import judge_safely, stored_verdicts
from tkamb.studies.verdict import PEER_BOUNDS, complaints, peer_distances

PLATES = [
    ClosedForm("plate", name) for name in ("lattice", "lattice-linear", "fe", "lattice-source")
]
BESIDE_CALCULIX = Extreme(resolution_mm=3.0, linear=True)


def judged(case):
    verdict = judge_safely(case)
    return replace(verdict, expected=stored_verdicts()[verdict.key])


@pytest.mark.parametrize("case", [c for c in closed_forms(quick=True) if c.kind != "kept"])
def test_each_family_agrees_with_its_closed_form(case):
    assert judged(case).kind == "converged"


@pytest.mark.parametrize("case", PLATES, ids=lambda case: case.model)
def test_pressures_that_are_5_per_cent_too_high_fail(case, monkeypatch):
    original = report._pressures

    def higher(*arguments):
        force, pressure, area = original(*arguments)
        return force, 1.05 * pressure, area

    monkeypatch.setattr(report, "_pressures", higher)
    verdict = judged(case)
    assert verdict.failed and "pressures integrate to 1.0500" in verdict.reason


@pytest.mark.parametrize("case", PLATES[1:2], ids=lambda case: case.model)
def test_a_stiffness_that_is_5_per_cent_too_high_fails(case, monkeypatch):
    original = model.prepare_operator
    monkeypatch.setattr(
        model, "prepare_operator", lambda k, *arguments: original(1.05 * k, *arguments)
    )
    verdict = judged(case)
    assert verdict.failed and "approach 4.76 % from the closed form" in verdict.reason


@pytest.mark.parametrize("name", ["lattice", "fe", "foundation", "lattice-source"])
def test_a_stress_strain_curve_that_is_5_per_cent_too_high_fails(name, monkeypatch):
    original = RambergOsgood.stress
    monkeypatch.setattr(RambergOsgood, "stress", lambda *arguments: 1.05 * original(*arguments))
    assert judged(ClosedForm("plate", name)).failed


def test_an_operator_key_without_young_s_modulus_fails(monkeypatch):
    """Operators are checked when they are read, so only the number of files shows the fault."""
    case = ClosedForm("kept", "lattice-linear", resolution_mm=KEPT_GRID_MM)
    original = cache.operator_key

    class SameModulus:
        def __init__(self, solid):
            self.__dict__ = vars(solid) | {"material": replace(solid.material, young_modulus=1.0)}

    monkeypatch.setattr(
        cache, "operator_key", lambda solid, *arguments: original(SameModulus(solid), *arguments)
    )
    verdict = judged(case)
    assert verdict.failed and "1 operators are in the cache after two materials" in verdict.reason


@pytest.mark.parametrize("case", PLATES, ids=lambda case: case.model)
def test_a_missing_contact_node_fails(case, monkeypatch):
    def dropping(compliance, gap, normal_y, load, active, approach=0.0):
        solution = solve_contact(compliance, gap, normal_y, load, active, approach)
        remaining = solution.active.copy()
        remaining[np.argmin(np.where(remaining, solution.force, np.inf))] = False
        force, depth = _forces_of(compliance, gap, normal_y, load, remaining, approach)
        opening = np.where(remaining, 0.0, gap + compliance @ force + depth * normal_y)
        return replace(solution, force=force, gap=opening, approach=depth, active=remaining)

    monkeypatch.setattr(solver, "solve_contact", dropping)
    verdict = judged(case)
    assert verdict.failed, verdict.reason


def test_the_lattice_agrees_with_calculix_and_a_stiffer_result_does_not():
    verdict = judged(BESIDE_CALCULIX)
    assert verdict.kind == "converged"
    model = model_of(BESIDE_CALCULIX)
    result = model.press(
        model.prepare(BESIDE_CALCULIX.pair), BESIDE_CALCULIX.load_N, BESIDE_CALCULIX.pose
    )
    differences = peer_distances(BESIDE_CALCULIX, result)
    assert set(differences) == set(PEER_BOUNDS) and all(
        differences[key] < PEER_BOUNDS[key] for key in differences
    )
    lifted = BESIDE_CALCULIX.pair.pose_at_approach(result.pose, result.approach / 1.05)
    stiffer = replace(result, pose=lifted)
    assert peer_distances(BESIDE_CALCULIX, stiffer)["approach"] > PEER_BOUNDS["approach"]
    assert peer_distances(replace(BESIDE_CALCULIX, load_N=77.0), result) == {}


def test_a_stored_result_of_another_case_is_not_used(monkeypatch):
    monkeypatch.setattr("tkamb.studies.verdict.body_hash", lambda extreme: "another")
    verdict = judge_safely(BESIDE_CALCULIX)
    assert verdict.kind == "unverified" and "make/stability_answers" in verdict.reason


@pytest.mark.parametrize(("changed", "word"), [
    ({"nodal_force": 1.02}, "nodal forces sum to 1.0200"),
    ({"area": 1.02}, "pressures integrate to 1.0200"),
    ({"pressure": -1.0}, "negative"),
])  # fmt: skip
def test_a_result_that_contradicts_its_load_fails_a_check(changed, word):
    case = ClosedForm("plate", "foundation-linear", 500.0)
    result, _ = press_closed_form(case)
    assert complaints(result, 500.0, solved=False, source_rule=False) == []
    ((name, factor),) = changed.items()
    other = replace(result, **{name: factor * getattr(result, name)})
    assert any(word in complaint for complaint in complaints(other, 500.0, False, False))


def model_of(extreme):
    from tkamb.contact.registry import contact_model

    return contact_model(extreme.model, resolution=extreme.resolution_mm * 1e-3, cache=False)
