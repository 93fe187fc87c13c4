"""The attempts to start in metrics.json, the table and the report."""

import json

from vioframe.evaluation.attempts import attempt_entries, attempts_section, start_text
from vioframe.types import InitialisationAttempt, Measure

ORIGIN_NS = 5_000_000_000


def attempt(second, fault="", method="motion", value=1.5):
    return InitialisationAttempt(
        stamp_ns=ORIGIN_NS + round(second * 1e9),
        method=method,
        succeeded=not fault,
        fault=fault,
        sentence=f"{fault}: do <this>" if fault else "",
        measures={"turn": Measure(value=value, unit="°", limit=2.0, good=not fault)},
    )


def row(*attempts):
    return {"initialisation": attempt_entries(attempts, ORIGIN_NS)}


def test_attempts_that_end_alike_are_one_entry_with_the_last_numbers():
    made = row(attempt(1.0, "no rotation", value=0.1), attempt(1.25, "no rotation", value=0.2), attempt(1.5))
    first, second = made["initialisation"]
    assert (first["from_s"], first["to_s"], first["attempts"]) == (1.0, 1.25, 2)
    assert first["measures"]["turn"] == {"value": 0.2, "unit": "°", "limit": 2.0, "good": False}
    assert second["succeeded"]
    json.dumps(made, allow_nan=False)


def test_the_sentence_says_what_was_missing_and_how_it_started():
    text = start_text(row(attempt(1.0, "no rotation"), attempt(1.25, "no rotation"), attempt(1.5)))
    assert text == "started in motion after 1.5 s; before that: no rotation (2×)"


def test_a_run_that_never_started_says_why():
    assert start_text(row(attempt(1.0, "no texture"))) == "never started, no texture: no texture: do <this>"


def test_a_start_at_the_first_attempt_is_no_news():
    assert start_text(row(attempt(1.0, method="rest"))) == ""
    assert start_text(row()) == ""
    assert start_text({}) == ""


def test_the_report_shows_every_number_and_escapes_text():
    page = attempts_section(row(attempt(1.0, "no rotation"), attempt(1.5)))
    assert "do &lt;this&gt;" in page
    assert "<li class=bad>turn: 1.5" in page
    assert "limit 2" in page
    assert attempts_section(row()) == ""


def test_a_long_wait_stays_readable():
    many = [attempt(0.25 * index, ("no rotation", "no parallax")[index % 2]) for index in range(200)]
    page = attempts_section(row(*many))
    assert page.count("<tr>") == 41
    assert "160 rows in the middle are left out" in page
