"""What is recorded: a config as flat parameters, a ``metrics.json`` document as flat numbers."""

import json
import math
import re
import statistics
from collections.abc import Iterator, Mapping, Sequence

MAX_KEY = 250
# Servers before MLflow 2.10 refuse parameter values beyond 500 characters; newer ones take 6000.
MAX_VALUE = 500

# Text that belongs to a row of metrics without being one.
_NO_METRICS = frozenset({"protocol", "undefined"})

_FORBIDDEN = re.compile(r"[^\w\-. /]", flags=re.ASCII)


def clean_name(name: str) -> str:
    """Make a name that MLflow accepts: letters, digits, ``_ - . space /``, at most 250 characters.

    MLflow also refuses names that are not a normal relative path (``/a``, ``a//b``, ``../a``), because it
    may keep them as files.
    """
    parts = [part.strip() for part in _FORBIDDEN.sub("_", name).split("/")]
    kept = "/".join(part for part in parts if part.strip(". "))
    return kept[:MAX_KEY].rstrip("/. ") or "unnamed"


def flatten_parameters(config: Mapping[str, object]) -> dict[str, str]:
    """Flatten a resolved config into dotted keys and text of at most 500 characters.

    Args:
        config: plain nested containers (``OmegaConf.to_container(config, resolve=True)``).

    Returns:
        One entry per leaf, such as ``{"fuser.gate": "11.3"}``; a list is one leaf, written as JSON;
        ``None`` reads ``null`` and booleans read as in YAML.
    """
    flat: dict[str, str] = {}
    for key, value in _leaves(config, ""):
        text = value if isinstance(value, str) else json.dumps(value, default=str, ensure_ascii=False)
        flat[clean_name(key)] = text if len(text) <= MAX_VALUE else text[: MAX_VALUE - 1] + "…"
    return flat


def _leaves(node: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    for key, value in node.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{path}.")
        else:
            yield path, value


def _numbers(row: Mapping[str, object]) -> dict[str, float]:
    return {
        key: float(value)
        for key, value in _leaves(row, "")
        if isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
        and _NO_METRICS.isdisjoint(key.split("."))
    }


def metrics_of(document: Mapping[str, object]) -> dict[str, float]:
    """Flatten a ``metrics.json`` document into what a tracker records.

    With one sequence its numbers keep their names (``ate_se3_m``, ``ms_per_frame.frontend``). With several,
    each sequence's numbers stand below its name (``V1_01_easy/ate_se3_m``), the mean over the sequences
    takes the plain name and the median stands below ``median/``. A metric that one of the sequences lacks
    has neither: a mean over those where it could be computed would flatter the run.

    Args:
        document: the parsed ``metrics.json``: ``{"sequences": [{"sequence": name, metric: number, ...}]}``.
            Nested mappings are joined with a dot; ``null``, text, booleans, non-finite numbers and what
            stands below ``protocol`` are left out. What nets weigh, ``{"model": {"gmac": number, ...}}`` beside the
            sequences, is the same for all: ``model.gmac``.
    """
    model = document.get("model")
    numbers = _numbers({"model": model}) if isinstance(model, Mapping) else {}
    return {clean_name(key): value for key, value in numbers.items()} | _sequence_metrics(document)


def _sequence_metrics(document: Mapping[str, object]) -> dict[str, float]:
    entries = document.get("sequences")
    if not isinstance(entries, Sequence):
        return {}
    tables: dict[str, dict[str, float]] = {}
    for entry in entries:
        if isinstance(entry, Mapping):
            name = wanted = str(entry.get("sequence") or "sequence")
            # The same sequence twice in one run must not overwrite itself.
            while name in tables:
                name = f"{wanted}_{len(tables) + 1}"
            tables[name] = _numbers(entry)
    if len(tables) == 1:
        return {clean_name(key): value for table in tables.values() for key, value in table.items()}
    numbers = {clean_name(f"{name}/{key}"): value for name, table in tables.items() for key, value in table.items()}
    shared = set.intersection(*(set(table) for table in tables.values())) if tables else set()
    for key in sorted(shared):
        values = [table[key] for table in tables.values()]
        numbers[clean_name(key)] = statistics.fmean(values)
        numbers[clean_name(f"median/{key}")] = statistics.median(values)
    return numbers
