"""Formulas, ``$...$`` in a line and ``$$...$$`` as a paragraph, become MathML: browsers draw it without any script."""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.blockprocessors import BlockProcessor
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from mkdocs.config.defaults import MkDocsConfig

INLINE = r"(?<![\\$\w])\$(?=\S)([^$\n]+?)(?<=\S)\$(?![\w$])"
BLOCK = re.compile(r"\s*\$\$(.+?)\$\$\s*", re.DOTALL)


class _InLine(InlineProcessor):
    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str, int, int]:  # type: ignore[override]
        return self.md.htmlStash.store(convert(m.group(1))), m.start(0), m.end(0)


class _Paragraph(BlockProcessor):
    def test(self, parent: Element, block: str) -> bool:
        return BLOCK.fullmatch(block) is not None

    def run(self, parent: Element, blocks: list[str]) -> None:
        found = BLOCK.fullmatch(blocks.pop(0))
        assert found is not None
        formula = convert(" ".join(found.group(1).split()), display="block")
        node = Element("p")
        node.text = self.parser.md.htmlStash.store(formula)
        parent.append(node)


class Maths(Extension):
    """The extension of Python-Markdown."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register both forms: before emphasis, behind code."""
        md.inlinePatterns.register(_InLine(INLINE, md), "maths", 185)
        md.parser.blockprocessors.register(_Paragraph(md.parser), "maths", 95)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the extension to all pages."""
    config.markdown_extensions.append(Maths())  # type: ignore[arg-type]
    return config
