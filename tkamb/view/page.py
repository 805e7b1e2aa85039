"""The page around the scene: one HTML that needs nothing from elsewhere."""

import base64
import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import meshcat

from tkamb.atomic import write_text
from tkamb.output.pages import policy_sources

SCRIPTS = ("scene.js", "moving.js", "controls.js", "start.js")
POLICY = (
    "default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; "
    "img-src data: blob:; connect-src {connect}; base-uri 'none'; form-action 'none'"
)
"""The browser itself refuses any request to another place and any script but the page's own, by
their hashes; meshcat's viewer adds styles as it runs."""


def page_html(
    title: str,
    packed: bytes | None,
    *,
    frame: int = 0,
    view: str = "oblique",
    live: Sequence[str] | None = None,
) -> str:
    """Return the page.

    Args:
        title: heading.
        packed: the drawings (`tkamb.view.payload.pack`); None when a server gives them.
        frame: shown first.
        view: camera that is chosen first.
        live: contact models that the server can compute; None without a server.
    """
    asked: dict[str, Any] = {"frame": frame, "view": view, "live": live}
    data = ""
    if packed is not None:
        text = base64.b64encode(packed).decode()
        data = f'<script type="application/octet-stream" id="data">{text}</script>'
    scripts = [_escaped(text) for text in (_meshcat(), *map(_own, SCRIPTS))]
    connect = "'none'" if live is None else "'self'"
    return _filled(
        _own("page.html"),
        title=escape(title),
        policy=POLICY.format(scripts=policy_sources(*scripts), connect=connect),
        style=_own("style.css"),
        asked=json.dumps(asked).replace("<", "\\u003c"),
        data=data,
        scripts="\n".join(f"<script>{text}</script>" for text in scripts),
    )


def write_page(path: Path, html: str) -> None:
    """Write the page, whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    write_text(path, html)


def _filled(template: str, **parts: str) -> str:
    """Put the parts in, each once, so that a part's own braces stay as they are."""
    for name in parts:
        before, _, after = template.partition("{" + name + "}")
        if name == "title":
            after = after.replace("{title}", parts[name])
        template = before + "\0" + name + "\0" + after
    for name, text in parts.items():
        template = template.replace("\0" + name + "\0", text)
    return template


def _own(name: str) -> str:
    return files("tkamb.view").joinpath("assets", name).read_text(encoding="utf-8")


def _meshcat() -> str:
    """Return meshcat's viewer, three.js included, as its package ships it."""
    root = Path(meshcat.__file__).parent
    return (root / "viewer" / "dist" / "main.min.js").read_text(encoding="utf-8")


def _escaped(text: str) -> str:
    """Return a script as it may stand between its tags."""
    return "\n" + text.replace("</script", "<\\/script")
