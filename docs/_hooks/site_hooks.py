"""What mkdocs calls while it builds the site: adds the pages that are made from the code, and turns TeX into MathML."""

from __future__ import annotations

from api_page import api_page
from command_page import command_page
from conventions_page import conventions_page
from equations import with_mathml
from markdown_text import with_plugins
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from preset_page import preset_page
from repository_pages import PAGES, repository_pages, with_site_links
from stage_page import schema_text, stage_page


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages that are not written by hand."""
    made = {
        **repository_pages(),
        "reference/stages.md": stage_page(),
        "reference/presets.md": preset_page(),
        "reference/commands.md": command_page(),
        "reference/api.md": api_page(),
        "reference/conventions.md": conventions_page(),
        "reference/pano-mvs.schema.json": schema_text(),
    }
    for place, text in made.items():
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: object) -> str:
    """Lead links to the repository's other files to where they are in the site, and show plugins in full."""
    place = page.file.src_uri
    if place in PAGES:
        return markdown
    return with_plugins(with_site_links(markdown, place, f"docs/{place}"))


def on_page_content(html: str, **_: object) -> str:
    """Show equations."""
    return with_mathml(html)
