"""
Formulas as MathML, which browsers draw themselves: the built pages need no network and no scripts.
"""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

# What the converter lacks, and what it knows instead.
_INSTEAD = (
    (r"\\[bB]igg?l?\s*([(\[])", r"\\left\1"),
    (r"\\[bB]igg?r?\s*([)\]])", r"\\right\1"),
    (r"\\(textstyle|displaystyle)(?![A-Za-z])", ""),
    # Otherwise an index after an accent stands below it.
    (r"(\\d?dot|\\bar|\\hat) ?(\\[A-Za-z]+|[A-Za-z])", r"{{}\1 \2}"),
)


def as_mathml(tex: str, display: bool) -> str:
    """
    :param tex: a formula in LaTeX, without the marks around it
    :param display: whether it stands on lines of its own
    :raises MathError: for a command that is not known
    """
    plain = tex.strip()
    for pattern, known in _INSTEAD:
        plain = re.sub(pattern, known, plain)
    if r"\\" in plain and r"\begin" not in plain:
        plain = rf"\begin{{aligned}}{plain}\end{{aligned}}"
    return tex2mathml(plain, as_block=display)


def setup(app: Any) -> dict[str, bool]:
    """What Sphinx calls."""
    app.add_html_math_renderer("mathml", (_draw_inline, None), (_draw_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _draw_inline(writer: Any, node: nodes.math) -> None:
    _draw(writer, node, display=False)


def _draw_block(writer: Any, node: nodes.math_block) -> None:
    _draw(writer, node, display=True)


def _draw(writer: Any, node: nodes.Element, display: bool) -> None:
    try:
        writer.body.append(as_mathml(node.astext(), display))
    except MathError as error:
        logging.getLogger(__name__).warning("%s in: %s", error, node.astext(), location=node)
    raise nodes.SkipNode
