"""``task=doctor``: open every sequence of the data set, read through it, and say what is good and what is bad."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vioframe.data.recording import Dataset, Finding, Recording
from vioframe.errors import VioframeError
from vioframe.types import Frame, ImuBlock

if TYPE_CHECKING:
    from omegaconf import DictConfig
    from rich.console import Console

READING_S = 20.0
"""Seconds spent on reading through one sequence; what is left is then not looked at, and that is said."""

_MARKS = {"good": "[green]good[/green]", "note": "[yellow]note[/yellow]", "bad": "[bold red]bad[/bold red]"}


def run(config: "DictConfig") -> int:
    """Check the recordings of ``dataset=``; the status is 1 if anything is bad."""
    from rich.console import Console

    from vioframe.build import build_dataset

    dataset = build_dataset(config)
    console = Console()
    diagnoses = []
    for name in dataset.sequences:
        with console.status(f"reading {name}"):
            diagnoses.append((name, diagnose_sequence(dataset, name)))
    format_findings(diagnoses, console)
    return 1 if has_bad(diagnoses) else 0


def diagnose(dataset: Dataset, reading_s: float = READING_S) -> list[tuple[str, list[Finding]]]:
    """What was found in each sequence, in the order of the data set.

    Args:
        dataset: opened one sequence after the other.
        reading_s: seconds to spend on reading through each; 0 opens only.
    """
    return [(name, diagnose_sequence(dataset, name, reading_s)) for name in dataset.sequences]


def diagnose_sequence(dataset: Dataset, name: str, reading_s: float = READING_S) -> list[Finding]:
    """What was found in one sequence; whatever keeps it from opening is a bad finding."""
    try:
        recording = dataset.open(name)
        findings = recording.findings()
        if reading_s > 0.0:
            findings += _read_through(recording, reading_s)
    except VioframeError as error:
        return [Finding(level="bad", subject="cannot be used", text=str(error))]
    return findings


def _read_through(recording: Recording, reading_s: float) -> list[Finding]:
    """Read the packets as an experiment would, and check that they come in order."""
    frames = samples = 0
    newest_ns: dict[type, int] = {}
    backwards = 0
    stopped = False
    started = time.perf_counter()
    for packet in recording.packets():
        first, last = (
            (int(packet.stamps_ns[0]), int(packet.stamps_ns[-1]))
            if isinstance(packet, ImuBlock)
            else (packet.stamp_ns, packet.stamp_ns)
        )
        kind = type(packet)
        backwards += first <= newest_ns.get(kind, first - 1)
        newest_ns[kind] = last
        frames += isinstance(packet, Frame)
        samples += len(packet) if isinstance(packet, ImuBlock) else 0
        if time.perf_counter() - started > reading_s:
            stopped = True
            break
    text = f"{frames} of {recording.frame_count} frames and {samples} IMU samples"
    if stopped:
        text += f"; the rest was not looked at after {reading_s:g} s"
    findings = [Finding(level="good", subject="reading", text=text)]
    if backwards:
        text = f"{backwards} packets come out of order: sort the recording"
        findings.append(Finding(level="bad", subject="order of packets", text=text))
    findings += [
        Finding(level="bad", subject=subject, text=f"{count}; results miss these frames, fetch them again")
        for subject, count in recording.counters().items()
        if count
    ]
    return findings


def has_bad(diagnoses: Sequence[tuple[str, Sequence[Finding]]]) -> bool:
    """Whether anything found will spoil results."""
    return any(finding.level == "bad" for _, findings in diagnoses for finding in findings)


def format_findings(diagnoses: Sequence[tuple[str, Sequence[Finding]]], console: "Console") -> None:
    """Write one table a sequence, what is bad first, and a line that sums up."""
    from rich.markup import escape
    from rich.table import Table

    order = ("bad", "note", "good")
    for name, findings in diagnoses:
        table = Table(title=escape(name), title_justify="left")
        table.add_column("", no_wrap=True)
        table.add_column("subject", no_wrap=True)
        table.add_column("finding", overflow="fold")
        for finding in sorted(findings, key=lambda one: order.index(one.level)):
            table.add_row(_MARKS[finding.level], escape(finding.subject), escape(finding.text))
        console.print(table)
    counts = {level: sum(f.level == level for _, findings in diagnoses for f in findings) for level in order}
    count = len(diagnoses)
    console.print(
        f"{count} sequence{'' if count == 1 else 's'}: {counts['bad']} bad, {counts['note']} to note, "
        f"{counts['good']} good"
    )
