"""The page of commands: what each recipe says of itself with ``--help``."""

from __future__ import annotations

import io
import re
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout

WANTED = re.compile(r"^\{\{ help\((\w+)\) \}\}$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace ``{{ help(NAME) }}``, a line of its own, by what the recipe prints."""
    return WANTED.sub(lambda found: f"```text\n{help_of(found.group(1))}```\n", markdown)


def help_of(recipe: str) -> str:
    """What ``python -m nht.recipes.RECIPE --help`` prints."""
    printed = io.StringIO()
    with _arguments("--help"), redirect_stdout(printed):
        runpy.run_module(f"nht.recipes.{recipe}", run_name="__main__", alter_sys=True)
    return printed.getvalue()


@contextmanager
def _arguments(*words: str) -> Iterator[None]:
    kept = sys.argv
    sys.argv = ["recipe", *words]
    try:
        yield
    finally:
        sys.argv = kept
