"""The report of a search: tables, figures and a page from its raw rows."""

from __future__ import annotations

import base64
import html
from pathlib import Path

import numpy as np
import pandas

from nht.recipes.run.metrics import FRAMES, SUCCESS
from nht.recipes.study import figures as search_figures
from nht.recipes.study.results import OUR_INTERFACE, SearchResults, read_results
from nht.recipes.study.scores import (
    Scores,
    interquartile_mean,
    interval,
    percentiles,
    probability_of_improvement,
    resampled,
)

PageSections = list[tuple[str | None, str | pandas.DataFrame]]
"""Sections of the page: a heading, and the text or table below it."""


def write_report(file: Path, out: Path, title: str) -> pandas.DataFrame:
    """Write figures (PNG, SVG), ``report.md`` and ``report.html``; returns the first table.

    The same rows give the same files, byte for byte.
    """
    results = read_results(file)
    out.mkdir(parents=True, exist_ok=True)
    title = title or f"Search on {', '.join(results.rows['env'].unique())}"
    figures = search_figures.draw_all(results, out)
    table = search_summary(results)
    sections: PageSections = [
        (None, f"{counts(results)}\n"),
        ("Interfaces", table),
        ("Failed runs", failures(results)),
    ]
    sections += [("Hyperparameters", categories(results))] if len(categories(results)) else []
    (out / "report.md").write_text(_markdown(title, sections, figures))
    (out / "report.html").write_text(_html(title, sections, figures, out))
    return table


def counts(results: SearchResults) -> str:
    """A sentence with the numbers of runs."""
    runs = results.stage("search")
    again = results.stage("best")
    text = (
        f"{runs['configuration'].nunique()} configurations x {runs['seed'].nunique()} seeds of "
        f"{runs[FRAMES].max():,.0f} steps for each of {len(results.interfaces)} interfaces, {len(runs)} runs"
    )
    if len(again):
        text += (
            f"; the best configuration of each once more on {again['seed'].nunique()} fresh seeds, "
            f"{again[FRAMES].max():,.0f} steps"
        )
    return f"{text}. Score: {results.metric} of the test episodes after the last step. Intervals: 95 %, bootstrap."


def search_summary(results: SearchResults) -> pandas.DataFrame:
    """The summary, a row per interface: scores over configurations, and of the best one."""
    rng = np.random.default_rng(0)
    digits = ".3f" if results.metric == SUCCESS else ",.0f"
    rows = []
    for interface in results.interfaces:
        scores = results.scores(interface)
        again = resampled(scores, rng)
        flat = again.reshape(len(again), -1)
        low, high = percentiles(interquartile_mean(flat, axis=1))
        number, _, fresh = results.best(interface)
        best = _scores_of(results, interface, number, "best" if fresh else "search")
        ends = interval(best)
        rows.append(
            {
                "interface": interface,
                "IQM of runs": f"{interquartile_mean(scores.ravel()):{digits}} ({low:{digits}} .. {high:{digits}})",
                "median configuration": f"{np.median(scores.mean(1)):{digits}}",
                "best configuration": number,
                "its score": f"{best.mean():{digits}} ({ends[0]:{digits}} .. {ends[1]:{digits}})",
                "on": f"{len(best)} fresh seeds" if fresh else "the search's seeds",
                f"P({OUR_INTERFACE} better)": _improvement(results, interface, rng),
            }
        )
    return pandas.DataFrame(rows)


def _scores_of(results: SearchResults, interface: str, configuration: int, stage: str) -> Scores:
    runs = results.stage(stage)
    own = (runs["interface"] == interface) & (runs["configuration"] == configuration)
    return runs[own]["score"].to_numpy(dtype=float)


def _improvement(results: SearchResults, interface: str, rng: np.random.Generator) -> str:
    """The probability that ours beats an interface, with its interval, over the configurations that both have."""
    if interface == OUR_INTERFACE or OUR_INTERFACE not in results.interfaces:
        return "-"
    tables = results.table(OUR_INTERFACE), results.table(interface)
    both = tables[0].index.intersection(tables[1].index)
    if both.empty:
        return "no configuration in common"
    ours, theirs = (table.loc[both].to_numpy() for table in tables)
    found = float(probability_of_improvement(ours, theirs))
    # The same configurations on both sides: they share the agent's hyperparameters.
    drawn = rng.integers(len(ours), size=(500, len(ours)))
    seeds = [rng.integers(s.shape[1], size=(*drawn.shape, s.shape[1])) for s in (ours, theirs)]
    again = [s[drawn[..., None], seed] for s, seed in zip((ours, theirs), seeds, strict=True)]
    low, high = percentiles(probability_of_improvement(*again))
    return f"{found:.2f} ({low:.2f} .. {high:.2f})"


def failures(results: SearchResults) -> pandas.DataFrame:
    """Share of runs that failed or diverged, and the commonest reason."""
    rows = []
    for interface in results.interfaces:
        runs = results.runs[results.runs["interface"] == interface]
        bad = runs[runs["status"] != "done"]
        reasons = bad["reason"].value_counts()
        rows.append(
            {
                "interface": interface,
                "runs": len(runs),
                "failed": f"{(runs['status'] == 'failed').mean():.1%}",
                "diverged": f"{(runs['status'] == 'diverged').mean():.1%}",
                "commonest reason": f"{reasons.index[0]} ({reasons.iloc[0]})" if len(reasons) else "-",
            }
        )
    return pandas.DataFrame(rows)


def categories(results: SearchResults) -> pandas.DataFrame:
    """Mean score by the value of each hyperparameter that is not a number."""
    rows = []
    for interface in results.interfaces:
        means = results.configurations(interface)
        texts = means[results.parameters].select_dtypes(exclude="number").dropna(axis="columns", how="all")
        for name in texts:
            for value, group in means.groupby(str(name)):
                rows.append(
                    {
                        "interface": interface,
                        "hyperparameter": name,
                        "value": value,
                        "configurations": len(group),
                    }
                    | {"mean score": f"{group['score'].mean():.3g}"}
                )
    return pandas.DataFrame(rows)


def _markdown(title: str, sections: PageSections, figures: list[search_figures.Figure]) -> str:
    parts = [f"# {title}\n"]
    for heading, content in sections:
        parts += [f"## {heading}\n"] if heading else []
        parts.append(content if isinstance(content, str) else to_markdown(content))
    parts += [
        f"## {figure.title}\n\n{figure.caption}\n\n![{figure.title}]({figure.name}.png)\n"
        for figure in figures
    ]
    return "\n".join(parts)


def to_markdown(table: pandas.DataFrame) -> str:
    """The table in Markdown."""
    lines = ["| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
    lines += [
        "| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |" for row in table.to_numpy()
    ]
    return "\n".join(lines) + "\n"


STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; font-size: 14px } th, td { padding: .3rem .7rem; text-align: left }
tr { border-bottom: 1px solid #ddd } img { max-width: 100% } p { color: #555 }
"""


def _html(title: str, sections: PageSections, figures: list[search_figures.Figure], out: Path) -> str:
    """The page as one file, with the figures embedded."""
    parts = [f"<!doctype html><meta charset=utf-8><title>{html.escape(title)}</title><style>{STYLE}</style>"]
    parts.append(f"<h1>{html.escape(title)}</h1>")
    for heading, content in sections:
        parts += [f"<h2>{heading}</h2>"] if heading else []
        text = isinstance(content, str)
        parts.append(f"<p>{html.escape(str(content))}</p>" if text else _html_table(content))
    for figure in figures:
        picture = base64.b64encode((out / f"{figure.name}.svg").read_bytes()).decode()
        parts.append(f"<h2>{figure.title}</h2><p>{html.escape(figure.caption)}</p>")
        parts.append(f'<img alt="{figure.title}" src="data:image/svg+xml;base64,{picture}">')
    return "\n".join(parts)


def _html_table(table: str | pandas.DataFrame) -> str:
    assert isinstance(table, pandas.DataFrame)
    return table.to_html(index=False, border=0)
