"""Formulas as pictures inside the page, drawn by matplotlib: nothing is loaded from elsewhere."""

import html
import io
import re

from docutils.nodes import SkipNode
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from sphinx.application import Sphinx


def drawn(formula: str, size: float) -> str:
    """Return a formula as an svg element in the colour of the text, on the text's base line."""
    figure = Figure(figsize=(0.01, 0.01))
    with rc_context({"mathtext.fontset": "cm", "svg.fonttype": "path"}):
        text = figure.text(0, 0, f"${' '.join(formula.split())}$", fontsize=size)
        box = text.get_window_extent(FigureCanvasAgg(figure).get_renderer())
        depth = max(0.0, -box.y0) * 72 / figure.dpi
        out = io.StringIO()
        figure.savefig(out, format="svg", bbox_inches="tight", pad_inches=0.02, transparent=True)
    svg = re.sub(r"\A.*?(?=<svg )|<metadata>.*?</metadata>", "", out.getvalue(), flags=re.DOTALL)
    svg = svg.replace("<text ", "<text fill='currentColor' ")
    label = html.escape(formula, quote=True)
    style = f"vertical-align:-{depth:.1f}pt;fill:currentColor;max-width:100%"
    return svg.replace("<svg ", f'<svg role="img" aria-label="{label}" style="{style}" ', 1)


def _inline(self, node) -> None:
    self.body.append(drawn(node.astext(), 11))
    raise SkipNode


def _display(self, node) -> None:
    self.body.append(f'<div class="math" style="overflow-x:auto">{drawn(node.astext(), 13)}</div>')
    raise SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Make this the renderer `mathtext` of formulas."""
    app.add_html_math_renderer("mathtext", (_inline, None), (_display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
