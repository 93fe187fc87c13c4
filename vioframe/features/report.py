"""The results as files: every number as JSON, the figure, and a page with tables and pictures."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path

from vioframe import __version__
from vioframe.evaluation.page import image_tag, render_page
from vioframe.features.evaluation import Summary
from vioframe.features.figure import draw_summaries
from vioframe.features.protocol import EPSILONS_PX, FeatureProtocol
from vioframe.features.scoring import PairScores
from vioframe.features.table import COLUMNS, by_split, title_of


def write_report(
    summaries: Sequence[Summary],
    scores: Mapping[str, Sequence[PairScores]],
    protocol: FeatureProtocol,
    folder: Path,
    *,
    threads: str,
    pictures: Sequence[Path],
    config_yaml: str,
) -> list[Path]:
    """Write ``features.json``, ``features.png`` and ``features.html``; return their paths.

    Args:
        summaries: of all methods and splits.
        scores: of all pairs, by method.
        protocol: see there.
        folder: where to.
        threads: what the times were measured with.
        pictures: of matches, to be shown on the page.
        config_yaml: the resolved configuration.
    """
    document, figure, page = (folder / f"features.{kind}" for kind in ("json", "png", "html"))
    content = {
        "vioframe": __version__,
        "protocol": protocol.document(),
        "threads": threads,
        "homography_epsilons_px": EPSILONS_PX,
        "summaries": [asdict(summary) for summary in summaries],
        "pairs": {method: [_pair_entry(score) for score in of_method] for method, of_method in scores.items()},
    }
    document.write_text(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    draw_summaries(summaries, protocol, figure)
    body = _body(summaries, protocol, figure, threads, pictures, config_yaml)
    page.write_text(render_page("vioframe: features", body), encoding="utf-8")
    return [document, figure, page]


def _pair_entry(score: PairScores) -> dict[str, object]:
    """One pair of one method; a homography that could not be estimated has no error."""
    entry: dict[str, object] = asdict(score)
    if score.descriptors is not None:
        error = score.descriptors.corner_error_px
        entry["descriptors"] = asdict(score.descriptors) | {"corner_error_px": error if error < float("inf") else None}
    return entry


def _body(
    summaries: Sequence[Summary],
    protocol: FeatureProtocol,
    figure: Path,
    threads: str,
    pictures: Sequence[Path],
    config_yaml: str,
) -> Iterator[str]:
    yield "<h1>Features</h1>"
    yield f"<p class=parts>{escape(protocol.sentence())} · time: {escape(threads)} · vioframe {escape(__version__)}</p>"
    yield image_tag("repeatability and homography accuracy", figure)
    heads = "".join(f"<th>{escape(column.title.replace('-' + chr(10), '').strip())}</th>" for column in COLUMNS)
    for split, rows in by_split(summaries).items():
        yield f"<h2>{escape(title_of(split, rows))}</h2>"
        lines = "".join(
            f"<tr><td class=name>{escape(row.method)}</td>"
            + "".join(f"<td>{column.show(row)}</td>" for column in COLUMNS)
            + "</tr>"
            for row in rows
        )
        yield (
            f"<div class=scroll><table><thead><tr><th class=name></th>{heads}</tr></thead>"
            f"<tbody>{lines}</tbody></table></div>"
        )
    if pictures:
        yield (
            "<h2>Pairs</h2><p>Green: a right match, or a point found again; red: a wrong match; orange: a point not "
            "found again.</p>"
        )
    for path in pictures:
        yield f"<h3>{escape(path.stem)}</h3>"
        yield image_tag(path.stem, path)
    yield f"<h2>Configuration</h2><details><summary>resolved</summary><pre>{escape(config_yaml)}</pre></details>"
