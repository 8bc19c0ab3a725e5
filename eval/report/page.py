"""A page of sections that needs nothing but itself."""

import re
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from eval.files import atomic_path
from eval.report.charts import ENVIRONMENT
from eval.report.encoding import plotly_js


@dataclass(frozen=True, slots=True)
class _Section:
    anchor: str
    heading: str
    sentence: str
    blocks: tuple[Markup, ...]


class Page:
    """Collects sections and writes them as one HTML file, with its style, scripts and data inside."""

    def __init__(self, title: str, subtitle: str = "") -> None:
        self._title = title
        self._subtitle = subtitle
        self._sections: list[_Section] = []

    def add(self, heading: str, sentence: str, *blocks: Markup) -> "Page":
        """Add a section.

        Args:
            heading: of a few words; also in the contents.
            sentence: what the section tells; may be empty.
            blocks: of eval.report.charts or eval.report.views.

        Returns:
            The page itself.
        """
        words = re.sub(r"\W+", "-", heading.lower()).strip("-")
        anchor = f"{words}-{len(self._sections) + 1}"
        self._sections.append(_Section(anchor, heading, sentence, blocks))
        return self

    def html(self) -> str:
        """Return the page."""
        folder = Path(__file__).parent
        return ENVIRONMENT.get_template("template.html").render(
            title=self._title,
            subtitle=self._subtitle,
            sections=self._sections,
            style=Markup((folder / "style.css").read_text()),
            script=Markup((folder / "report.js").read_text()),
            plotly=plotly_js(),
        )

    def write(self, path: Path) -> None:
        """Write the page, replacing the file as a whole."""
        with atomic_path(path) as temporary:
            temporary.write_text(self.html(), encoding="utf-8")
