"""The viewer's colours: scales and palette that colour-blind readers can tell apart.

The scales are matplotlib's (viridis, and ColorBrewer's by Brewer 2002), as bytes in an asset:
matplotlib takes a tenth of a second to load.
"""

import json
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.show.pages import asset
from tkamb.show.style import SKY

METAL, INSERT, BONE, BUTTON = "#8d99a8", "#e4dfd0", "#f0e8d2", "#dcd8cc"
FLOOR = "#b9c4c9"
TENDON, WRAPPED = "#8c3b2e", "#f0c419"
SLACK = "#9a9a9a"
RECORDED = SKY

Colours = NDArray[np.uint8]


def rgb(colour: str) -> Colours:
    """Return (3,) 0 to 255 of "#rrggbb"."""
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)


def pressure_scale() -> Colours:
    """Return the 256 colours (256, 3) from no pressure to the largest of all frames."""
    return _scales()["pressure"]


def strain_scale() -> Colours:
    """Return the 256 colours (256, 3) from no strain to the limit."""
    return _scales()["strain"]


def activation_scale() -> Colours:
    """Return the 256 colours (256, 3) from no activation to the limit."""
    return _scales()["activation"]


def wear_scale() -> Colours:
    """Return the 256 colours (256, 3) from no wear to the deepest."""
    return _scales()["wear"]


def wear_colours(depth: ArrayLike, limit: float) -> Colours:
    """Return colours (..., 3) of depths of wear; none (<= 0) is the insert's colour."""
    return _on_scale(depth, limit, wear_scale(), INSERT)


def strain_colours(strain: ArrayLike, limit: float) -> Colours:
    """Return colours (..., 3) of ligament strains; slack (strain <= 0) is grey."""
    return _on_scale(strain, limit, strain_scale())


def activation_colours(activation: ArrayLike, limit: float) -> Colours:
    """Return colours (..., 3) of activations; none (<= 0) is grey."""
    return _on_scale(activation, limit, activation_scale())


def _on_scale(values: ArrayLike, limit: float, scale: Colours, none: str = SLACK) -> Colours:
    values = np.asarray(values, float)
    level = np.clip(np.nan_to_num(values) / (limit or 1.0) * 255.0, 0.0, 255.0).astype(int)
    return np.where((values > 0)[..., None], scale[level], rgb(none)).astype(np.uint8)


@lru_cache(maxsize=1)
def _scales() -> dict[str, Colours]:
    """Return the scales (256, 3) by name."""
    stored = json.loads(asset("tkamb.show.view", "scales.json"))
    return {
        name: np.frombuffer(bytes.fromhex(text), np.uint8).reshape(256, 3)
        for name, text in stored.items()
    }
