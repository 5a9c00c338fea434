"""Links that lead out of ``docs/`` into the repository, as they do on a page read there, made to work in the site.

A picture or a file of the repository is copied into the site, below ``files/``; a folder, which a site cannot show,
becomes its name. Pages that lie elsewhere in the repository are taken into the site by ``TAKEN``.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import unquote

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

TAKEN = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Pages of the repository by their place in the site."""
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^()\s#]+)(#[^()\s]*)?\)")
CODE = re.compile(r"^```.*?^```$|`[^`\n]*`", re.DOTALL | re.MULTILINE)
LOADED = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=\"((?:https?:)?//[^\"]+)\"")
LOCAL = re.compile(r"<(?:a|video|source|img)\b[^>]*\b(?:src|href)=\"([^\":#?/][^\":#?]*)")
log = get_plugin_logger("links")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Take pages of the repository into the site."""
    root = Path(config.config_file_path).parent
    for source, place in TAKEN.items():
        files.append(File.generated(config, place, abs_src_path=str(root / source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite a page's links, but none in its code."""
    code: list[str] = []

    def hide(found: re.Match[str]) -> str:
        code.append(found.group())
        return f"\0{len(code) - 1}\0"

    text = _rewritten(CODE.sub(hide, markdown), page, config, files)
    return re.sub("\0([0-9]+)\0", lambda found: code[int(found.group(1))], text)


def on_post_page(output: str, page: Page, **_: object) -> str:
    """Warn of whatever a page would load from elsewhere."""
    for address in LOADED.findall(output):
        log.warning("%s loads %s from elsewhere.", page.file.src_uri, address)
    return output


def on_post_build(config: MkDocsConfig) -> None:
    """Warn of what a page leads to or shows and is not there; MkDocs looks neither into HTML nor out of its folder."""
    site = Path(config.site_dir)
    for page in site.rglob("*.html"):
        for name in set(LOCAL.findall(page.read_text())):
            if not (page.parent / unquote(name)).exists():
                log.warning("%s leads to %s, which is not there.", page.relative_to(site), name)


def _rewritten(text: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    root, docs = Path(config.config_file_path).parent, Path(config.docs_dir)
    source = Path(page.file.abs_src_path or docs / page.file.src_uri)

    def replace(found: re.Match[str]) -> str:
        mark, words, link, anchor = found.groups()
        words = LINK.sub(replace, words)  # a picture that is a link
        target = Path(os.path.normpath(source.parent / link))
        if ":" in link or (target.is_relative_to(docs) and source.is_relative_to(docs)):
            return f"{mark}[{words}]({link}{anchor or ''})"
        if not target.is_relative_to(root) or not target.exists():
            log.warning("%s links to %s, which is not in the repository.", page.file.src_uri, link)
            return words
        if target.is_dir():
            return words
        place = _place(target, root, docs, config, files)
        return f"{mark}[{words}]({os.path.relpath(place, Path(page.file.src_uri).parent)}{anchor or ''})"

    return LINK.sub(replace, text)


def _place(target: Path, root: Path, docs: Path, config: MkDocsConfig, files: Files) -> str:
    """Where a file of the repository is in the site."""
    name = str(target.relative_to(root))
    if target.is_relative_to(docs):
        return str(target.relative_to(docs))
    if name == "README.md":
        return "index.md"
    place = TAKEN.get(name)
    if place is None:
        # A page of its own would be made of Markdown, and its source is what is linked to.
        place = f"files/{name}.txt" if name.endswith((".md", ".py", ".toml", ".cpp")) else f"files/{name}"
        if files.get_file_from_path(place) is None:
            files.append(File.generated(config, place, abs_src_path=str(target)))
    return place
