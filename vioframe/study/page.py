"""The page of a study, and its numbers as CSV and JSON."""

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from html import escape
from pathlib import Path

from vioframe import __version__
from vioframe.evaluation.page import image_tag, render_page
from vioframe.evaluation.paired import PairedComparison, show_p, show_ratio
from vioframe.study.figure import draw_study
from vioframe.study.plan import Value
from vioframe.study.summary import StudySummary
from vioframe.sweep.summary import Column


def write_study(summary: StudySummary, folder: Path, config_yaml: str) -> list[Path]:
    """Write ``study.png``, ``study.html``, ``study.csv`` and ``study.json``; return their paths.

    Args:
        summary: of what was run.
        folder: made where it is missing.
        config_yaml: the resolved configuration of the study.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figure, page, table, document = (folder / f"study.{kind}" for kind in ("png", "html", "csv", "json"))
    draw_study(summary, figure)
    page.write_text(make_page(summary, figure, config_yaml), encoding="utf-8")
    _write_csv(summary, table)
    entries = [{**asdict(cell), **asdict(result)} for cell, result in summary.results.items()]
    content = {
        "study": summary.study.name,
        "key": summary.study.varied,
        "vioframe": __version__,
        "variants": {name: summary.study.variants[name] for name in summary.study.chosen},
        "conditions": summary.study.conditions,
        "sentences": summary.sentences(),
        "baseline": summary.study.baseline,
        "comparisons": [
            {"variant": variant, "metric": column.key, "at": where, **_plain(compared)}
            for column in summary.columns
            for variant, where, compared in summary.comparisons(column)
        ],
        "cells": entries,
    }
    document.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return [figure, page, table, document]


def make_page(summary: StudySummary, figure: Path, config_yaml: str) -> str:
    """The page as HTML; the figure is inside it."""
    study = summary.study
    seeds = ", ".join(map(str, study.seeds))
    on = f"{', '.join(study.recordings)} · " if study.recordings else ""
    body = [
        f"<h1>{escape(study.title)}</h1>",
        f"<p class=parts><code>{escape(study.varied)}</code> · {escape(on)}seeds {seeds} · "
        f"{len(summary.results)} runs · vioframe {escape(__version__)}</p>",
    ]
    for error, cells in summary.failures().items():
        told = ", ".join(str(cell) for cell in cells)
        body.append(f"<p class=failure><b>{len(cells)} failed</b> ({escape(told)}): {escape(error)}</p>")
    body.append(image_tag(study.title, figure))
    body.append("<ul>" + "".join(f"<li>{escape(sentence)}</li>" for sentence in summary.sentences()) + "</ul>")
    for column in summary.columns:
        body += _section(summary, column)
        body += _comparisons(summary, column)
    variants = "".join(
        f"<tr><td class=name>{escape(name)}</td><td class=text><code>{escape(' '.join(study.variants[name]))}</code>"
        "</td></tr>"
        for name in study.chosen
    )
    common = escape(" ".join(study.base))
    body.append(f"<h2>Variants</h2><p>All: <code>{common}</code></p><table>{variants}</table>")
    if study.conditions:
        conditions = "".join(
            f"<tr><td class=name>{escape(study.shown(name))}</td>"
            f"<td class=text><code>{escape(' '.join(study.conditions[str(name)]))}</code></td></tr>"
            for name in study.all_values()
        )
        body.append(f"<h2>Conditions</h2><table>{conditions}</table>")
    body.append(f"<h2>Configuration</h2><details><summary>resolved</summary><pre>{escape(config_yaml)}</pre></details>")
    return render_page(f"vioframe: {study.title}", body)


def _section(summary: StudySummary, column: Column) -> Iterator[str]:
    study = summary.study
    yield f"<h2>{escape(column.title)}</h2>"
    heads = "".join(f"<th>{escape(study.shown(value))}</th>" for value in study.all_values())
    rows = []
    for variant in study.chosen:
        cells = "".join(_cell(summary, variant, value, column) for value in study.all_values())
        rows.append(f"<tr><td class=name>{escape(variant)}</td>{cells}</tr>")
    yield (
        f"<div class=scroll><table><thead><tr><th class=name>{escape(study.axis)}</th>{heads}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )
    percent = f"{100.0 * study.tolerance:g} %"
    over = "recordings and seeds" if study.recordings else "seeds"
    yield f"<p class=note>Median over {over}, range below; change against {escape(study.shown(study.reference))}, "
    yield f"bold where more than {percent} is lost."
    if study.least_completion > 0.0 and column.key != "completion":
        yield f" A run that tracks less than {100.0 * study.least_completion:g} % of its recording failed."
    yield "</p>"


def _comparisons(summary: StudySummary, column: Column) -> Iterator[str]:
    found = summary.comparisons(column)
    if not found:
        return
    yield f"<h3>Beside {escape(str(summary.study.baseline))}</h3>"
    heads = ("ratio of medians", "median of ratios", "better", "worse", "pairs", "p")
    yield "<div class=scroll><table><thead><tr><th class=name>variant</th><th class=name>at</th>"
    yield "".join(f"<th>{head}</th>" for head in heads) + "</tr></thead><tbody>"
    for variant, where, compared in found:
        ratios = show_ratio(compared.of_medians), show_ratio(compared.of_pairs)
        numbers = (*ratios, compared.better, compared.worse, compared.pairs, show_p(compared.p_value))
        cells = "".join(f"<td>{escape(str(number))}</td>" for number in numbers)
        yield f"<tr><td class=name>{escape(variant)}</td><td class=name>{escape(where)}</td>{cells}</tr>"
    yield "</tbody></table></div><p class=note>Pairs: runs of the same recording, seed and condition. In brackets the "
    yield "95 % interval, from pairs drawn with replacement. p: Wilcoxon’s signed-rank test of the logarithms, "
    yield "two-sided, each by itself, without a correction for how many there are.</p>"


def _plain(compared: PairedComparison) -> dict[str, object]:
    """JSON knows no infinity."""
    return {name: _finite(value) for name, value in asdict(compared).items()}


def _finite(value: object) -> object:
    if isinstance(value, dict):
        return {name: _finite(inner) for name, inner in value.items()}
    return None if isinstance(value, float) and math.isinf(value) else value


def _cell(summary: StudySummary, variant: str, value: Value, column: Column) -> str:
    spread = summary.spread(variant, value, column)
    if spread is None:
        reasons = {
            result.undefined.get(column.key, result.error)
            for cell, result in summary.results.items()
            if (cell.variant, cell.value) == (variant, value)
        }
        told = "; ".join(sorted(reason for reason in reasons if reason))
        return f"<td><span class=undefined title='{escape(told, quote=True)}'>undefined</span></td>"
    text = spread.text(spread.median, column.decimals)
    if spread.high > spread.low:
        low, high = (spread.text(number, column.decimals) for number in (spread.low, spread.high))
        text += f"<br><small>{low}…{high}</small>"
    if spread.failed:
        text += f"<br><small>{spread.failed} of {spread.runs} failed</small>"
    loss = summary.loss(variant, value, column)
    if loss is not None and math.isfinite(loss) and value != summary.study.reference:
        change = f"{loss:+.0%}"
        text += f"<br><small>{f'<b>{change}</b>' if loss > summary.study.tolerance else change}</small>"
    return f"<td>{text}</td>"


def _write_csv(summary: StudySummary, path: Path) -> None:
    names = sorted({name for result in summary.results.values() for name in result.metrics})
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        recorded = ["recording"] if summary.study.recordings else []
        writer.writerow(["variant", summary.study.varied, *recorded, "seed", "status", "error", *names])
        for cell, result in summary.results.items():
            numbers = (repr(result.metrics[name]) if name in result.metrics else "" for name in names)
            run = cell.run if recorded else cell.run[1:]
            writer.writerow([cell.variant, cell.value, *run, result.status, result.error, *numbers])
