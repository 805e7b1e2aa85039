"""Self-contained pages: their templates, and the security policy that blocks foreign scripts.

The assets lie in the folder `assets` of the package that shows them. Text that is put into a
template is escaped unless the template calls it safe.
"""

import base64
import hashlib
import re
from functools import lru_cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape


def asset(package: str, name: str) -> str:
    """Return the text of a style, script or page of a package."""
    return files(package).joinpath("assets", name).read_text(encoding="utf-8")


def render(package: str, name: str, **values: Any) -> str:
    """Return the page of a template.

    Args:
        package: package with the template, for example "tkamb.show".
        name: file name in the folder assets of the package.
        values: values of the names in the template; a missing value is an error.
    """
    return _environment(package).get_template(name).render(values)


@lru_cache(maxsize=4)
def _environment(package: str) -> Environment:
    environment = Environment(
        loader=PackageLoader(package, "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["unbroken"] = _unbroken
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment


def _unbroken(text: str) -> Markup:
    """Return HTML in which numbers keep their units and ranges their ends on one line.

    Text between backticks, a command for example, is set as code.
    """
    html = re.sub(r"(\d) (%|BW|N|MPa|mm)(?!\w)", "\\1\u00a0\\2", str(escape(text)))
    html = re.sub(r"`([^`]+)`", r"<code>\1</code>", html)
    return Markup(re.sub(r"([\d.]+–[\d.]+)", r'<span class="whole">\1</span>', html))


def policy_sources(*texts: str) -> str:
    """Return inline scripts or styles as a content security policy names them: by SHA-256.

    Args:
        texts: what stands between the tags, each whole. A browser reads line ends as \\n before
            it hashes.

    Reference: W3C, Content Security Policy Level 3, section 2.3.1.
    """
    return " ".join(f"'sha256-{_digest(text)}'" for text in texts)


def _digest(text: str) -> str:
    normal = text.replace("\r\n", "\n").replace("\r", "\n")
    return base64.b64encode(hashlib.sha256(normal.encode()).digest()).decode()
