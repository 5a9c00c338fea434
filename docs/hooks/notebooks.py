"""Notebooks: Python files in percent format, run when the site is built, become pages with what their cells give.

``# %%`` begins a cell of code, ``# %% [markdown]`` one of text, as VS Code, Spyder and Jupytext read them. All run in
this process, each in a namespace of its own; an error in a cell ends the build. A cell shows what it prints, the value
of a last expression, and the figures that it leaves open.
"""

from __future__ import annotations

import ast
import io
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

CELL = re.compile(r"^# %%(.*)\n", re.MULTILINE)
FOLDER = "notebooks/"
# Set when matplotlib, torch and W&B are imported, which a cell may do.
SETTINGS = {"MPLBACKEND": "agg", "OMP_NUM_THREADS": "1", "WANDB_MODE": "offline", "TQDM_DISABLE": "1"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Run every notebook, and put its page and figures in its place."""
    root = Path(config.config_file_path).parent
    os.environ.update({"NHT_ROOT": str(root)} | SETTINGS)
    for source in [
        file for file in files if file.src_uri.startswith(FOLDER) and file.src_uri.endswith(".py")
    ]:
        files.remove(source)
        page = source.src_uri.removesuffix(".py")
        text, figures = as_page(source.content_string, Path(page).name)
        files.append(File.generated(config, f"{page}.md", content=text))
        for name, figure in figures.items():
            files.append(File.generated(config, f"{FOLDER}{name}", content=figure))
    return files


def as_page(source: str, name: str) -> tuple[str, dict[str, bytes]]:
    """The page of a notebook in Markdown, and its figures, SVG, by file name."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    parts: list[str] = []
    figures: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):
        for kind, cell in cells(source):
            if kind == "markdown":
                parts.append(re.sub(r"^# ?", "", cell, flags=re.MULTILINE))
                continue
            parts.append(f"```python\n{cell}\n```")
            printed, pictures = run(cell, namespace, f"{name}.py")
            if printed:
                parts.append(f"```text\n{printed}\n```")
            for picture in pictures:
                file = f"{name}-{len(figures) + 1}.svg"
                figures[file] = picture
                parts.append(f"![Figure {len(figures)}]({file})")
    parts.append(f"*This page is the file `docs/{FOLDER}{name}.py`, run when the site was built.*")
    return "\n\n".join(parts) + "\n", figures


def cells(source: str) -> Iterator[tuple[str, str]]:
    """Kind, ``code`` or ``markdown``, and text of each cell that is not empty."""
    _, *pieces = CELL.split(source)
    for mark, text in zip(pieces[::2], pieces[1::2], strict=True):
        if text.strip():
            yield ("markdown" if "[markdown]" in mark else "code"), text.strip("\n")


def run(cell: str, namespace: dict[str, Any], file: str) -> tuple[str, list[bytes]]:
    """What a cell prints, its last value included, and its figures."""
    from matplotlib import pyplot

    tree = ast.parse(cell, file)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with redirect_stdout(printed), redirect_stderr(io.StringIO()):
        exec(compile(tree, file, "exec"), namespace)
        value = None if last is None else eval(compile(ast.Expression(last.value), file, "eval"), namespace)
    if value is not None:
        printed.write(f"{value!r}\n")
    figures = []
    for number in pyplot.get_fignums():
        drawn = io.BytesIO()
        pyplot.figure(number).savefig(drawn, format="svg", bbox_inches="tight", metadata={"Date": None})
        figures.append(drawn.getvalue())
    pyplot.close("all")
    return printed.getvalue().rstrip(), figures
