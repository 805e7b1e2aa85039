"""Presets by name: the built-in ones and those of other packages.

A built-in is one row here, "name": "module:Class", imported only when asked for. Another package
offers one through the entry-point group `tkamb.io.presets`:

    [project.entry-points."tkamb.io.presets"]
    my-study-2026 = "my_package.my_module:MyStudy"

where `MyStudy` is a subclass of `tkamb.io.presets.preset.Preset`.
"""

from tkamb.contact.named_classes import NamedClasses
from tkamb.io.presets.preset import Preset

BUILT_IN = {
    "sharma-2008": "tkamb.io.presets.sharma_2008:Sharma2008",
}

PRESETS = NamedClasses("preset", Preset, "tkamb.io.presets", BUILT_IN)


def preset_names() -> tuple[str, ...]:
    """Return the names of all presets, built-in ones first.

    Raises:
        InputError: two packages offer the same name.
    """
    return PRESETS.names()


def find_preset(name: str) -> Preset:
    """Return the preset of that name.

    Raises:
        InputError: no such name, a name clash, or it cannot be imported.
    """
    return PRESETS.find(name)()
