"""axe-core, which looks for what keeps people from using a page."""

from __future__ import annotations

from importlib.resources import files

from tests.share.browser import Browser

_RUN = """axe.run(document, { resultTypes: ["violations"], preload: false }).then(({ violations }) =>
  violations.flatMap(({ id, nodes }) => nodes.map(({ html }) => `${id}: ${html.slice(0, 160)}`)))"""


def barriers(browser: Browser) -> list[str]:
    """Return what axe-core finds wrong with the page as it is now: the rule, and the element."""
    if not browser.evaluate("typeof axe === 'object'"):
        script = (files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8")
        browser.evaluate(f"(() => {{ {script}\n }})()")
    return list(browser.evaluate(_RUN))
