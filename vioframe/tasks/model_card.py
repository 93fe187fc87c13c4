"""``task=model_card``: what each part with a net weighs, and what one answer costs on this machine."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from vioframe.build import build
from vioframe.errors import ConfigError
from vioframe.interfaces import Component, Frontend, Fuser, HasNet, InertialIntegrator, VOEstimator
from vioframe.learning import require_torch
from vioframe.pipeline import SLOTS
from vioframe.testing import Scene, make_scene, measurement_of, scene_for
from vioframe.types import ImuBias


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCard:
    """One part's figures.

    Attributes:
        choice: as on the command line, such as ``"vo=tsvo"``.
        architecture: in words.
        device: where it ran.
        parameters: learned numbers.
        megabytes: of a file of weights.
        macs: multiply–accumulates of one answer.
        uncounted: kinds of layers whose work is not among them.
        answer_ms: median wall time of one answer.
    """

    choice: str
    architecture: str
    device: str
    parameters: int
    megabytes: float
    macs: int
    uncounted: tuple[str, ...]
    answer_ms: float


def run(config: DictConfig) -> int:
    """Show the figures of the parts that have a net.

    Raises:
        ConfigError: none has.
    """
    require_torch("task=model_card")
    choices = {group: str(option) for group, option in HydraConfig.get().runtime.choices.items()}
    cards = []
    # Part by part: what comes before and after has no bearing on a net's figures, so it need not fit.
    for slot, interface in SLOTS.items():
        if config.get(slot):
            part = build(config, slot, interface, choices.get(slot, ""))
            # Some take part in training with nothing to learn.
            if isinstance(part, HasNet) and any(True for _ in part.net.parameters()):
                cards.append(model_card(part, f"{slot}={choices.get(slot, '')}"))
    if not cards:
        told = ", ".join(f"{slot}={choices[slot]}" for slot in SLOTS if choices.get(slot))
        raise ConfigError(f"task=model_card has nothing to show: none of {told} has a net; choose one, as vo=...")
    _show(cards)
    return 0


def model_card(part: HasNet, choice: str) -> ModelCard:
    """Measure a part as it is used: image by image, on a short drawn scene.

    Raises:
        ConfigError: the part is of a slot that makes no answers of its own.
    """
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    from vioframe.learning.counting import bytes_of, counting, milliseconds, parameters_of

    if not isinstance(part, Component):
        raise ConfigError(f"{choice} is no component")
    scene = scene_for(part)
    part.setup(scene.rig)
    device = next((parameter.device for parameter in part.net.parameters()), torch.device("cpu"))
    calls = _calls(part, scene, choice)
    for call in calls[:-1]:
        call()
    # Layers are blind to what a part does with a copy of its net, such as one with normalisation folded in; torch's own
    # counter is blind to LSTM layers.
    with counting(part.net) as work, FlopCounterMode(display=False) as counter:
        calls[-1]()
    part.setup(scene.rig)
    following = iter(_calls(part, scene, choice))
    answer_ms = milliseconds(lambda: next(following)(), repeats=len(calls) - 2, device=device)
    return ModelCard(
        choice=choice,
        architecture=", ".join(f"{name}={value}" for name, value in part.architecture.items() if name != "part"),
        device=str(device),
        parameters=parameters_of(part.net),
        megabytes=bytes_of(part.net) / 1e6,
        macs=max(work.macs, counter.get_total_flops() // 2),
        uncounted=tuple(sorted(work.uncounted)),
        answer_ms=answer_ms,
    )


def _calls(part: Component, scene: Scene, choice: str) -> list[Callable[[], object]]:
    """One call for each answer, in the order in which a pipeline would make them."""
    if isinstance(part, Frontend):
        return [partial(part.process, frame) for frame in scene.frames]
    if isinstance(part, VOEstimator):
        return [partial(part.estimate, *pair) for pair in pairwise(scene.features)]
    if isinstance(part, InertialIntegrator):
        return [partial(part.integrate, window.imu, ImuBias()) for window in scene.windows]
    if isinstance(part, Fuser):
        measurements = [measurement_of(scene, index, window) for index, window in enumerate(scene.windows)]
        return [partial(part.update, measured) for measured in measurements]
    raise ConfigError(f"{choice} makes no answers of its own that could be counted")


def _show(cards: list[ModelCard]) -> None:
    import torch
    from rich.console import Console
    from rich.table import Table

    table = Table(title="parts with a net", title_justify="left")
    for heading in ("part", "parameters", "GMAC", "MB", "ms"):
        table.add_column(heading, no_wrap=True, justify="left" if heading == "part" else "right")
    for card in cards:
        # Where only some layers are counted, a number would mislead.
        macs = "not counted" if card.uncounted else f"{card.macs / 1e9:.3f}"
        table.add_row(
            card.choice,
            f"{card.parameters:,}".replace(",", " "),
            macs,
            f"{card.megabytes:.1f}",
            f"{card.answer_ms:.1f}",
        )
    console = Console()
    console.print(table)
    width, height = make_scene().rig.cameras[0].size_px
    console.print(
        "GMAC: 1e9 multiply-accumulates of the convolutions, linear and LSTM layers of one answer (FLOP are twice as "
        f"many). ms: median of one answer, with all that goes before and after the net, on {cards[0].device} with "
        f"{torch.get_num_threads()} thread(s). Images given: {width}x{height} px, brought to each part's own size.",
        markup=False,
        highlight=False,
    )
    for card in cards:
        console.print(f"{card.choice}: {card.architecture}", markup=False, highlight=False)
        if card.uncounted:
            console.print(f"{card.choice}: the work of {', '.join(card.uncounted)} is not counted.", markup=False)
