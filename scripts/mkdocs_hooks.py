"""Pages of the docs site that are made from other files: README, changelog, models, gallery."""

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
COPIED = {
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    **{f"models/{p.parent.name}.md": f"models/{p.parent.name}/README.md"
       for p in sorted(ROOT.glob("models/*/README.md"))},
}  # fmt: skip
"""Page -> its source file."""
API = (
    "run.simulation.simulate", "io.scene.scene.load_scene", "io.scene.scene.Scene",
    "run.results.Results", "run.results_folder.read_results", "run.maps.ContactMaps",
    "knee.knee.Knee", "run.read_scene.read_scene", "run.press.press_meshes",
    "run.press.PressReport", "show.scene_check.check_scene", "show.comparison.compare_folders",
    "contact.registry.contact_model", "contact.model", "contact.result.ContactResult",
    "contact.pair", "testing", "errors",
)  # fmt: skip
"""Public names on the page of the API."""
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def on_files(files, config):
    """Add the pages that are made from other files."""
    pages = {page: _page(page, source) for page, source in COPIED.items()}
    pages["api.md"] = _api()
    pages["gallery.md"] = _gallery()
    for page, text in pages.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Change the links of a page in docs/ so that they lead to pages of the site."""
    source = ROOT / "docs" / page.file.src_uri
    return _led(markdown, source.parent, page.file.src_uri) if source.is_file() else markdown


def _page(page: str, source: str) -> str:
    """Return the text of a file with links to pages of the site."""
    return _led((ROOT / source).read_text(encoding="utf-8"), (ROOT / source).parent, page)


def _led(text: str, folder: Path, page: str) -> str:
    """Return a text with links to pages of the site; links to other files become plain names.

    Args:
        text: Markdown text.
        folder: folder to which the links in the text are relative.
        page: name of the page that is made from the text.
    """
    made = {(ROOT / file).resolve(): name for name, file in COPIED.items()}
    made[ROOT / "docs" / "gallery"] = "gallery.md"
    up = "../" * len(Path(page).parent.parts)

    def led(match):
        picture, words, target, anchor = match.groups()
        path = (folder / target).resolve()
        if target.startswith(("http:", "https:")):
            return match[0]
        if (path / "README.md").is_file():
            path /= "README.md"
        if path in made:
            return f"[{words}]({up}{made[path]}{anchor or ''})"
        if path.is_relative_to(ROOT / "docs") and path.is_file():
            return f"{picture}[{words}]({up}{path.relative_to(ROOT / 'docs')}{anchor or ''})"
        return f"`{words}`"

    return LINK.sub(led, text)


def _api() -> str:
    heads = "# Python\n\nWhat others program against; `dir(tkamb)` lists the shortest names.\n\n"
    return heads + "\n".join(f"::: tkamb.{name}\n" for name in API)


def _gallery() -> str:
    """Return the gallery's page with the picture, the first words and the code of each example."""
    parts = ["# Gallery\n\nEach example runs in the tests and is held to the number it asserts.\n"]
    for path in sorted((ROOT / "docs" / "gallery").glob("*.py")):
        _, words, code = path.read_text(encoding="utf-8").split('"""', 2)
        title, _, rest = words.partition("\n")
        picture = f"gallery/{path.stem}.png"
        shown = f"![{title}]({picture})\n" if (ROOT / "docs" / picture).is_file() else ""
        parts.append(f"## {title.rstrip('.')}\n\n{rest.strip()}\n\n{shown}")
        parts.append(f'```python title="docs/gallery/{path.name}"\n{code.strip()}\n```\n')
    return "\n".join(parts)
