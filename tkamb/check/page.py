"""The check as one page that stands by itself."""

from matplotlib.figure import Figure

from tkamb.check.scene_check import SceneCheck
from tkamb.output.pages import asset, policy_sources, render
from tkamb.output.style import svg_text

POLICY = (
    "default-src 'none'; style-src-elem {style}; style-src-attr 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'"
)


def check_html(found: SceneCheck, figure: Figure) -> str:
    """Return the page: questions first, then the picture, then what each file gave."""
    style = asset("tkamb.output", "report.css")
    return render(
        "tkamb.check",
        "check.html",
        policy=POLICY.format(style=policy_sources(style)),
        style=style,
        title=f"Check of {found.scene.resolve().parent.name}/{found.scene.name}",
        found=found,
        picture=svg_text(figure, "leg"),
    )
