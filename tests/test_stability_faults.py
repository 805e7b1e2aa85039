"""Faults put into the models: the study of extremes must fail by each of them.

It judges by closed forms, CalculiX's stored answers and the load, not by the models' own
solvers, which share the fault.
"""

from dataclasses import replace

import numpy as np
import pytest

from tkamb.contact.lattice import model, report, solver
from tkamb.contact.lattice.active_set import _forces_of, solve_contact
from tkamb.contact.lattice.linear import cache
from tkamb.contact.materials import RambergOsgood
from tkamb.studies.closed_forms import CLOSED_FORM, ClosedForm, closed_forms, press_closed_form
from tkamb.studies.extremes import Extreme
from tkamb.studies.stability import judge_safely, stored_verdicts
from tkamb.studies.verdict import PEER_BOUNDS, complaints, peer_distances

PLATES = [
    ClosedForm("plate", name) for name in ("lattice", "lattice-linear", "fe", "lattice-source")
]
PEERED = Extreme(resolution_mm=3.0, linear=True)


def judged(case):
    """Return the verdict on a case, with what is stored of it."""
    verdict = judge_safely(case)
    return replace(verdict, expected=stored_verdicts()[verdict.key])


@pytest.mark.parametrize("case", [c for c in closed_forms(quick=True) if c.kind != "kept"])
def test_each_family_meets_its_closed_form(case):
    assert judged(case).kind == "converged"


@pytest.mark.parametrize("case", PLATES, ids=lambda case: case.model)
def test_pressures_a_twentieth_too_high_fail(case, monkeypatch):
    honest = report._pressures

    def higher(*given):
        force, pressure, area = honest(*given)
        return force, 1.05 * pressure, area

    monkeypatch.setattr(report, "_pressures", higher)
    verdict = judged(case)
    assert verdict.failed and "pressures integrate to 1.0500" in verdict.reason


@pytest.mark.parametrize("case", PLATES[1:2], ids=lambda case: case.model)
def test_a_stiffness_a_twentieth_too_high_fails(case, monkeypatch):
    honest = model.prepare_operator
    monkeypatch.setattr(model, "prepare_operator", lambda k, *rest: honest(1.05 * k, *rest))
    verdict = judged(case)
    assert verdict.failed and "approach 4.76 % from the closed form" in verdict.reason


@pytest.mark.parametrize("name", ["lattice", "fe", "foundation", "lattice-source"])
def test_a_stiffer_curve_fails(name, monkeypatch):
    honest = RambergOsgood.stress
    monkeypatch.setattr(RambergOsgood, "stress", lambda *given: 1.05 * honest(*given))
    assert judged(ClosedForm("plate", name)).failed


def test_a_key_without_young_s_modulus_fails(monkeypatch):
    """What is read is held against the stiffness, so that only the files tell."""
    case = ClosedForm("kept", "lattice-linear", resolution_mm=CLOSED_FORM.kept_grid_mm)
    honest = cache.operator_key

    class SameModulus:
        def __init__(self, solid):
            self.__dict__ = vars(solid) | {"material": replace(solid.material, young_modulus=1.0)}

    monkeypatch.setattr(
        cache, "operator_key", lambda solid, *rest: honest(SameModulus(solid), *rest)
    )
    verdict = judged(case)
    assert verdict.failed and "1 operators are in the cache after two materials" in verdict.reason


@pytest.mark.parametrize("case", PLATES, ids=lambda case: case.model)
def test_the_weakest_node_dropped_fails(case, monkeypatch):
    def dropping(compliance, gap, normal_y, load, active, approach=0.0):
        found = solve_contact(compliance, gap, normal_y, load, active, approach)
        kept = found.active.copy()
        kept[np.argmin(np.where(kept, found.force, np.inf))] = False
        force, depth = _forces_of(compliance, gap, normal_y, load, kept, approach)
        opening = np.where(kept, 0.0, gap + compliance @ force + depth * normal_y)
        return replace(found, force=force, gap=opening, approach=depth, active=kept)

    monkeypatch.setattr(solver, "solve_contact", dropping)
    verdict = judged(case)
    assert verdict.failed, verdict.reason


def test_calculix_s_answers_hold_the_lattice_and_notice_a_changed_case():
    verdict = judged(PEERED)
    assert verdict.kind == "converged"
    contact = model_of(PEERED)
    found = contact.press(contact.prepare(PEERED.pair), PEERED.load_N, PEERED.pose)
    apart = peer_distances(PEERED, found)
    assert set(apart) == set(PEER_BOUNDS) and all(apart[key] < PEER_BOUNDS[key] for key in apart)
    lifted = PEERED.pair.pose_at_approach(found.pose, found.approach / 1.05)
    stiffer = replace(found, pose=lifted)
    assert peer_distances(PEERED, stiffer)["approach"] > PEER_BOUNDS["approach"]
    assert peer_distances(replace(PEERED, load_N=77.0), found) == {}


def test_a_stored_answer_to_another_case_is_no_reference(monkeypatch):
    monkeypatch.setattr("tkamb.studies.verdict.body_hash", lambda extreme: "another")
    verdict = judge_safely(PEERED)
    assert verdict.kind == "unverified" and "make_stability_answers" in verdict.reason


@pytest.mark.parametrize(("changed", "word"), [
    ({"nodal_force": 1.02}, "nodal forces sum to 1.0200"),
    ({"area": 1.02}, "pressures integrate to 1.0200"),
    ({"pressure": -1.0}, "negative"),
])  # fmt: skip
def test_an_answer_that_does_not_carry_its_load_is_complained_of(changed, word):
    case = ClosedForm("plate", "foundation-linear", 500.0)
    honest, _ = press_closed_form(case)
    assert complaints(honest, 500.0, solved=False, source_rule=False) == []
    ((name, factor),) = changed.items()
    other = replace(honest, **{name: factor * getattr(honest, name)})
    assert any(word in one for one in complaints(other, 500.0, False, False))


def model_of(extreme):
    from tkamb.contact.registry import contact_model

    return contact_model(extreme.model, extreme.resolution_mm, cache=False)
