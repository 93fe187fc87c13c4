"""The output folder of an experiment: trajectories, ``metrics.json``, figures, and one page that shows it all.

The page stands alone: figures are inside it, and it fetches nothing.
"""

import json
import logging
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from vioframe.evaluation.attempts import attempts_section, start_text
from vioframe.evaluation.page import image_tag, render_page
from vioframe.evaluation.protocol import EvaluationOptions, describe_association
from vioframe.evaluation.rows import Row, metrics_document
from vioframe.evaluation.run import SequenceRun
from vioframe.evaluation.states import StateColumns
from vioframe.evaluation.wording import (
    UNDEFINED,
    Line,
    accuracy_lines,
    brief_accuracy_lines,
    calibration_text,
    counter_text,
    failure_text,
    has_run,
    join,
    output_name,
    protocol_text,
    reasons,
    running_lines,
    show,
    significant,
    total_ms,
)

log = logging.getLogger(__name__)

_WIDTHS = {"Path from above": "large", "Tracks": "half", "Time by part": "half"}


def write_outputs(
    runs: Sequence[SequenceRun],
    rows: Sequence[Row],
    folder: Path,
    *,
    config_yaml: str,
    options: EvaluationOptions,
    extra: Mapping[str, object] | None = None,
) -> dict[str, object]:
    """Write everything that an experiment leaves behind but its configuration.

    With one sequence ``trajectory.tum`` (and ``trajectory_final.tum`` where there is a final one) lies in the
    folder and its figures in ``plots/``; with several, each has ``<sequence>/trajectory.tum`` and
    ``plots/<sequence>/``.

    Args:
        runs: the records.
        rows: of each run, its :func:`~vioframe.evaluation.rows.evaluate_run`.
        folder: made if missing.
        config_yaml: the resolved configuration, shown in the report.
        options: of the metrics; ``plots=False`` leaves out figures and report.
        extra: further top-level entries of ``metrics.json``.

    Returns:
        The document in ``metrics.json``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    document = metrics_document(rows, options, extra)
    # Numbers first: nothing that can go wrong in a drawing may cost them.
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")
    names = folder_names([run.sequence for run in runs])
    for run, name in zip(runs, names, strict=True):
        write_trajectories(run, folder if len(runs) == 1 else folder / name)
    if options.plots:
        from vioframe.evaluation.plots import draw_run

        figures = []
        for run, name in zip(runs, names, strict=True):
            place = folder / "plots" if len(runs) == 1 else folder / "plots" / name
            figures.append(draw_run(run, options, place) if len(run.states) or run.windows else {})
        page = make_report(rows, figures, config_yaml=config_yaml, options=options, extra=extra)
        (folder / "report.html").write_text(page, encoding="utf-8")
    return document


def write_trajectories(run: SequenceRun, folder: Path) -> None:
    """Write ``trajectory.tum``, the states that the metrics compare, and ``trajectory_final.tum``."""
    from vioframe.trajectory_io import write_tum

    states = StateColumns.from_states(run.states).started()
    if len(states):
        write_tum(folder / "trajectory.tum", states.trajectory())
    if run.smoothed is not None and len(run.smoothed):
        write_tum(folder / "trajectory_final.tum", run.smoothed)


def folder_names(sequences: Sequence[str]) -> list[str]:
    """A different, harmless folder name for each sequence."""
    names: list[str] = []
    for sequence in sequences:
        plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in sequence).strip(".") or "sequence"
        name, count = plain, 2
        while name in names:
            name, count = f"{plain}_{count}", count + 1
        names.append(name)
    return names


def make_report(
    rows: Sequence[Row],
    figures: Sequence[Mapping[str, Path]],
    *,
    config_yaml: str,
    options: EvaluationOptions,
    extra: Mapping[str, object] | None = None,
    shared_figures: Mapping[str, Path] | None = None,
) -> str:
    """The page as HTML.

    Args:
        rows: one per sequence.
        figures: of each sequence, PNG files by title, in order.
        config_yaml: the resolved configuration.
        options: of the metrics.
        extra: what ``metrics.json`` also says, such as the choice of parts.
        shared_figures: those that show all sequences at once.
    """
    title = f"vioframe: {rows[0]['sequence']}" if len(rows) == 1 else f"vioframe: {len(rows)} sequences"
    body = [f"<h1>{escape(title)}</h1>", _parts_line(extra)]
    body += [_failure(row) for row in rows if row.get("error")]
    if len(rows) > 1:
        body.append(_overview(rows))
    body += [_image(name, path) for name, path in (shared_figures or {}).items()]
    for number, (row, paths) in enumerate(zip(rows, figures, strict=True)):
        body.append(_sequence_section(row, paths, anchor=f"s{number}", heading=len(rows) > 1))
    body.append(_protocol_section(options))
    body.append(f"<h2>Configuration</h2><details><summary>resolved</summary><pre>{escape(config_yaml)}</pre></details>")
    return render_page(title, body)


def _parts_line(extra: Mapping[str, object] | None) -> str:
    if not extra:
        return ""
    words = []
    parts = extra.get("parts")
    if isinstance(parts, Mapping):
        shown = ("dataset", "synchronizer", "frontend", "integrator", "vo", "fuser")
        words += [f"{name}=<b>{escape(str(parts[name]))}</b>" for name in shown if parts.get(name)]
    if extra.get("vioframe"):
        words.append(f"vioframe {escape(str(extra['vioframe']))}")
    return f"<p class=parts>{' · '.join(words)}</p>" if words else ""


def _failure(row: Row) -> str:
    return f"<p class=failure><b>{escape(str(row['sequence']))}</b>: {escape(failure_text(row))}</p>"


def _overview(rows: Sequence[Row]) -> str:
    fullest = max(rows, key=len)
    lines = [*brief_accuracy_lines(fullest), *running_lines(fullest)]
    timed = "ms_per_frame" in fullest
    head = "".join(f"<th>{escape(line.short)}<br><small>{escape(line.unit)}</small></th>" for line in lines)
    head += "<th>time<br><small>ms/frame</small></th>" if timed else ""
    table = [
        "<div class=scroll><table><thead><tr><th class=name>sequence</th>"
        + head
        + "<th>status</th></tr></thead><tbody>"
    ]
    for number, row in enumerate(rows):
        name = f"<a href='#s{number}'>{escape(str(row['sequence']))}</a>"
        status = escape(str(row["status"]))
        milliseconds = f"<td>{_total_ms_cell(row)}</td>" if timed else ""
        table.append(
            f"<tr><td class=name>{name}</td>{_cells(row, lines)}{milliseconds}<td class={status}>{status}</td></tr>"
        )
        final = row.get("final")
        if isinstance(final, Mapping):
            accuracy = [line for line in lines if line.key in final]
            rest = "<td></td>" * (len(lines) - len(accuracy) + 1 + timed)
            table.append(f"<tr class=final><td class=name>final</td>{_cells(final, accuracy)}{rest}</tr>")
    return "".join(table) + "</tbody></table></div>"


def _cells(row: Mapping[str, object], lines: Sequence[Line]) -> str:
    return "".join(f"<td>{_value(row, line)}</td>" for line in lines)


def _value(row: Mapping[str, object], line: Line) -> str:
    """The number; where there is none, ``undefined`` with its reason on hovering."""
    text = show(row, line, unit=False)
    if text != UNDEFINED:
        return text
    undefined = row.get("undefined")
    reason = str(undefined.get(line.key, "")) if isinstance(undefined, Mapping) else ""
    return f"<span class=undefined title='{escape(reason, quote=True)}'>{UNDEFINED}</span>"


def _total_ms_cell(row: Row) -> str:
    text = total_ms(row)
    return text if text != UNDEFINED else f"<span class=undefined>{UNDEFINED}</span>"


def _sequence_section(row: Row, figures: Mapping[str, Path], *, anchor: str, heading: bool) -> str:
    html = [f"<section id={anchor}>"]
    if heading:
        html.append(f"<h2>{escape(str(row['sequence']))}</h2>")
    started = start_text(row)
    if started:
        html.append(f"<p class=counters>{escape(started)}</p>")
    calibrated = calibration_text(row)
    if calibrated:
        html.append(f"<p class=note>{escape(calibrated)}</p>")
    counted = counter_text(row)
    if counted:
        html.append(f"<p class=counters>{escape(counted)}</p>")
    if has_run(row):
        html.append(f"<div class=columns>{_accuracy_table(row)}{_running_table(row)}</div>")
        for reason, labels in reasons(row).items():
            html.append(f"<p class=note>Undefined: {escape(join(labels))} ({escape(reason)}).</p>")
        html.append(f"<p class=note>{escape(protocol_text(row))}</p>")
    html += [_image(title, path) for title, path in figures.items()]
    html.append(attempts_section(row))
    return "\n".join([*html, "</section>"])


def _image(title: str, path: Path) -> str:
    return image_tag(title, path, width=_WIDTHS.get(title, "full"))


def _accuracy_table(row: Row) -> str:
    final = row.get("final")
    outputs: list[Mapping[str, object]] = [row, final] if isinstance(final, Mapping) else [row]
    names = "".join(f"<th>{escape(output_name(output))}</th>" for output in outputs)
    lines = [f"<table><thead><tr><th class=name>accuracy</th>{names}<th></th></tr></thead><tbody>"]
    for line in accuracy_lines(row):
        cells = "".join(f"<td>{_value(output, line)}</td>" for output in outputs)
        lines.append(f"<tr><td class=name>{escape(line.label)}</td>{cells}<td class=unit>{escape(line.unit)}</td></tr>")
    return "".join(lines) + "</tbody></table>"


def _running_table(row: Row) -> str:
    if not running_lines(row):
        return ""
    lines = ["<table><thead><tr><th class=name>consistency and running</th><th></th><th></th></tr></thead><tbody>"]
    for line in running_lines(row):
        lines.append(
            f"<tr><td class=name>{escape(line.label)}</td><td>{_value(row, line)}</td>"
            f"<td class=unit>{escape(line.unit)}</td></tr>"
        )
    entries: list[tuple[str, str, str]] = []
    parts = row.get("ms_per_frame")
    if isinstance(parts, Mapping):
        entries += [("time per frame", significant(float(parts["total"])), "ms")]
        entries += [(f"\u2003{part}", significant(float(ms)), "ms") for part, ms in parts.items() if part != "total"]
    states = row.get("states")
    if isinstance(states, Mapping):
        entries += [(f"states {status}", str(count), "") for status, count in states.items()]
    entries += [("frames", str(row.get("frames")), ""), ("duration", significant(_number(row, "duration_s"), 4), "s")]
    for label, value, unit in entries:
        lines.append(f"<tr><td class=name>{escape(label)}</td><td>{value}</td><td class=unit>{unit}</td></tr>")
    return "".join(lines) + "</tbody></table>"


def _number(row: Row, key: str) -> float:
    value = row.get(key)
    return float(value) if isinstance(value, int | float) else 0.0


def _protocol_section(options: EvaluationOptions) -> str:
    from vioframe.evaluation.protocol import DEFINITIONS

    segments = ", ".join(f"{length:g}" for length in options.segment_lengths_m)
    facts = [
        f"Association: {describe_association(options)}.",
        f"t_rel and r_rel: segments of {segments} m, one starting at every {options.segment_step}th frame.",
    ]
    terms = "".join(
        f"<tr><td class=name><code>{escape(key)}</code></td><td class=text>{escape(text)}</td></tr>"
        for key, text in DEFINITIONS.items()
    )
    paragraphs = "".join(f"<p>{escape(fact)}</p>" for fact in facts)
    return f"<h2>Protocol</h2>{paragraphs}<details><summary>definitions</summary><table>{terms}</table></details>"
