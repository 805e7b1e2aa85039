"""The Methods paragraph of a paper, from the summary of a run.

The paragraph states models, equations, numbers, parts that are not modelled, software and
references. Its main source is `scene_tables` in summary.json.
"""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tkamb.errors import InputError
from tkamb.run.columns import WITHOUT_MUSCLES


@dataclass(frozen=True)
class MethodsTextSettings:
    """Layout of the text of `tkamb methods`."""

    line_width: int = 92
    """Largest number of characters in a line. Chosen because terminals show it without breaks."""


METHODS_TEXT = MethodsTextSettings()


REFERENCES = {
    "Abdel-Rahman 1998": "Abdel-Rahman EM, Hefzy MS (1998). Three-dimensional dynamic behaviour of "
    "the human knee joint under impact loading. Med Eng Phys 20:276.",
    "Bei 2004": "Bei Y, Fregly BJ (2004). Multibody dynamic simulation of knee contact mechanics. "
    "Med Eng Phys 26:777. doi:10.1016/j.medengphy.2004.07.004",
    "Blankevoort and Huiskes 1991": "Blankevoort L, Huiskes R (1991). Ligament-bone interaction in "
    "a three-dimensional model of the knee. J Biomech Eng 113:263. doi:10.1115/1.2894883",
    "Blankevoort 1991": "Blankevoort L et al. (1991). Articular contact in a three-dimensional "
    "model of the knee. J Biomech 24:1019. doi:10.1016/0021-9290(91)90019-J",
    "Carpentier 2019": "Carpentier J et al. (2019). The Pinocchio C++ library. Proc IEEE/SICE SII, "
    "614. doi:10.1109/SII.2019.8700380",
    "de Leva 1996": "de Leva P (1996). Adjustments to Zatsiorsky-Seluyanov's segment inertia "
    "parameters. J Biomech 29:1223. doi:10.1016/0021-9290(95)00178-6",
    "Grood 1983": "Grood ES, Suntay WJ (1983). A joint coordinate system for the clinical "
    "description of three-dimensional motions. J Biomech Eng 105:136. doi:10.1115/1.3138397",
    "Halloran 2005": "Halloran JP, Petrella AJ, Rullkoetter PJ (2005). Explicit finite element "
    "modeling of total knee replacement mechanics. J Biomech 38:323. "
    "doi:10.1016/j.jbiomech.2004.02.046",
    "Hughes 1980": "Hughes TJR (1980). Generalization of selective integration procedures to "
    "anisotropic and nonlinear media. Int J Numer Meth Eng 15:1413. doi:10.1002/nme.1620150914",
    "Johnson 1985": "Johnson KL (1985). Contact Mechanics. Cambridge University Press. "
    "doi:10.1017/CBO9781139171731",
    "Lu 1999": "Lu TW, O'Connor JJ (1999). Bone position estimation from skin marker "
    "co-ordinates. J Biomech 32:129. doi:10.1016/S0021-9290(98)00158-4",
    "Sharma 2008": "Sharma A (2008). Development of a computational model to predict the in vivo "
    "contact mechanics of modern total knee arthroplasty. Ph.D. dissertation, The University of "
    "Tennessee, Knoxville.",
    "Shin 2007": "Shin CS, Chaudhari AM, Andriacchi TP (2007). The influence of deceleration "
    "forces on ACL strain during single-leg landing. J Biomech 40:1145.",
    "Woltring 1986": "Woltring HJ (1986). A Fortran package for generalized, cross-validatory "
    "spline smoothing and differentiation. Adv Eng Softw 8:104. "
    "doi:10.1016/0141-1195(86)90098-7",
}

CONTACT_WORDS = {
    "hertz": "Hertz's theory (Johnson 1985): on each condyle an elliptical patch between surfaces "
    "of constant curvature, a rigid femoral component on a linear elastic half-space",
    "foundation": "an elastic foundation of independent columns under a rigid femoral component "
    "(Blankevoort 1991, Bei 2004), p = sigma(-(M/E) ln(1 - d/h)) with d the penetration along the "
    "insert's normal, h the local thickness, M = E(1 - nu)/((1 + nu)(1 - 2 nu)) and sigma the "
    "uniaxial curve of the material",
    "foundation-linear": "an elastic foundation of independent linear columns under a rigid "
    "femoral component (Blankevoort 1991), p = M d/h with d the penetration along the insert's "
    "normal, h the local thickness and M = E(1 - nu)/((1 + nu)(1 - 2 nu))",
    "lattice": "a lattice of springs between each node and its 26 neighbours (Sharma 2008), "
    "calibrated cell by cell to E and nu, with one secant shear modulus a cell from its "
    "equivalent strain and an elastic bulk modulus; the femoral component is rigid and "
    "frictionless, the strain small",
    "lattice-linear": "a lattice of springs between each node and its 26 neighbours (Sharma 2008), "
    "calibrated cell by cell to E and nu, linear elastic; the femoral component is rigid and "
    "frictionless, the strain small",
    "lattice-source": "the spring lattice of Sharma (2008): one stiffness for all springs, "
    "k = E C, displacement driven",
    "fe": "finite elements, hexahedra with B-bar (Hughes 1980), with J2 deformation theory; the "
    "femoral component is rigid and frictionless, the strain small",
}

ROTATION_ORDERS = {
    "coordinates": "the six coordinates of Grood and Suntay (1983)",
    "pose": "three-dimensional poses of the femoral component in the insert, turned into the "
    "coordinates of Grood and Suntay (1983)",
    "markers": "skin markers",
}

LAWS = {
    "two-line": (
        "F = (k/2)(L - L0) up to a strain of 0.06 and F = k(L - 1.03 L0) beyond it",
        "Shin 2007",
    ),
    "quadratic-toe": (
        "F = k eps^2/0.12 up to a strain of 0.06 and F = k(eps - 0.03) beyond it",
        "Blankevoort and Huiskes 1991",
    ),
}


@dataclass(frozen=True)
class Methods:
    """A Methods paragraph.

    Args:
        sentences: sentences of the paragraph.
        references: cited publications, sorted.
    """

    sentences: tuple[str, ...]
    references: tuple[str, ...]

    def text(self) -> str:
        """Return the paragraph and its references as plain text."""
        paragraph = textwrap.fill(" ".join(self.sentences), METHODS_TEXT.line_width)
        cited = [
            textwrap.fill(line, METHODS_TEXT.line_width, subsequent_indent="  ")
            for line in self.references
        ]
        return "\n".join([paragraph, "", "References", *cited])


def methods(summary: Mapping[str, Any]) -> Methods:
    """Return the Methods paragraph of a run.

    Args:
        summary: `results.summary`, or the content of summary.json.

    Raises:
        InputError: the summary has no `scene_tables`. A version before 0.2.0 wrote it.
    """
    tables = summary.get("scene_tables")
    if not isinstance(tables, Mapping):
        raise InputError(
            "does not say what was modelled (no 'scene_tables')",
            "summary.json",
            "run the scene again with this version",
        )
    sentences: list[str] = []
    for part in (_software, _patient, _motion, _ground, _equations, _ligaments, _extensor):
        sentences += part(tables, summary)
    sentences += [
        *_contact(tables, summary),
        *_left_out(summary),
        *_changed(summary),
        *_notes(summary),
    ]
    text = " ".join(sentences)
    cited = [full for key, full in REFERENCES.items() if _is_cited(key, text)]
    return Methods(tuple(sentences), tuple(sorted(cited)))


def _is_cited(key: str, text: str) -> bool:
    author, year = key.rsplit(" ", 1)
    return (
        f"{author} {year}" in text
        or f"{author} ({year})" in text
        or (key == "Grood 1983" and "Grood and Suntay (1983)" in text)
    )


def _software(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    versions = summary.get("versions", {})
    others = [f"{name} {versions[name]}" for name in ("numpy", "scipy") if name in versions]
    yield (
        f"Knee forces and contact were computed with tkamb {versions.get('tkamb', '')} on "
        f"Pinocchio {versions.get('pin', '')} (Carpentier 2019; {', '.join(others)})."
    )


def _patient(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    patient = tables["patient"]
    size = f", {patient['height_mm']:g} mm" if patient.get("height_mm") else ""
    yield (
        f"The {patient['side']} leg of a subject of {patient['mass_kg']:g} kg{size} was a chain of "
        "rigid segments (shank with foot, thigh, patella)."
    )
    if patient.get("sex"):
        yield (
            f"Segments whose URDF gives no inertia have those of de Leva 1996 ({patient['sex']})."
        )
    if summary.get("side") == "left":
        yield "It was computed as its mirror image."


def _motion(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    motion = tables["motion"]
    yield f"The knee's motion came from {ROTATION_ORDERS[motion['interpretation']]}."
    markers = motion.get("markers")
    if markers:
        way = (
            "each segment's markers were fitted by least squares"
            if markers["method"] == "segments"
            else "a chain of segments was fitted to all markers by least squares (Lu 1999)"
        )
        yield f"For that {way}; weights: {_weights(markers)}."
    rate = (summary.get("measures") or {}).get("frame_rate_Hz")
    if rate is not None:
        words = "had" if motion.get("frames") is None else "was resampled to"
        yield f"The motion {words} {rate:.4g} frames per second."
    yield f"The coordinates were {_filter_words(motion['cutoff_Hz'])}."
    if motion.get("motion") == "roll-slip":
        yield (
            "Flexion and rotations were prescribed; the anterior–posterior translation came from "
            f"rolling with a slip share of {motion['slip_share']:g} and the height from contact "
            "(Sharma 2008)."
        )
    count, failed = summary.get("frames"), len(summary.get("failed_frames", ()))
    if count:
        failures = f"{failed} of them failed and are left out" if failed else "none of them failed"
        yield f"{count} frames were computed; {failures}."


def _weights(markers: Mapping[str, Any]) -> str:
    values = {w for one in markers.get("segment", ()) for w in (one.get("weights") or {}).values()}
    return "equal" if values <= {1.0} else "as in the scene file"


def _filter_words(cutoff: Any) -> str:
    if cutoff == "none":
        return "interpolated by a quintic spline without a filter"
    return (
        f"low-pass filtered at {cutoff:g} Hz by a quintic smoothing spline (Woltring 1986), whose "
        "frequency response 1/(1 + (f/fc)^6) is that of a third-order Butterworth filter run "
        "forwards and backwards (half the amplitude at the cut-off, no phase shift)"
    )


def _ground(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    ground = tables.get("ground_reaction")
    if ground is None:
        yield "No ground reaction was applied."
        return
    where = (
        "at the measured centre of pressure, with its free moment, on shank and foot"
        if ground["applied"] == "cop"
        else "as a force at the ankle's centre, without its moment (Sharma 2008)"
    )
    cutoff = ground["cutoff_Hz"]
    yield f"The ground reaction acted {where}."
    if cutoff == tables["motion"]["cutoff_Hz"]:
        yield "It was filtered like the motion." if cutoff != "none" else "It was not filtered."
    else:
        yield f"It was {_filter_words(cutoff)}."


def _equations(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    yield (
        "Inverse dynamics (recursive Newton–Euler) gave the generalised forces; the magnitudes of "
        "the unknown loads follow from the equations of motion of the free chain, "
        "sum_k J_k^T w_k x_k = tau, with the force and moment at the hip and three residuals at "
        "the knee (anterior–posterior and medial–lateral force, axial moment) among the unknowns "
        "(Sharma 2008)."
    )


def _ligaments(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    bundles = tables.get("ligament") or []
    for law, (words, source) in LAWS.items():
        some = [bundle for bundle in bundles if bundle["law"] == law]
        if some:
            yield (
                f"Ligaments carried tension only: {words}, with L0 the slack length ({source}); "
                f"{'; '.join(_ligament_words(bundle) for bundle in some)}."
            )
    generic = tables.get("generic_ligaments")
    if generic:
        words, source = LAWS["two-line"]
        yield (
            "Generic bundles, not of this subject, were attached in proportion to the implant's "
            f"width and carried tension only: {words}, with L0 the slack length ({source}); "
            "stiffness of Abdel-Rahman 1998 and strain in extension of Blankevoort and Huiskes "
            f"1991: {'; '.join(_generic_words(generic['ligaments']))}."
        )
    if not bundles and not generic:
        yield "No ligaments were modelled."


def _generic_words(chosen: Sequence[str]) -> Iterator[str]:
    from tkamb.knee.ligaments import BUNDLES

    for name, bundle in BUNDLES.items():
        if name.split("_")[0] in chosen:
            yield (
                f"{name} k = {bundle.stiffness_N_per_mm:g} N/mm, strain {bundle.reference_strain:g}"
            )


def _ligament_words(bundle: Mapping[str, Any]) -> str:
    if bundle.get("stiffness_N_per_mm") is not None:
        stiffness = f"k = {bundle['stiffness_N_per_mm']:g} N/mm"
    else:
        stiffness = f"k = {bundle['stiffness_N_per_strain']:g} N per unit strain"
    if bundle.get("slack_length_mm") is not None:
        return f"{bundle['name']} {stiffness}, L0 = {bundle['slack_length_mm']:.4g} mm"
    return (
        f"{bundle['name']} {stiffness}, strain {bundle['reference_strain']:g} at "
        f"{bundle['reference_flexion_deg']:g} deg"
    )


def _extensor(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    if not tables.get("patella"):
        yield "Neither patella nor muscles were modelled."
        return
    lines = ["the quadriceps"] if tables.get("quadriceps") else []
    lines += [one["name"] for one in tables.get("muscle") or []]
    yield (
        f"{', '.join(lines).capitalize()} and the patellar ligament were massless lines, wrapped "
        "around the sagittal outline of bone and component and of the insert's lip; the patella "
        f"was {_patella_words(tables['patella']['motion'])}."
    )
    muscles = tables.get("muscles")
    if not muscles:
        yield "No other muscle acted: co-contraction is left out, so the forces are lower bounds."
        return
    weights = "volume-weighted " if muscles["weights"] == "volume" else ""
    yield (
        "The muscles of an OpenSim model shared the joint moments of the leg by minimising the "
        f"{weights}sum of activations to the power {muscles['exponent']:g}, frame by frame, with a "
        f"least activation of {muscles['least_activation']:g} and the force law "
        f"'{muscles['law']}'; reserves: {_reserves(muscles.get('reserve_Nm'))}."
    )


def _reserves(value: Any) -> str:
    if value is None:
        return "10 N·m at knee, ankle and subtalar joint, without cost at the hip"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {moment:g} N·m" for name, moment in value.items())
    return f"{value:g} N·m at each coordinate"


def _patella_words(motion: str) -> str:
    if motion == "recorded":
        return "moved as recorded"
    return (
        "placed where it touches the femoral component with the patellar ligament at its length "
        "and the moments in the sagittal plane in equilibrium"
    )


def _contact(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> Iterator[str]:
    contact = tables.get("contact")
    if contact is None:
        yield "Contact was not modelled."
        return
    words = CONTACT_WORDS.get(contact["model"], f"the contact model '{contact['model']}'")
    material = summary.get("material") or {}
    yield f"Femorotibial contact was {words}; points lay {contact['resolution_mm']:g} mm apart."
    yield _material_words(contact, material)
    yield from _mesh_words(summary.get("measures") or {})
    insert = (tables.get("implant") or {}).get("insert") or {}
    if "bearing" in insert:
        yield f"The bearing was {insert['bearing']}."
    yield (
        f"Coulomb friction with a coefficient of {contact['friction']:g} acted against the sliding."
    )
    if contact.get("adjust"):
        yield "The femoral component was adjusted by up to 0.5 mm and 0.5 deg (Sharma 2008)."
    if contact.get("released"):
        yield (
            f"These coordinates were not prescribed but found in equilibrium: "
            f"{', '.join(contact['released'])}."
        )
    elif contact.get("coupling") == "points":
        yield "Contact points and loads were iterated until they converged."
    else:
        yield (
            "The femoral component was pressed onto the insert with the superior–inferior load, "
            "at the recorded rotation."
        )
    error = summary.get("known_error")
    if isinstance(error, str):
        yield "The error of this setting of the contact model was not measured."
    elif isinstance(error, Mapping):
        yield (
            "On the cases of tkamb's trade-off study the error of this setting was at most "
            f"{100 * error['peak_pressure']:.2g} % in peak pressure and "
            f"{100 * error['area']:.2g} % in area."
        )
    elif error:
        yield f"The error of this setting was {error}."


MESH_NAMES = {"femoral": "femoral component", "insert": "insert", "patella": "patellar button"}


def _mesh_words(measures: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences on meshes, thickness of the insert and tolerances of the contact solver."""
    meshes = [
        f"{one['triangles']} triangles for the {MESH_NAMES.get(name, name)} "
        f"(median edge {one['edge_mm']:.2g} mm)"
        for name, one in (measures.get("meshes") or {}).items()
    ]
    if meshes:
        yield (
            f"The surface meshes had {', '.join(meshes)}. The median is over the longest edge of "
            "each triangle."
        )
    thickness = measures.get("insert_thickness_mm")
    if thickness:
        low, high = (f"{one:.1f}" for one in thickness)
        span = low if low == high else f"{low} to {high}"
        yield f"Below the centres of pressure the insert was {span} mm thick."
    tolerances = measures.get("tolerances") or {}
    if "load" in tolerances:
        yield (
            "The contact force agreed with the load to a relative tolerance of "
            f"{tolerances['load']:g}."
        )
    if "gap" in tolerances:
        yield (
            "The contact solver stopped at a residual force of at most "
            f"{tolerances['force']:g} of the contact forces, and a gap or penetration of the "
            f"contact nodes of at most {tolerances['gap']:g} of their largest displacement."
        )


def _material_words(contact: Mapping[str, Any], material: Mapping[str, Any]) -> str:
    if material:
        from tkamb.io.given_material import material_in_words  # imports scipy

        return f"The insert was of {material_in_words(material)}."
    if contact["material"] == "polyethylene":
        return (
            "The insert was polyethylene: E = 561.5 MPa, nu = 0.45, Ramberg–Osgood with "
            "alpha = 0.0389, sigma0 = 8.4194 MPa, n = 4.5485 (Halloran 2005, as fitted by "
            "Sharma 2008)."
        )
    return f"The insert was '{contact['material']}'."


def _left_out(summary: Mapping[str, Any]) -> Iterator[str]:
    absent = summary.get("not_modelled") or []
    if absent:
        yield f"Not modelled: {', '.join(absent)}."


def _changed(summary: Mapping[str, Any]) -> Iterator[str]:
    changed = summary.get("changed_settings") or {}
    if changed:
        listed = ", ".join(f"{name} = {value}" for name, value in changed.items())
        yield f"Settings that differ from tkamb's defaults: {listed}."


def _notes(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield the notes of the scene, on the origin of its inputs and on assumptions."""
    for note in summary.get("notes") or ():
        if not note.startswith(WITHOUT_MUSCLES):  # `_extensor` has a sentence on this
            yield note if note.endswith((".", "!", "?")) else f"{note}."
