"""Weights for the nets of a study: trained once a variant, then lent to all of its cells."""

from collections.abc import Mapping

from omegaconf import DictConfig, OmegaConf

from vioframe.build import build_dataset, build_pipeline
from vioframe.composing import Composed
from vioframe.interfaces import Trainable
from vioframe.tasks.provision import provide_weights, untrained_slots


def weights_of(composed: Composed, *, shown: bool) -> dict[str, str]:
    """Files of weights by slot, of the parts that have none and need some; they are trained where nobody did before.

    Args:
        composed: the variant without any fault, as its nets should be trained; left as it is.
        shown: whether to show progress bars.

    Raises:
        ConfigError: it is not said how to train, or the training cannot work.
        DataError: recordings that cannot be learned from.
        KeyboardInterrupt: the user stopped the training; it can go on.
    """
    pipeline = build_pipeline(composed.config, composed.choices)
    slots = [slot for slot, part in pipeline.parts().items() if isinstance(part, Trainable)]
    if not untrained_slots(pipeline):
        return {}
    config = OmegaConf.create(composed.config)
    before = {slot: config[slot].get("weights") for slot in slots}
    dataset = build_dataset(config, composed.choices.get("dataset", ""))
    provide_weights(config, composed.choices, pipeline, dataset, shown=shown)
    return {slot: str(config[slot].weights) for slot in slots if config[slot].get("weights") != before[slot]}


def lend(config: DictConfig, weights: Mapping[str, str]) -> None:
    """Let ``config`` take these files, in place."""
    for slot, path in weights.items():
        OmegaConf.update(config, f"{slot}.weights", path)
