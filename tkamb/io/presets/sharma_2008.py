"""The system of Sharma (2008): a knee from fluoroscopy to contact pressure, chapter 4."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from tkamb.io.presets.preset import Preset


class Sharma2008(Preset):
    """Sharma, dissertation, University of Tennessee, Knoxville (2008), chapter 4.

    Each choice that a key of the scene can express, with the section that describes it.
    """

    name: ClassVar[str] = "sharma-2008"
    source: ClassVar[str] = "Sharma, dissertation, University of Tennessee (2008), chapter 4"
    settings: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {
            # 4.4: "modeled to roll with slip"; slip of the lowest points of the condyles.
            "motion.motion": "roll-slip",
            # 4.4: the ground reaction, "obtained from a force plate, was applied at the ankle".
            "ground_reaction.applied": "ankle",
            # 4.4: one quadriceps and nothing else; wrapping "was taken into account".
            "muscles": None,
            "quadriceps.wrap": True,
            "patellar_ligament.wrap": True,
            # 4.5.1, 4.5.2: 26 neighbours, one stiffness E C. 5.1: cells below 1.5 mm.
            "contact.model": "lattice-source",
            "contact.resolution_mm": 1.5,
            # 4.5.5: the loops; 4.5.6: total area by number of nodes in contact.
            "contact.options": {"loops": "source", "law": "nonlinear", "pressure_rule": "source"},
            # 4.5.2, 5.2: Halloran's curve by the fit that the source gives (E, alpha, sigma0, n).
            "contact.material": "polyethylene",
            "contact.friction": 0.05,
            # 4.3: 0.5 mm, 0.5 deg; undone where penetration and angle exceed it.
            "contact.adjust": True,
            "contact.adjust_restore_when": "both",
            # 4.4, 4.5.5: the body's total force loads the lattice; there is no coupling back.
            "contact.coupling": "none",
            "contact.released": [],
            "contact.post": False,
        }
    )
    needs: ClassVar[Mapping[str, str]] = MappingProxyType(
        {
            "implant.femoral": "it presses the femoral component into the insert",
            "implant.insert": "the lattice is made from its mesh",
            "tibia": "the shank turns about the ankle in the sagittal plane",
            "ground_reaction": "the force plate's force acts at the ankle",
            "quadriceps": "its tension is solved from the equations of motion",
            "patellar_ligament": "its tension is solved from the equations of motion",
            "patella": "quadriceps and patellar ligament meet there",
        }
    )

    def lacks(self, content: Mapping[str, Any]) -> str | None:
        """Return why a motion without fluoroscopy cannot be used."""
        if content.get("motion", {}).get("interpretation") != "markers":
            return None
        return (
            "the femur's recorded pose on the insert (fluoroscopy): skin markers "
            "([motion] interpretation = 'markers') do not give it"
        )

    def departures(self, content: Mapping[str, Any]) -> tuple[str, ...]:
        """Return in words the differences between a scene and the study that remain."""
        result = []
        kind = content["tibia"].get("kind")
        if kind != "sagittal":
            result.append(f"the shank moves as recorded ([tibia] kind = '{kind}'), in 3D")
        laws = {one.get("law") for one in content.get("ligament", ())} - {"two-line"}
        if laws:
            result.append(f"ligaments follow the law {', '.join(sorted(map(repr, laws)))}")
        if content.get("generic_ligaments"):
            result.append("ligaments are a generic set scaled to the implant")
        if not content.get("ligament") and not content.get("generic_ligaments"):
            result.append("no ligaments are modelled")
        return tuple(result)
