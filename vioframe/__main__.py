"""``python -m vioframe``: compose the config, dispatch on ``task``, fail in one sentence.

Nothing heavy is imported here: ``--help``, a misspelt option and ``task=plugins`` answer at once.
"""

import importlib
import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.errors import ConfigError, VioframeError
from vioframe.plugins import core_conf, extend_hydra

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger("vioframe")

TASKS = ("experiment", "train", "study", "evaluate", "evaluate_features", "doctor", "matrix", "plugins", "model_card")
INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it: 128 + SIGINT."""


def dispatch(config: "DictConfig") -> int:
    """Run the task the config names; return the exit status."""
    name = config.task.name
    if name not in TASKS:
        raise ConfigError(f"task.name={name} is unknown: choose one of {', '.join(TASKS)}")
    run: Callable[[DictConfig], int] = importlib.import_module(f"vioframe.tasks.{name}").run
    return run(config)


def run_job(config: "DictConfig") -> None:
    """One job of Hydra's: a user's mistake becomes one sentence and a non-zero exit status."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    reason = ""
    in_sweep = HydraConfig.get().mode == RunMode.MULTIRUN
    try:
        status = dispatch(config)
    except VioframeError as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        log.error("%s", error)
        status = 1
        reason = str(error)
    if status == INTERRUPTED and in_sweep:
        raise KeyboardInterrupt
    if in_sweep:
        # The other jobs go on; conclude() reads what became of each from its folder.
        from vioframe.sweep import write_status

        write_status(Path(HydraConfig.get().runtime.output_dir), "failed" if status else "finished", reason)
    elif status:
        sys.exit(status)


def main() -> None:
    """Entry point of ``python -m vioframe`` and of the console script."""
    # Matrices are small here: BLAS threads would only wait for each other, beside the thread that reads images.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    # A corrupt image is reported once, by the reader that meets it, with its path.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    try:
        extend_hydra()
    except VioframeError as error:
        logging.basicConfig(format="%(levelname)s: %(message)s")
        log.error("%s", error)
        sys.exit(1)

    import hydra

    from vioframe.sweep import conclude

    interrupted = False
    failed: Sequence[object] = ()
    try:
        hydra.main(version_base="1.3", config_path=str(core_conf()), config_name="config")(run_job)()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        failed = conclude(interrupted=interrupted)
    if interrupted:
        sys.exit(INTERRUPTED)
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    main()
