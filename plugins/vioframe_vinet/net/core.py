"""The core of VINet: what two images show and what the IMU felt, remembered by an LSTM, into motions.

Clark, Wang, Wen, Markham, Trigoni, "VINet: Visual-Inertial Odometry as a Sequence-to-Sequence Learning Problem",
AAAI 2017.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from vioframe.learning.motion import exp_so3, from_parts, log_so3, product
from vioframe_vinet.net.inertial import InertialEncoder, Resampled, turn_by_gyro

_MOTION = 6
# What a feature of 1 means: m of the pose that is fed back.
_PLACE_UNIT = 10.0
USUAL_S = 0.1
"""What times between images are measured against, s."""


class CoreState(NamedTuple):
    """What the net goes on from.

    Attributes:
        hidden, cell: (layers, B, hidden).
        T_first_prev: (B, 4, 4) pose since it began to remember.
        correction: (B, 3) rad in :data:`USUAL_S`, mean of what was to be added to the gyro.
        corrected: (B,) of so many pairs.
    """

    hidden: Tensor
    cell: Tensor
    T_first_prev: Tensor
    correction: Tensor
    corrected: Tensor

    def rested(self) -> "CoreState":
        """After a hole of unknown length: what was seen is forgotten, what is known of the gyro is not."""
        identity = torch.eye(4, dtype=self.T_first_prev.dtype, device=self.T_first_prev.device)
        return self._replace(
            hidden=torch.zeros_like(self.hidden),
            cell=torch.zeros_like(self.cell),
            T_first_prev=identity.expand_as(self.T_first_prev),
        )


class Seen(NamedTuple):
    """S pairs of images in a row, of B sequences.

    Attributes:
        embedding: (B, S, D); anything where not visible.
        visible: (B, S) bool, whether there are both images.
        samples: of the B · S pairs, those of one sequence together, in the axes of the answer.
        duration_s: (B, S) between the images.
    """

    embedding: Tensor
    visible: Tensor
    samples: Resampled
    duration_s: Tensor


class CoreAnswer(NamedTuple):
    """What the net answers.

    Attributes:
        T_prev_cur: (B, S, 4, 4) motions.
        vector: (B, S, 6) the same as (rotation vector rad, translation m).
        log_variances: (B, S, 6) of its errors, in units of the output, or None.
    """

    T_prev_cur: Tensor
    vector: Tensor
    log_variances: Tensor | None


class _Gyro(NamedTuple):
    """What the gyro says: turns (B, S, 3, 3), whether it was heard, and whether images could check it, (B, S) bool."""

    turns: Tensor
    heard: Tensor
    checked: Tensor


class VinetCore(nn.Module):
    """Inertial encoder, core LSTM, two linear layers."""

    def __init__(
        self,
        *,
        embedding: int,
        imu_intervals: int,
        imu_hidden: int,
        imu_layers: int,
        hidden: int,
        layers: int,
        joined: int,
        dropout: float,
        log_variances: bool,
        gyro_turns: bool,
        gyro_memory: int,
        feed_back_pose: bool,
        rotation_unit_rad: float,
        translation_unit_m: float,
    ) -> None:
        """Build the net.

        Args:
            embedding: D, numbers of the front end.
            imu_intervals: to which the samples of a pair are brought.
            imu_hidden, imu_layers: of the LSTM over them.
            hidden, layers: of the core's.
            joined: neurons of the layer before the answer.
            dropout: in training, after the core and between its layers.
            log_variances: answer with variances too.
            gyro_turns: answer with what is to be added to the gyro's rotation, instead of all of it.
            gyro_memory: of so many pairs, at most, what is added is the mean: a gyro's bias changes slowly.
            feed_back_pose: let the core see the pose since it began to remember.
            rotation_unit_rad, translation_unit_m: what an output of 1 means.
        """
        super().__init__()
        self.imu_intervals = imu_intervals
        self._gyro_turns, self._feed_back = gyro_turns, feed_back_pose
        self._gyro_memory = gyro_memory
        self._units = (rotation_unit_rad, translation_unit_m)
        self.inertial = InertialEncoder(hidden=imu_hidden, layers=imu_layers)
        # So many pairs without any correction are as good as what is not known of the bias at first: ln of it.
        self.doubt = nn.Parameter(torch.zeros(())) if gyro_turns else None
        inputs = embedding + imu_hidden + 3 + (_MOTION if feed_back_pose else 0)
        # Torch warns of a dropout between the layers of a single one.
        self.core = nn.LSTM(inputs, hidden, layers, batch_first=True, dropout=dropout if layers > 1 else 0.0)
        for name, parameter in self.core.named_parameters():
            if name.startswith("bias_ih"):
                # Gates in torch's order: input, forget, cell, output. An open forget gate lets gradients reach back
                # through the window from the first step (Jozefowicz et al., ICML 2015).
                with torch.no_grad():
                    parameter[hidden : 2 * hidden].fill_(1.0)
        self.joined = nn.Sequential(nn.Dropout(dropout), nn.Linear(hidden, joined), nn.ReLU(inplace=True))
        self.answer = nn.Linear(joined, _MOTION)
        self.spread = nn.Linear(joined, _MOTION) if log_variances else None
        # At first close to no motion, or to the gyro's rotation, whatever it sees.
        nn.init.normal_(self.answer.weight, std=0.1 * joined**-0.5)
        nn.init.zeros_(self.answer.bias)
        if self.spread is not None:
            nn.init.normal_(self.spread.weight, std=0.1 * joined**-0.5)
            nn.init.zeros_(self.spread.bias)

    def begin(self, sequences: int) -> CoreState:
        """The state of sequences that begin."""
        weight = self.answer.weight
        shape = (self.core.num_layers, sequences, self.core.hidden_size)
        identity = torch.eye(4, dtype=torch.float32, device=weight.device).expand(sequences, 4, 4)
        none = torch.zeros(sequences, 3, dtype=torch.float32, device=weight.device)
        return CoreState(weight.new_zeros(shape), weight.new_zeros(shape), identity, none, none[:, 0])

    def forward(self, seen: Seen, state: CoreState | None = None) -> tuple[CoreAnswer, CoreState]:
        """Motions over the pairs, and the state to go on from; without a state the sequences begin."""
        batch, pairs = seen.visible.shape
        state = state or self.begin(batch)
        features = self.inertial(seen.samples.means)
        # A sensor that is missing shows zeros, and that it is missing: the core's weights of that are what stands in.
        features = features * seen.samples.heard[:, None]
        heard = seen.samples.heard.reshape(batch, pairs)
        embedding = torch.where(seen.visible[..., None], seen.embedding, torch.zeros_like(seen.embedding))
        told = [seen.visible.to(embedding.dtype), heard.to(embedding.dtype), seen.duration_s / USUAL_S - 1.0]
        inputs = torch.cat([embedding, features.reshape(batch, pairs, -1), torch.stack(told, dim=-1)], dim=-1)
        gyro = _Gyro(turn_by_gyro(seen.samples).reshape(batch, pairs, 3, 3), heard, heard & seen.visible)
        if not self._feed_back:
            remembered, (hidden, cell) = self.core(inputs, (state.hidden, state.cell))
            return self._answer(remembered, gyro, seen.duration_s, state._replace(hidden=hidden, cell=cell))
        answers = []
        for k in range(pairs):
            now = slice(k, k + 1)
            pose = state.T_first_prev
            place = torch.cat([log_so3(pose[:, :3, :3]), pose[:, :3, 3] / _PLACE_UNIT], dim=-1)
            step = torch.cat([inputs[:, now], place.to(inputs.dtype)[:, None]], dim=-1)
            remembered, (hidden, cell) = self.core(step, (state.hidden, state.cell))
            state = state._replace(hidden=hidden, cell=cell)
            part = _Gyro(gyro.turns[:, now], gyro.heard[:, now], gyro.checked[:, now])
            answer, state = self._answer(remembered, part, seen.duration_s[:, now], state)
            answers.append(answer)
            state = state._replace(T_first_prev=product(pose, answer.T_prev_cur[:, 0]))
        variances = [each.log_variances for each in answers if each.log_variances is not None]
        whole = CoreAnswer(
            torch.cat([each.T_prev_cur for each in answers], dim=1),
            torch.cat([each.vector for each in answers], dim=1),
            torch.cat(variances, dim=1) if variances else None,
        )
        return whole, state

    def _answer(
        self, remembered: Tensor, gyro: _Gyro, duration_s: Tensor, state: CoreState
    ) -> tuple[CoreAnswer, CoreState]:
        # Single precision even where the layers before ran in half: a rotation of 0.01° would not survive that.
        features = self.joined(remembered)
        numbers = self.answer(features).float()
        turn = self._units[0] * numbers[..., :3]
        if self._gyro_turns:
            correction, state = self._mean_correction(turn, gyro.checked, state)
            heard = gyro.heard[..., None]
            turn = torch.where(heard, correction * (duration_s / USUAL_S)[..., None], turn)
            R = product(gyro.turns.float(), exp_so3(turn))
        else:
            R = exp_so3(turn)
        p = self._units[1] * numbers[..., 3:]
        # What is learned of errors must not bend what is learned of motions: the larger gradient is that of variances.
        variances = None if self.spread is None else self.spread(features.detach()).float()
        return CoreAnswer(from_parts(R, p), torch.cat([log_so3(R), p], dim=-1), variances), state

    def _mean_correction(self, turn: Tensor, checked: Tensor, state: CoreState) -> tuple[Tensor, CoreState]:
        """The mean (B, S, 3) of what was to be added to the gyro so far, where images could tell; and the new state."""
        mean, count = state.correction, state.corrected
        doubt = torch.ones_like(count) if self.doubt is None else self.doubt.exp().expand_as(count)
        means = []
        for k in range(turn.shape[1]):
            fresh = checked[:, k].to(count.dtype)
            count = (count + fresh).clamp_max(self._gyro_memory)
            # Before the first, the mean is zero with the weight of ``doubt`` pairs.
            share = (fresh / (count + doubt))[:, None]
            mean = mean + share * (turn[:, k] - mean)
            means.append(mean)
        return torch.stack(means, dim=1), state._replace(correction=mean, corrected=count)
