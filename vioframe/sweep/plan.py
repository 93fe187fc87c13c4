"""What a sweep is about to run, told before its sweeper does."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from omegaconf import DictConfig

_VALIDATED_JOBS = 20
"""How many jobs are composed before anything is recorded, to let a misspelt option answer at once."""


def read_arguments(config: "DictConfig") -> list[str]:
    """Return everything a sweeper goes through: its own parameters, then the command line's overrides."""
    from omegaconf import OmegaConf

    parameters = OmegaConf.select(config, "hydra.sweeper.params") or {}
    return [f"{key}={value}" for key, value in parameters.items()] + [str(t) for t in config.hydra.overrides.task]


def plan_jobs(arguments: list[str]) -> tuple[list[str], list[list[str]]]:
    """Return the swept keys, and every job's overrides where Hydra's basic sweeper can tell them."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        parsed = OverridesParser.create().parse_overrides(arguments)
        swept = [entry.get_key_element() for entry in parsed if entry.is_sweep_override()]
    except HydraException:
        # The sweeper is about to say so itself, better.
        return [], []
    try:
        planned = [list(job) for job in BasicSweeper.split_arguments(parsed, None)[0]]
    except HydraException:
        # A range of another sweeper, or a glob over a group, which only the sweeper can expand.
        planned = []
    return swept, planned


def composes(config: "DictConfig", planned: list[list[str]]) -> bool:
    """Tell whether the first jobs' configs compose; where not, Hydra's sweeper is about to say why."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException

    hydra = GlobalHydra.instance().hydra
    if hydra is None:
        return True
    try:
        for overrides in planned[:_VALIDATED_JOBS]:
            hydra.config_loader.load_sweep_config(config, overrides)
    except HydraException:
        return False
    return True


def tracker_options(config: "DictConfig") -> dict[str, Any] | None:
    """Return the options of ``tracker=mlflow``; ``None`` for another tracker, which knows no parents."""
    import copy

    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from vioframe.errors import ConfigError

    holder = HydraConfig.instance()
    before = holder.cfg
    try:
        # Hydra sets this for jobs only, and ${hydra:...} needs it.
        holder.set_config(copy.deepcopy(config))
        node = OmegaConf.select(config, "tracker")
        if node is None or not OmegaConf.is_dict(node):
            return None
        options = OmegaConf.to_container(node, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"tracker: {str(error).splitlines()[0]}") from error
    finally:
        holder.cfg = before
    if not isinstance(options, dict) or options.pop("_target_", "") != "vioframe.tracking.MlflowTracker":
        return None
    return {str(key): value for key, value in options.items()}


def label_job(overrides: list[str], swept: list[str]) -> str:
    """Name a job by its swept overrides; by all of them where nothing is known to be swept."""
    return " ".join([text for text in overrides if text.partition("=")[0] in swept] or overrides)
