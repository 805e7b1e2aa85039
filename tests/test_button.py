"""The patellar button pressed on the femoral component: closed form, finite elements, statics."""

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from knee_bodies import MIRROR, whole_body
from scenes import MODEL, write_scene
from shapes import block, sphere
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import inverse, pose
from tkamb.geometry.surface import Surface
from tkamb.knee.button import TURN, Button, button_in_patella, without_pegs
from tkamb.knee.contact import KneeContact
from tkamb.run.known_errors import known_error

FORCES = (500.0, 1000.0, 2000.0, 4000.0)
PRESSED = {"contact.model": "foundation", "contact.patellofemoral.model": "foundation"}
FRAME = 75


@pytest.fixture(scope="module")
def read():
    return tkamb.read_scene(tkamb.load_scene(MODEL / "scene.toml", PRESSED))


def links(knee, q):
    """Return femur and patella in the insert frame, and the contact normal."""
    data = knee.create_data()
    kinematics = knee._kinematics(data, q)
    patella = knee._find_patella(kinematics, data)
    poses = knee._link_poses(kinematics, patella)
    return poses["femur"], poses["patella"], patella.contact_normal


def in_patella(body):
    """Return a body of the button frame in the patella's frame."""
    return body.moved(inverse(pose(TURN, np.zeros(3))))


def dome_of(radius, spacing):
    """Return a dome 9 mm high and 34 mm wide, in the button frame."""
    return block(lambda x, z: 9e-3 - (x**2 + z**2) / (2 * radius), 0.034, 0.034, spacing, "button")


def plate_above():
    """Return a rigid plate that faces down, in the button frame."""
    plate = block(lambda x, z: np.full_like(x, 5e-3), 0.05, 0.05, 5e-3, "plate")
    return plate.moved(pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)))


@pytest.mark.parametrize("force", FORCES)
def test_a_dome_on_a_plate_has_the_approach_of_its_closed_form(force):
    """A dome of radius R and height H, whose columns along y have the height H - u, u = r²/2R.

    Under a rigid plate at the approach d their linear pressure is M (d - u)/(H - u). Its integral
    is 2 pi R M (d - (H - d) ln(H/(H - d))).
    """
    radius, height = 80e-3, 9e-3
    dome, linear = dome_of(radius, 0.25e-3), material("polyethylene-linear")
    femoral, button = in_patella(plate_above()), in_patella(dome)
    place = button_in_patella(button)
    pair = ContactPair(femoral, button.moved(inverse(place)), linear)
    pair.__dict__["split"] = 0.0
    model = contact_model("foundation-linear", resolution=0.5e-3)
    press = Button(KneeContact(model, pair, 0.0), place).pressed(
        pose(np.eye(3), [-0.05, 0.0, 0.0]), np.eye(4), np.array([force, 0.0, 0.0])
    )
    d, m = press.contact.approach, linear.confined_modulus
    exact = 2 * np.pi * radius * m * (d - (height - d) * np.log(height / (height - d)))
    assert press.on_patella[0] == pytest.approx(force, rel=1e-5)
    assert exact == pytest.approx(force, rel=0.01)
    # The bodies are symmetric: both facets carry half, and the resultant passes the middle.
    halves = [press.facets[side].force for side in ("medial", "lateral")]
    assert halves[0] == pytest.approx(halves[1], rel=1e-9)
    assert np.abs(press.on_patella[1:]).max() < 1e-6 * force


@pytest.fixture(scope="module")
def finite_elements(read):
    knee, motion, _ = read
    model = contact_model("fe", resolution=1.5e-3)
    button = Button(
        KneeContact(model, knee.button_contact.pair, 0.0), knee.button_contact.in_patella
    )
    femur, patella, normal = links(knee, motion.q[FRAME])
    presses, start = {}, None
    for force in FORCES:
        presses[force] = button.pressed(femur, patella, force * normal, start)
        start = presses[force].start
    return presses


@pytest.mark.parametrize("force", FORCES)
def test_a_dome_in_its_groove_is_within_the_stated_error_of_finite_elements(
    read, finite_elements, force
):
    """Peak, area and approach of the foundation at 1 mm, on the shipped button and groove."""
    knee, motion, _ = read
    model = contact_model("foundation", resolution=1e-3)
    button = Button(
        KneeContact(model, knee.button_contact.pair, 0.0), knee.button_contact.in_patella
    )
    femur, patella, normal = links(knee, motion.q[FRAME])
    ours, peer = button.pressed(femur, patella, force * normal), finite_elements[force]
    error = known_error("foundation", 1.0, "polyethylene")
    for quantity in ("peak_pressure", "area"):
        mine, other = (
            f(getattr(facet, quantity) for facet in press.facets.values())
            for press in (ours, peer)
            for f in [max if quantity == "peak_pressure" else sum]
        )
        assert abs(mine / other - 1) < getattr(error, quantity), quantity
    assert ours.contact.approach == pytest.approx(peer.contact.approach, rel=error.approach)
    assert ours.on_patella[:3] == pytest.approx(peer.on_patella[:3], abs=0.02 * force)


@pytest.mark.parametrize("left", [False, True])
def test_the_forces_on_femur_and_patella_are_opposite(read, left):
    plain, motion, ground = read
    body = whole_body(plain, left)
    q = body.state(motion.q[FRAME], motion.v[FRAME], motion.a[FRAME], ground[FRAME])[0]
    result = body.knee.press_patella(q, 2000.0)
    data = body.model.createData()
    pin.framesForwardKinematics(body.model, data, q)
    femur, patella = (data.oMf[body.model.getFrameId(name)] for name in ("thigh_x", "kneecap"))
    on_femur = femur.act(result.on_femoral)
    # The press moves the patella along the button's axis, which leaves the force but not its place.
    travel = (
        result.contact.pose.translation
        - ((patella * result.button_in_patella).inverse() * femur).translation
    )
    assert np.abs(travel[[0, 2]]).max() < 1e-9
    moved = patella * result.button_in_patella
    moved.translation = moved.translation - moved.rotation @ travel
    on_patella = (moved * result.button_in_patella.inverse()).act(result.on_patella)
    assert np.abs(on_femur.vector + on_patella.vector).max() < 1e-12 * 2000.0


def test_a_left_button_is_the_mirror_image_of_a_right_one(read):
    plain, motion, ground = read
    state = (motion.q[FRAME], motion.v[FRAME], motion.a[FRAME], ground[FRAME])
    results = []
    for left in (False, True):
        body = whole_body(plain, left)
        results.append(body.knee.press_patella(body.state(*state)[0], 2000.0))
    right, left = results
    assert left.contact.pressure == pytest.approx(right.contact.pressure, rel=1e-6, abs=1.0)
    assert left.contact.points == pytest.approx(right.contact.points @ MIRROR, abs=1e-12)
    assert left.on_patella.linear == pytest.approx(MIRROR @ right.on_patella.linear, abs=1e-5)
    assert left.on_patella.angular == pytest.approx(-MIRROR @ right.on_patella.angular, abs=1e-6)
    for side in ("medial", "lateral"):
        forces = [getattr(result.contact, side).force for result in results]
        assert forces[0] == pytest.approx(forces[1], rel=1e-6)


def test_the_table_adds_columns_and_changes_no_other():
    frames = slice(0, 101, 25)
    scene = MODEL / "scene.toml"
    without = tkamb.simulate(scene, contact="foundation", frames=frames)
    pressed = tkamb.simulate(scene, frames=frames, overrides=PRESSED)
    added = set(pressed.columns) - set(without.columns)
    assert added and all(name.startswith("button_") for name in added)
    assert "patellofemoral" not in without.summary["contact"] and without.button_maps is None
    for name, values in without.columns.items():
        if name != "status" and not name.endswith("_seconds"):
            assert np.array_equal(values, pressed.columns[name], equal_nan=True), name
    # The contact carries the force of the equations, and both facets of the symmetric knee alike.
    assert pressed["button_force_N"] == pytest.approx(pressed["patellofemoral_N"], rel=2e-3)
    assert pressed["button_medial_force_N"] == pytest.approx(
        pressed["button_lateral_force_N"], rel=2e-3
    )
    assert (pressed["button_imbalance_N"] < 2e-3 * pressed["patellofemoral_N"]).all()
    # The contact moves from inferior to superior with flexion.
    assert pressed["button_cop_si_mm"][-1] > pressed["button_cop_si_mm"][0] + 5.0
    maps = pressed.button_maps
    sums = np.linalg.norm(maps.forces_N, axis=1)
    assert sums == pytest.approx(pressed["button_force_N"], rel=1e-12)
    assert maps.peaks_Pa / 1e6 == pytest.approx(pressed["button_peak_pressure_MPa"], rel=1e-12)


def test_a_resumed_run_has_the_same_button(tmp_path):
    scene, frames = MODEL / "scene.toml", slice(40, 44)
    whole = tkamb.simulate(scene, frames=frames, overrides=PRESSED)

    def stop(indices):
        yield from list(indices)[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tkamb.simulate(scene, frames=frames, overrides=PRESSED, directory=tmp_path, progress=stop)
    half = tkamb.read_results(tmp_path)
    assert np.isfinite(half["button_force_N"][:2]).all()
    tkamb.simulate(scene, frames=frames, overrides=PRESSED, directory=tmp_path, resume=True)
    resumed = tkamb.read_results(tmp_path)
    for name in ("button_peak_pressure_MPa", "button_area_mm2", "button_approach_mm"):
        assert resumed[name] == pytest.approx(whole[name], rel=1e-5)
    assert len(resumed.button_maps) == len(whole)
    assert resumed.button_maps.pressure_Pa == pytest.approx(whole.button_maps.pressure_Pa, abs=1e3)
    (tmp_path / "button.h5").unlink()
    with pytest.raises(InputError, match=r"button\.h5 is missing"):
        tkamb.read_results(tmp_path)


def displaced(patella, femur, up=0.0, turn=0.0):
    """Return the patella moved up along the femur (m), then tilted by an angle (rad)."""
    moved = patella.copy()
    moved[:3, 3] += up * femur[:3, 1]
    c, s = np.cos(turn), np.sin(turn)
    moved[:3, :3] = moved[:3, :3] @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return moved


def test_what_is_wrong_with_the_button_is_in_words(read):
    knee, motion, _ = read
    femur, patella, normal = links(knee, motion.q[10])
    button = knee.button_contact
    assert button.pressed(femur, patella, 300.0 * normal).words == ()
    above = button.pressed(femur, displaced(patella, femur, up=0.025), 300.0 * normal)
    assert any("edge of the femoral component" in words for words in above.words)
    off = button.pressed(femur, displaced(patella, femur, up=0.1), 300.0 * normal)
    assert off.contact is None and "does not lie over the button" in off.problem
    lifted = button.pressed(femur, patella, -300.0 * normal)
    assert "lifted off" in lifted.problem and np.isnan(lifted.on_patella).all()
    tilted = button.pressed(femur, displaced(patella, femur, turn=np.radians(15)), 300.0 * normal)
    assert any("facet is unloaded" in words for words in tilted.words)


def test_a_scene_with_a_patella_off_the_flange_says_so(tmp_path):
    """The recorded patella is moved up by 30 mm, so that the button is above the flange."""
    path = write_scene(tmp_path, contact__patellofemoral={"model": "foundation"})
    lines = (tmp_path / "motion.csv").read_text().splitlines()
    head = lines[0].split(",")
    column = head.index("patella_si_mm")
    for k, line in enumerate(lines[1:], 1):
        cells = line.split(",")
        cells[column] = str(float(cells[column]) + 60.0)
        lines[k] = ",".join(cells)
    (tmp_path / "motion.csv").write_text("\n".join(lines) + "\n")
    results = tkamb.simulate(path, frames=slice(20, 21))
    assert "button: " in results.status[0]
    assert np.isnan(results["button_force_N"][0]) and np.isfinite(
        results["button_contact_seconds"][0]
    )


def test_bodies_and_tables_that_do_not_fit_are_refused(read, tmp_path):
    knee, *_ = read
    button = knee.button
    with pytest.raises(InputError, match="not closed"):
        button_in_patella(Surface(button.vertices, button.faces[1:], "button"))
    with pytest.raises(InputError, match="flat back"):
        button_in_patella(sphere(0.015))
    with pytest.raises(InputError, match="no patellofemoral contact model"):
        tkamb.Knee(knee.model).press_patella(pin.neutral(knee.model), 100.0)
    with pytest.raises(InputError, match="positive force"):
        knee.press_patella(read[1].q[0], 0.0)
    with pytest.raises(InputError, match="needs extensor"):
        tkamb.Knee(knee.model, patellofemoral_contact="foundation")
    path = write_scene(
        tmp_path,
        drop=("patella", "quadriceps", "patellar_ligament"),
        contact__patellofemoral={"model": "foundation"},
    )
    with pytest.raises(InputError, match="patellofemoral"):
        tkamb.load_scene(path)


def test_a_force_beyond_the_model_is_an_error_in_words(read):
    knee, motion, _ = read
    with pytest.raises(ComputationError, match="button: out of range"):
        knee.press_patella(motion.q[FRAME], 1e6)


def test_the_report_shows_the_button(tmp_path):
    from tkamb.show.report import report_html

    results = tkamb.simulate(MODEL / "scene.toml", frames=slice(0, 101, 50), overrides=PRESSED)
    page = report_html(results)
    assert "Pressure on the patellar button" in page and 'id="figure-button_pressure"' in page
    other = report_html(
        tkamb.simulate(MODEL / "scene.toml", contact="foundation", frames=slice(0, 1))
    )
    assert "Pressure on the patellar button" not in other


def test_pegs_do_not_deform():
    """A dome on a plate, with a peg of 3 mm on its back and without: the presses are equal."""
    dome = dome_of(80e-3, 0.5e-3)
    vertices = dome.vertices.copy()
    peg = (vertices[:, 1] == 0.0) & (np.abs(vertices[:, [0, 2]]).max(axis=1) < 4e-3)
    vertices[peg, 1] = -3e-3
    presses = []
    for body in (dome, without_pegs(Surface(vertices, dome.faces, "button"))):
        pair = ContactPair(plate_above(), body, material("polyethylene"))
        pair.__dict__["split"] = 0.0
        model = contact_model("foundation", resolution=0.5e-3)
        presses.append(model.press(model.prepare(pair), 2000.0, np.eye(4)))
    pegged, plain = presses
    assert pegged.approach == pytest.approx(plain.approach, rel=1e-9)
    assert pegged.pressure == pytest.approx(plain.pressure, abs=1.0)
    assert pegged.flags == plain.flags
