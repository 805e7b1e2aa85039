"""The Methods paragraph of a paper, from the summary of a run.

The paragraph states models, equations, numbers, parts that are not modelled, software and
references. Its main source is `scene_tables` in summary.json. `assets/methods.txt` has the words.
"""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tkamb.errors import InputError
from tkamb.io import texts
from tkamb.knee.ligament_laws import LIGAMENT_LAWS
from tkamb.run.claims import compared_forces, method_error
from tkamb.run.columns import WITHOUT_MUSCLES

# Largest number of characters in a line. Terminals show it without breaks.
LINE_WIDTH = 92


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


@dataclass(frozen=True)
class Methods:
    """A Methods paragraph.

    Args:
        references: cited publications, sorted.
    """

    sentences: tuple[str, ...]
    references: tuple[str, ...]

    def text(self) -> str:
        """Return the paragraph and its references as plain text."""
        paragraph = textwrap.fill(" ".join(self.sentences), LINE_WIDTH)
        cited = [
            textwrap.fill(line, LINE_WIDTH, subsequent_indent="  ") for line in self.references
        ]
        return "\n".join([paragraph, "", "References", *cited])


def methods(summary: Mapping[str, Any]) -> Methods:
    """Return the Methods paragraph of a run.

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
    sentences = texts.lines(
        "tkamb.show",
        "methods.txt",
        strict=False,  # tables and keys of a scene are optional
        tables=tables,
        summary=summary,
        versions=summary.get("versions", {}),
        measures=summary.get("measures") or {},
        contact_words=CONTACT_WORDS,
        rotations=ROTATION_ORDERS,
        laws=_laws(tables),
        generic=_generic_bundles(tables),
        material=_material_words(tables, summary),
        weights=_weights(tables["motion"].get("markers") or {}),
        meshes=MESH_NAMES,
        error=method_error(summary),
        compared=compared_forces(summary),
        # the template has sentences on the muscles that the scene lacks
        notes=[one for one in summary.get("notes") or () if not one.startswith(WITHOUT_MUSCLES)],
    )
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


def _weights(markers: Mapping[str, Any]) -> str:
    values = {w for one in markers.get("segment", ()) for w in (one.get("weights") or {}).values()}
    return "equal" if values <= {1.0} else "as in the scene file"


def _laws(tables: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return name -> words and source of the ligaments' laws. Generic bundles are "two-line"."""
    names = {one["law"] for one in tables.get("ligament") or ()} | {"two-line"}
    laws = {name: LIGAMENT_LAWS.find(name) for name in LIGAMENT_LAWS.names() if name in names}
    return {name: (law.words, law.source) for name, law in laws.items()}


def _generic_bundles(tables: Mapping[str, Any]) -> dict[str, Any]:
    chosen = (tables.get("generic_ligaments") or {}).get("ligaments") or ()
    if not chosen:
        return {}
    from tkamb.knee.ligaments import BUNDLES

    return {name: one for name, one in BUNDLES.items() if name.split("_")[0] in chosen}


MESH_NAMES = {"femoral": "femoral component", "insert": "insert", "patella": "patellar button"}


def _material_words(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    if summary.get("material"):
        from tkamb.io.given_material import material_in_words  # imports scipy

        return f"The insert was of {material_in_words(summary['material'])}."
    name = (tables.get("contact") or {}).get("material")
    if name == "polyethylene":
        return (
            "The insert was polyethylene: E = 561.5 MPa, nu = 0.45, Ramberg–Osgood with "
            "alpha = 0.0389, sigma0 = 8.4194 MPa, n = 4.5485 (Halloran 2005, as fitted by "
            "Sharma 2008)."
        )
    return f"The insert was '{name}'."
