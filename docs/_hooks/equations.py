"""Equations as MathML, made when the site is built: browsers show it by themselves, without a script or a font."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def with_mathml(page: str) -> str:
    """Return a page with its TeX, as pymdownx.arithmatex marks it, in MathML."""
    page = _BLOCK.sub(lambda found: f'<div class="equation">{_mathml(found[1], display="block")}</div>', page)
    page = _INLINE.sub(lambda found: _mathml(found[1], display="inline"), page)
    if "arithmatex" in page:
        raise ValueError(f"an equation is not shown: … {page[page.index('arithmatex') :][:120]} …")
    return page


def _mathml(tex: str, *, display: str) -> str:
    return str(convert(html.unescape(tex).strip(), display=display))
