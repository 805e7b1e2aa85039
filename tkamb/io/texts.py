"""Templates: sentences as plain text, and HTML pages.

They are in the folder `assets` of each package and state the words, Python the facts.
"""

import re
from functools import lru_cache
from typing import Any

from jinja2 import ChainableUndefined, Environment, PackageLoader, StrictUndefined


@lru_cache(maxsize=8)
def environment(package: str, html: bool, strict: bool = True) -> Environment:
    """Return the environment of a package's templates.

    Args:
        strict: whether a missing value raises an error. Otherwise it is empty and false.
    """
    result = Environment(
        loader=PackageLoader(package, "assets"),
        autoescape=html,
        undefined=StrictUndefined if strict else ChainableUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    result.filters["number"] = lambda value, digits=2: f"{value:.{digits}f}"
    result.filters["general"] = lambda value, digits=6: f"{value:.{digits}g}"
    result.filters["percent"] = lambda share, digits=0: f"{100 * share:.{digits}f} %"
    result.filters["frames"] = lambda count: f"{count} frame{'s' * (count != 1)}"
    result.filters["sentence"] = sentence
    result.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return result


def lines(package: str, name: str, *, strict: bool = True, **facts: Any) -> list[str]:
    """Return the lines of text that a template makes from facts, without empty ones."""
    return nonempty(environment(package, False, strict).get_template(name).render(facts))


def nonempty(text: str) -> list[str]:
    """Return the lines of a text without empty ones; runs of blanks become one."""
    stripped = (re.sub(r"[ \t]+", " ", line).strip() for line in text.split("\n"))
    return [line for line in stripped if line]


def sentence(words: str) -> str:
    """Return words with a capital letter and a full stop."""
    end = "" if words.endswith((".", "!", "?")) else "."
    return f"{words[:1].upper()}{words[1:]}{end}"


def listed(parts: list[str]) -> str:
    """Return parts as "a, b and c"."""
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
