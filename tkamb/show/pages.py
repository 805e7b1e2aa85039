"""Self-contained HTML pages: templates, and the security policy that blocks foreign scripts.

Templates, styles and scripts are in the folder `assets` of each package. Values in a template are
escaped unless the template marks them as safe.
"""

import base64
import hashlib
import re
from importlib.resources import files
from typing import Any

from markupsafe import Markup, escape

from tkamb.io.texts import environment


def asset(package: str, name: str) -> str:
    """Return the text of a file in the folder `assets` of a package."""
    return files(package).joinpath("assets", name).read_text(encoding="utf-8")


def render(package: str, name: str, **values: Any) -> str:
    """Return the page that a template makes from values.

    Args:
        values: values of the names in the template. A missing value raises an error.
    """
    pages = environment(package, True)
    pages.filters["unbroken"] = _unbroken
    return pages.get_template(name).render(values)


def _unbroken(text: str) -> Markup:
    """Remove line breaks between number and unit, or within a range; text between backticks becomes
    code.
    """
    html = re.sub(r"(\d) (%|BW|N|MPa|mm)(?!\w)", "\\1\u00a0\\2", str(escape(text)))
    html = re.sub(r"`([^`]+)`", r"<code>\1</code>", html)
    return Markup(re.sub(r"([\d.]+–[\d.]+)", r'<span class="whole">\1</span>', html))


def policy_sources(*texts: str) -> str:
    """Return the SHA-256 sources of inline scripts or styles for a content security policy.

    Line ends count as \\n, as in browsers.

    Source: W3C, Content Security Policy Level 3, section 2.3.1.
    """
    return " ".join(f"'sha256-{_digest(text)}'" for text in texts)


def _digest(text: str) -> str:
    normal = text.replace("\r\n", "\n").replace("\r", "\n")
    return base64.b64encode(hashlib.sha256(normal.encode()).digest()).decode()
