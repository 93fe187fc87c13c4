"""``task=matrix``: every combination of the installed parts either runs, or is refused with its reason.

The parts are tried in every combination with two cameras. What else there is to choose, the cameras and the groups
that a part brings along (such as ``loop=``), is then varied on one combination of each front end and fuser that ran.
"""

import itertools
import json
import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from vioframe.build import OPTIONAL_SLOTS, build, build_pipeline
from vioframe.composing import Composer
from vioframe.data.recording import Dataset, Recording
from vioframe.errors import VioframeError
from vioframe.pipeline import SLOTS
from vioframe.plugins import core_conf, discover
from vioframe.tasks.progress import frame_progress
from vioframe.tasks.run_sequence import initial_state, lend_ground_truth
from vioframe.types import Frame, Packet

if TYPE_CHECKING:
    from rich.console import Console

log = logging.getLogger(__name__)

Outcome = Literal["ran", "refused", "crashed"]

# Groups of plugins whose options are no parts of a pipeline, or choose several.
_NO_PARTS = {"dataset", "viewer", "system", "experiment", "study", "trainer", "training_data"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Combination:
    """What became of one choice of parts.

    Attributes:
        choices: option by slot, and by group where another than the default was taken.
        outcome: ran, refused (with vioframe's own reason), or crashed (a bug).
        error: class of the error, or empty.
        reason: its sentence, or empty.
        states: how many states came out.
    """

    choices: dict[str, str]
    outcome: Outcome
    error: str = ""
    reason: str = ""
    states: int = 0


def run(config: DictConfig) -> int:
    """Try every combination on the same short recording; the status is 1 if any crashed."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    duration_s = float(config.task.duration_s)
    combinations = list(enumerate_choices())
    results: list[Combination] = []
    with frame_progress("combinations", len(combinations) + 1, shown=bool(config.progress)) as advance, Composer():
        recording, packets = _record(duration_s)
        for done, choices in enumerate(combinations, start=1):
            results.append(try_combination(choices, recording, packets))
            advance(done)
        for choices in enumerate_variations(results):
            results.append(try_combination(choices, recording, packets))
    folder.mkdir(parents=True, exist_ok=True)
    counts = Counter(result.outcome for result in results)
    document = {"counts": dict(counts), "combinations": [asdict(result) for result in results]}
    (folder / "matrix.json").write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    _print(results, folder)
    return 1 if counts["crashed"] else 0


def enumerate_choices() -> Iterator[dict[str, str]]:
    """Every combination of the options that vioframe and its plugins offer for the five slots."""
    offered = {slot: _offered(slot) for slot in SLOTS}
    for slot in SLOTS:
        if slot not in OPTIONAL_SLOTS:
            offered[slot] = [name for name in offered[slot] if name != "none"]
    for names in itertools.product(*offered.values()):
        yield dict(zip(SLOTS, names, strict=True))


def enumerate_variations(results: Sequence[Combination]) -> Iterator[dict[str, str]]:
    """Other cameras, and the options of the groups that parts bring along, for each front end and fuser that ran."""
    first: dict[tuple[str, str], dict[str, str]] = {}
    for result in results:
        if result.outcome == "ran":
            first.setdefault((result.choices["frontend"], result.choices["fuser"]), result.choices)
    for choices in first.values():
        # The recording has two cameras; rig=stereo is what has been tried.
        for rig in _offered("rig"):
            if rig != "stereo":
                yield {**choices, "rig": rig}
        config = compose("config", overrides=[*(f"{slot}={name}" for slot, name in choices.items())])
        for group in _plugin_groups() - set(SLOTS) - _NO_PARTS:
            if group in config:
                yield from ({**choices, group: name} for name in _offered(group) if name != "none")


def _plugin_groups() -> set[str]:
    folders = [found.conf for found in discover() if found.conf is not None]
    return {path.name for conf in folders for path in conf.iterdir() if path.is_dir()}


def _offered(group: str) -> list[str]:
    """Options of a group: the core's first, then those of each plugin."""
    folders = [core_conf(), *(found.conf for found in discover() if found.conf is not None)]
    return [name for conf in folders for name in sorted(path.stem for path in (conf / group).glob("*.yaml"))]


def _record(duration_s: float) -> tuple[Recording, list[Packet]]:
    """Render the recording once: a stereo walk, long enough to leave out its standstill."""
    config = compose("config", overrides=["rig=stereo", f"dataset.duration_s={duration_s}", "dataset.standstill_s=0"])
    dataset = build(config, "dataset", Dataset, "simulated")
    recording = dataset.open(dataset.sequences[0])
    return recording, list(recording.packets())


def try_combination(choices: dict[str, str], recording: Recording, packets: list[Packet]) -> Combination:
    """Compose, build and run one combination."""
    overrides = [f"{group}={name}" for group, name in {"rig": "stereo", **choices}.items()]
    try:
        config = compose("config", overrides=[*overrides, "tracker=none"])
        pipeline = build_pipeline(config, choices)
        truth = recording.ground_truth()
        cameras = int(config.rig.cameras) if config.rig.images else 0
        rig = replace(
            recording.rig, cameras=recording.rig.cameras[: config.rig.cameras], has_images=bool(config.rig.images)
        )
        pipeline.setup(rig, initial_state("groundtruth", truth, recording.name))
        lend_ground_truth(pipeline, truth, recording.name)
        states = sum(1 for _ in pipeline.run(_seen_by(packet, cameras) for packet in packets))
    except VioframeError as error:
        return Combination(choices=choices, outcome="refused", error=type(error).__name__, reason=str(error))
    except Exception as error:
        # Whatever else comes out is a bug in a part; it is reported with its traceback, and the others are tried.
        log.exception("%s crashed", " ".join(overrides))
        return Combination(choices=choices, outcome="crashed", error=type(error).__name__, reason=str(error))
    if not states:
        return Combination(choices=choices, outcome="crashed", error="StateError", reason="ran, but gave no state")
    return Combination(choices=choices, outcome="ran", states=states)


def _seen_by(packet: Packet, cameras: int) -> Packet:
    """The packet with the images of so many cameras."""
    return replace(packet, images=packet.images[:cameras]) if isinstance(packet, Frame) else packet


def _print(results: list[Combination], folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    ran = [result for result in results if result.outcome == "ran" and set(result.choices) == set(SLOTS)]
    table = Table(title="Combinations that run", title_justify="left")
    for slot in ("frontend", "vo", "integrator", "fuser"):
        table.add_column(slot)
    table.add_column("synchronizers")
    grouped: dict[tuple[str, ...], list[str]] = {}
    for result in ran:
        key = tuple(result.choices[slot] for slot in ("frontend", "vo", "integrator", "fuser"))
        grouped.setdefault(key, []).append(result.choices["synchronizer"])
    for key, synchronizers in grouped.items():
        table.add_row(*key, " ".join(synchronizers))
    console.print(table)
    _print_variations([result for result in results if set(result.choices) != set(SLOTS)], console)
    refusals = Table(title="Why the others are refused", title_justify="left")
    refusals.add_column("combinations", justify="right")
    refusals.add_column("reason", overflow="fold")
    reasons = Counter(result.reason.partition(" (")[0] for result in results if result.outcome == "refused")
    for reason, count in reasons.most_common():
        refusals.add_row(str(count), reason)
    console.print(refusals)
    for result in results:
        if result.outcome == "crashed":
            console.print(f"[red]crashed[/red] {result.choices}: {result.error}: {result.reason}")
    counts = Counter(result.outcome for result in results)
    console.print(
        f"{len(results)} combinations: {counts['ran']} ran, {counts['refused']} refused with a reason, "
        f"{counts['crashed']} crashed. Each one's reason: {folder / 'matrix.json'}"
    )


def _print_variations(results: Sequence[Combination], console: "Console") -> None:
    from rich.table import Table

    table = Table(title="The same with other cameras and further groups", title_justify="left")
    for slot in ("frontend", "vo", "integrator", "fuser"):
        table.add_column(slot)
    for outcome in ("ran", "refused"):
        table.add_column(outcome)
    grouped: dict[tuple[str, ...], dict[str, list[str]]] = {}
    for result in results:
        key = tuple(result.choices[slot] for slot in ("frontend", "vo", "integrator", "fuser"))
        varied = " ".join(f"{group}={name}" for group, name in result.choices.items() if group not in SLOTS)
        grouped.setdefault(key, {}).setdefault(result.outcome, []).append(varied)
    for key, outcomes in grouped.items():
        table.add_row(*key, *(", ".join(outcomes.get(outcome, [])) for outcome in ("ran", "refused")))
    console.print(table)
