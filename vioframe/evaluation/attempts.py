"""The attempts to start, as ``metrics.json``, the table and the report show them."""

from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby

from vioframe.conventions import seconds
from vioframe.evaluation.wording import significant
from vioframe.types import InitialisationAttempt, Measure

_WAYS = {"rest": "from rest", "motion": "in motion", "given": "from the given state"}
# More rows than these hide what matters; the first and the last ones tell the story.
_SHOWN = 40


def attempt_entries(attempts: Sequence[InitialisationAttempt], origin_ns: int) -> list[dict[str, object]]:
    """Plain entries, oldest first; attempts in a row that end alike are one, with the numbers of the last.

    Args:
        attempts: oldest first.
        origin_ns: the stamp from which seconds are counted.
    """
    entries: list[dict[str, object]] = []
    for (method, fault, succeeded), group in groupby(
        attempts, key=lambda each: (each.method, each.fault, each.succeeded)
    ):
        alike = list(group)
        last = alike[-1]
        entries.append(
            {
                "from_s": seconds(alike[0].stamp_ns - origin_ns),
                "to_s": seconds(last.stamp_ns - origin_ns),
                "attempts": len(alike),
                "method": method,
                "succeeded": succeeded,
                "fault": fault,
                "sentence": last.sentence,
                "measures": {name: _plain(measure) for name, measure in last.measures.items()},
            }
        )
    return entries


def _plain(measure: Measure) -> dict[str, object]:
    limit = None if measure.limit is None else float(measure.limit)
    return {"value": float(measure.value), "unit": measure.unit, "limit": limit, "good": bool(measure.good)}


def start_text(row: Mapping[str, object]) -> str:
    """How the estimator started, in one sentence; empty where it simply did, or where there is no record."""
    entries = _entries(row)
    if not entries:
        return ""
    first = next((index for index, entry in enumerate(entries) if entry["succeeded"]), None)
    failed = entries if first is None else entries[:first]
    if first is None:
        last = entries[-1]
        return f"never started, {last['fault']}: {last['sentence']}"
    if not failed:
        return ""
    counts: dict[str, int] = {}
    for entry in failed:
        counts[str(entry["fault"])] = counts.get(str(entry["fault"]), 0) + _count(entry)
    missing = ", ".join(f"{fault} ({count}×)" for fault, count in counts.items())
    start = entries[first]
    return f"started {_way(start)} after {_time(start, 'from_s')} s; before that: {missing}"


def attempts_section(row: Mapping[str, object]) -> str:
    """The attempts of a sequence as a piece of HTML; empty where there is no record."""
    entries = _entries(row)
    if not entries:
        return ""
    lines = [
        "<h3>Initialisation</h3><div class=scroll><table><thead><tr><th>time<br><small>s</small></th><th>attempts</th>"
        "<th class=name>method</th><th class=name>found</th><th class=name>numbers of the last</th></tr></thead><tbody>"
    ]
    shown = entries if len(entries) <= _SHOWN else [*entries[: _SHOWN // 2], *entries[-_SHOWN // 2 :]]
    for entry in shown:
        start, end = _time(entry, "from_s"), _time(entry, "to_s")
        found = "started" if entry["succeeded"] else f"<b>{escape(str(entry['fault']))}</b>"
        sentence = f"<br><small>{escape(str(entry['sentence']))}</small>" if entry["sentence"] else ""
        lines.append(
            f"<tr><td>{start if start == end else f'{start}–{end}'}</td><td>{_count(entry)}</td>"
            f"<td class=name>{escape(_way(entry))}</td><td class=text>{found}{sentence}</td>"
            f"<td class=text>{_measures(entry)}</td></tr>"
        )
    note = (
        f"<p class=note>{len(entries) - len(shown)} rows in the middle are left out.</p>"
        if len(entries) > _SHOWN
        else ""
    )
    return "".join(lines) + f"</tbody></table></div>{note}"


def _measures(entry: Mapping[str, object]) -> str:
    measures = entry["measures"]
    if not isinstance(measures, Mapping) or not measures:
        return ""
    items = []
    for name, measure in measures.items():
        limit = "" if measure["limit"] is None else f" (limit {significant(float(measure['limit']))})"
        value = significant(float(measure["value"])) if abs(measure["value"]) < 1e12 else "not computed"
        text = f"{escape(name)}: {value} {escape(measure['unit'])}{limit}"
        items.append(f"<li class={'good' if measure['good'] else 'bad'}>{text}</li>")
    return f"<details><summary>{len(items)} numbers</summary><ul>{''.join(items)}</ul></details>"


def _entries(row: Mapping[str, object]) -> list[Mapping[str, object]]:
    entries = row.get("initialisation")
    return list(entries) if isinstance(entries, list) else []


def _way(entry: Mapping[str, object]) -> str:
    return _WAYS.get(str(entry["method"]), str(entry["method"]))


def _time(entry: Mapping[str, object], key: str) -> str:
    value = entry[key]
    return f"{float(value):.1f}" if isinstance(value, int | float) else ""


def _count(entry: Mapping[str, object]) -> int:
    value = entry["attempts"]
    return value if isinstance(value, int) else 0
