"""The whole training: MagicPoint on drawn shapes, labels by homographic adaptation, then both heads together.

A folder of labels that is complete makes the first two stages needless; a resume file goes on within the stage that
wrote it.
"""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import torch
from filelock import FileLock, Timeout

from vioframe import __version__
from vioframe.errors import ConfigError
from vioframe.learning.seeding import seed_everything
from vioframe.learning.weights import load_weights, locate_weights, read_card, save_weights
from vioframe.tracking import Tracker
from vioframe_superpoint.net.superpoint import SuperPointNet, make_net
from vioframe_superpoint.options import Encoder
from vioframe_superpoint.training.cards import GENERATED, excerpt_of, licence_of, machine_of, made_with
from vioframe_superpoint.training.data import MakeBatch, PairBatches, ShapeBatches
from vioframe_superpoint.training.labelling import label_pictures
from vioframe_superpoint.training.labels import LabelStore
from vioframe_superpoint.training.loop import RESUME_FILE, Loop, Progress, Session, Stage, StepLoss, read_resume
from vioframe_superpoint.training.options import TrainingOptions, plain_values
from vioframe_superpoint.training.precision import resolve_precision
from vioframe_superpoint.training.schedule import RateOptions
from vioframe_superpoint.training.sources import picture_source
from vioframe_superpoint.training.steps import JointLoss, ShapesLoss
from vioframe_superpoint.training.validation import PairValidation, ShapesValidation, validation_pairs

log = logging.getLogger(__name__)

SHAPES, JOINT = "shapes", "joint"
DETECTOR_FILE = "detector.safetensors"
"""In a folder of labels: the net that made them."""
SHAPES_FILE = "shapes.safetensors"
"""In a run's folder: the same net before the weight of corners is taken back, to which they are far too likely."""
LOCK_FILE = "lock"
_CORNER_WEIGHT = "corner_weight"


@dataclass(slots=True, eq=False)
class NamedNet:
    """A net and what its weights must agree with.

    Attributes:
        net: SuperPoint's.
        architecture: as of a part with a net.
    """

    net: SuperPointNet
    architecture: Mapping[str, str | int | float | bool]


class Training:
    """A training of one net, in one folder.

    Args:
        encoder: of the net.
        architecture: of the part whose weights come out.
        options: of the training.
        device: where.
        folder: of weights, curves, pictures and resume file.
        tracker: of the run.
        shown: whether to show bars.
        resume: go on from the resume file of the folder.

    Raises:
        DataError: the resume file is not whole.
    """

    def __init__(
        self,
        encoder: Encoder,
        architecture: Mapping[str, str | int | float | bool],
        options: TrainingOptions,
        *,
        device: torch.device,
        folder: Path,
        tracker: Tracker,
        shown: bool,
        resume: bool,
    ) -> None:
        self._encoder = encoder
        self._architecture = architecture
        self._options = options
        self._folder = folder
        self._session = Session(
            device=device,
            precision=resolve_precision(options.precision, device),
            workers=options.workers,
            folder=folder,
            tracker=tracker,
            shown=shown,
            until=None if options.max_minutes is None else time.monotonic() + 60.0 * options.max_minutes,
        )
        self._store = LabelStore(folder / "labels" if options.labels is None else Path(options.labels).expanduser())
        self._resume: tuple[str, Path] | None = None
        if resume:
            self._resume = (str(read_resume(folder / RESUME_FILE)["stage"]), folder / RESUME_FILE)

    def run(self) -> Path | None:
        """Train, as far as the time allows.

        Returns:
            The best weights so far, or None.

        Raises:
            ConfigError: an option that cannot work, or a learning rate that diverges.
            DataError: files that do not fit.
            KeyboardInterrupt: the user stopped it.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        if self._store.is_complete:
            self._tell_what_differs()
        elif not self._make_labels_alone():
            return None
        return self._train_jointly()

    def _tell_what_differs(self) -> None:
        """Labels stay as they are, whatever is asked for now."""
        options, detector = self._options, self._store.about().get("detector", {})
        differing = self._store.differing(self._asked())
        if options.detector is not None and detector.get("file") != Path(options.detector).name:
            differing.append(f"detector ({detector.get('file', 'a first stage')}, not {options.detector})")
        elif options.detector is None and detector.get("training", plain_values(options.shapes)) != plain_values(
            options.shapes
        ):
            differing.append("shapes")
        if differing:
            log.warning("labels in %s stay as they were made, with other %s", self._store.folder, ", ".join(differing))

    def _make_labels_alone(self) -> bool:
        """Make labels, or wait for another training that makes them; whether they are there."""
        self._store.folder.mkdir(parents=True, exist_ok=True)
        lock, until = FileLock(self._store.folder / LOCK_FILE), self._session.until
        try:
            lock.acquire(timeout=0)
        except Timeout:
            log.info("another training makes the labels in %s: waiting for it", self._store.folder)
            try:
                lock.acquire(timeout=-1 if until is None else max(until - time.monotonic(), 0.0))
            except Timeout:
                log.info("the time of this session is over before the labels are there")
                return False
        try:
            return self._store.is_complete or self._make_labels()
        finally:
            lock.release()

    def _asked(self) -> dict[str, object]:
        """What the options say of the labels."""
        options = self._options
        return {
            "pictures": plain_values(options.pictures),
            "adaptation": plain_values(options.adaptation),
            "seed": options.seed,
        }

    def _make_labels(self) -> bool:
        """The first two stages; whether they are done."""
        detector = self._store.folder / DETECTOR_FILE
        net = self._new_net()
        if self._options.detector is not None:
            key = "frontend.training.detector"
            given = locate_weights(self._options.detector, key)
            load_weights(given, net, key)
            card = read_card(given)
            if card.get("stage") == SHAPES and card.get(_CORNER_WEIGHT) != 1.0:
                raise ConfigError(
                    f"{key}={self._options.detector} learned with corners weighing "
                    f"{card.get(_CORNER_WEIGHT, 'more than others')}, and finds far too many: give {DETECTOR_FILE} of "
                    "a folder of labels, in which that is taken back"
                )
            about = {"file": given.name, **excerpt_of(card)}
        else:
            if not detector.exists() and not self._train_on_shapes(net):
                return False
            load_weights(detector, net, "frontend.training.labels")
            card = read_card(detector)
            about = excerpt_of(card)
        source = picture_source(self._options.pictures, self._options.seed)
        told = {"detector": {"architecture": dict(self._architecture), **about}, **self._asked()}
        self._store.begin(told)
        # The third stage begins with it, of this training and of others.
        if not detector.exists():
            save_weights(detector, net, card)
        return label_pictures(
            self._store,
            source,
            net.net.to(self._session.device),
            self._options.adaptation,
            seed=self._options.seed,
            precision=self._session.precision,
            about=told,
            until=self._session.until,
            shown=self._session.shown,
        )

    def _train_on_shapes(self, net: NamedNet) -> bool:
        """The first stage; whether it is done."""
        options = self._options.shapes
        validation = ShapesValidation(net.net, options)
        best = self._folder / "weights" / SHAPES_FILE
        loss = ShapesLoss(options.corner_weight)
        done = self._fit(
            SHAPES,
            net,
            loss,
            ShapeBatches(options, self._options.seed),
            RateOptions(
                iterations=options.iterations,
                learning_rate=options.learning_rate,
                schedule="cosine",
                warmup=self._options.warmup,
                weight_decay=0.0,
            ),
            validation=validation,
            best=best,
            about={
                "training": plain_values(options),
                "seed": self._options.seed,
                _CORNER_WEIGHT: options.corner_weight,
                "licence": GENERATED,
            },
            rate_key="frontend.training.shapes.learning_rate",
        )
        if done:
            load_weights(best, net, "the first stage")
            loss.take_back(net.net)
            save_weights(self._store.folder / DETECTOR_FILE, net, {**read_card(best), _CORNER_WEIGHT: 1.0})
        return done

    def _train_jointly(self) -> Path | None:
        """The third stage; the best weights so far."""
        labelled = self._store.read()
        learned, held_out = labelled.parted(int(labelled.about["pictures"]["held_out"]))
        net = self._new_net()
        start = self._start(net)
        options = self._options
        pairs = validation_pairs(held_out.pictures, options.pairs.lighting, options.seed)
        path = self._folder / "weights" / f"superpoint-{self._encoder.name}.safetensors"
        done = self._fit(
            JOINT,
            net,
            JointLoss(options.descriptor_loss),
            PairBatches(learned, options.pairs, options.batch_size, options.seed),
            RateOptions(
                iterations=options.iterations,
                learning_rate=options.learning_rate,
                schedule=options.schedule,
                warmup=options.warmup,
                weight_decay=options.weight_decay,
            ),
            validation=PairValidation(net.net, pairs),
            best=path,
            about={
                "training": {**options.settings(), **made_with(labelled.about)},
                "labels": dict(labelled.about),
                "start": start,
                "licence": licence_of(labelled.about),
            },
            rate_key="frontend.training.learning_rate",
        )
        if not done:
            log.info("the time of this session is over before the training is")
        return path if path.exists() else None

    def _start(self, net: NamedNet) -> str:
        """First weights: those of the detector that made the labels, where it is of the same architecture."""
        detector = self._store.folder / DETECTOR_FILE
        if detector.exists() and read_card(detector).get("architecture") == dict(self._architecture):
            load_weights(detector, net, "frontend.training.labels")
            return f"{DETECTOR_FILE} of the labels"
        return "random"

    def _new_net(self) -> NamedNet:
        seed_everything(self._options.seed)
        return NamedNet(make_net(self._encoder), self._architecture)

    def _fit(
        self,
        name: str,
        net: NamedNet,
        loss: StepLoss,
        make: MakeBatch,
        rate: RateOptions,
        *,
        validation: ShapesValidation | PairValidation,
        best: Path,
        about: Mapping[str, object],
        rate_key: str,
    ) -> bool:
        """Train through a stage, or go on with it; whether it is done."""
        options = self._options

        def validate(iteration: int) -> Mapping[str, float]:
            picture = self._folder / "pictures" / f"{name}-{iteration:06d}.png"
            validation.draw(picture)
            self._session.tracker.log_file(picture, "pictures")
            return validation.figures()

        def keep(progress: Progress, figures: Mapping[str, float]) -> None:
            card = {
                "stage": name,
                "iteration": progress.iteration,
                "iterations": rate.iterations,
                "hours": progress.seconds / 3600.0,
                "validation": dict(figures),
                **about,
                "precision": self._session.precision,
                "machine": machine_of(self._session.device),
                "code": {"vioframe": __version__, "torch": torch.__version__},
                "made": datetime.now(UTC).isoformat(timespec="seconds"),
            }
            save_weights(best, net, card)

        stage = Stage(
            name=name,
            loss=loss,
            make=make,
            rate=rate,
            gradient_clip=options.gradient_clip,
            save_every=options.save_every,
            validate_every=options.validate_every,
            validate=validate,
            keep=keep,
            rate_key=rate_key,
            settings=options.settings(),
        )
        loop = Loop(net.net.to(self._session.device), stage, self._session)
        if self._resume is not None and self._resume[0] == name:
            loop.resume(self._resume[1])
        log.info(
            "%s: %d of %d iterations are done; %s on %s",
            name,
            loop.progress.iteration,
            rate.iterations,
            self._session.precision,
            self._session.device.type,
        )
        done = loop.run()
        curve = self._folder / f"{name}.csv"
        if curve.exists():
            self._session.tracker.log_file(curve)
        return done
