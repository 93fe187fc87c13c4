"""The core of VINet: what two images show and what the IMU felt, remembered by an LSTM, into motions.

Clark, Wang, Wen, Markham, Trigoni, "VINet: Visual-Inertial Odometry as a Sequence-to-Sequence Learning Problem",
AAAI 2017.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from vioframe.learning.motion import exp_so3, from_parts, log_so3, product
from vioframe_vinet.net.gyro import USUAL_S, Bias, GyroCheck, Sight
from vioframe_vinet.net.inertial import InertialEncoder, Resampled, turn_by_gyro
from vioframe_vinet.net.lasting import Lasting, LastingScale

_MOTION = 6
# In squared units of the output: one sample known to 2.5 thousandths of a unit must not outweigh all others.
_LARGEST_LOG_VARIANCE = 12.0
# ln of a variance that an output of 1 is worth.
_SPREAD_GAIN = 4.0
# What a feature of 1 means: m of the pose that is fed back.
_PLACE_UNIT = 10.0


class CoreState(NamedTuple):
    """What the net goes on from.

    Attributes:
        hidden, cell: (layers, B, hidden).
        T_first_prev: (B, 4, 4) pose since it began to remember.
        bias: of the gyro, or None where rotation is not taken from it.
    """

    hidden: Tensor
    cell: Tensor
    T_first_prev: Tensor
    bias: Bias | None

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
        log_variances: (B, S, 6) natural logarithms of rad² and m², of what is new in the vector's errors each time, or
            None.
        lasting: what its errors share with those of other pairs, or None.
        sight: the rotation that images alone show, or None.
    """

    T_prev_cur: Tensor
    vector: Tensor
    log_variances: Tensor | None
    lasting: Lasting | None = None
    sight: Sight | None = None


class _Rotations(NamedTuple):
    """What pairs say of rotation: turns (B, S, 3, 3) of the gyro, whether it was heard and images seen, (B, S) bool."""

    turns: Tensor
    heard: Tensor
    visible: Tensor
    sight: Sight | None
    duration_s: Tensor

    def at(self, k: int) -> "_Rotations":
        """Those of the one pair k."""
        now = slice(k, k + 1)
        sight = None if self.sight is None else Sight(*(each[:, now] for each in self.sight))
        return _Rotations(self.turns[:, now], self.heard[:, now], self.visible[:, now], sight, self.duration_s[:, now])


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
        gyro_bias_sigma: float,
        gyro_memory: int,
        scale_memory: int,
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
            gyro_turns: take rotation from the gyro, corrected by what images say of its bias; the core then answers
                with the translation alone.
            gyro_bias_sigma: rad/s an axis, of that bias at first.
            gyro_memory: pairs after which what images said counts 1/e.
            scale_memory: pairs after which 1/e is left of an error of the lengths.
            feed_back_pose: let the core see the pose since it began to remember.
            rotation_unit_rad, translation_unit_m: what an output of 1 means.
        """
        super().__init__()
        self.imu_intervals = imu_intervals
        self._feed_back = feed_back_pose
        self._units = (rotation_unit_rad, translation_unit_m)
        self.inertial = InertialEncoder(hidden=imu_hidden, layers=imu_layers)
        self.gyro: GyroCheck | None = None
        if gyro_turns:
            self.gyro = GyroCheck(embedding=embedding, bias_sigma=gyro_bias_sigma, memory=gyro_memory)
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
        self.answer = nn.Linear(joined, 3 if gyro_turns else _MOTION)
        self.spread = nn.Linear(joined + (3 if gyro_turns else 0), _MOTION) if log_variances else None
        self.scale = LastingScale(scale_memory) if log_variances else None
        # At first close to no motion, whatever it sees.
        nn.init.normal_(self.answer.weight, std=0.1 * joined**-0.5)
        nn.init.zeros_(self.answer.bias)
        if self.spread is not None:
            nn.init.normal_(self.spread.weight, std=0.1 * joined**-0.5)
            # A gyro turns by far less wrongly than an output of 1, and steps are told to about a quarter of it.
            with torch.no_grad():
                self.spread.bias[:3] = (-6.0 if gyro_turns else 0.0) / _SPREAD_GAIN
                self.spread.bias[3:] = -3.0 / _SPREAD_GAIN

    def begin(self, sequences: int) -> CoreState:
        """The state of sequences that begin."""
        weight = self.answer.weight
        shape = (self.core.num_layers, sequences, self.core.hidden_size)
        identity = torch.eye(4, dtype=torch.float32, device=weight.device).expand(sequences, 4, 4)
        bias = None if self.gyro is None else self.gyro.begin(weight, sequences)
        return CoreState(weight.new_zeros(shape), weight.new_zeros(shape), identity, bias)

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
        turns = turn_by_gyro(seen.samples).reshape(batch, pairs, 3, 3).float()
        sight = None if self.gyro is None else self.gyro.see(embedding)
        rotations = _Rotations(turns, heard, seen.visible, sight, seen.duration_s.float())
        if not self._feed_back:
            remembered, (hidden, cell) = self.core(inputs, (state.hidden, state.cell))
            return self._answer(remembered, rotations, state._replace(hidden=hidden, cell=cell))
        answers = []
        for k in range(pairs):
            pose = state.T_first_prev
            place = torch.cat([log_so3(pose[:, :3, :3]), pose[:, :3, 3] / _PLACE_UNIT], dim=-1)
            step = torch.cat([inputs[:, k : k + 1], place.to(inputs.dtype)[:, None]], dim=-1)
            remembered, (hidden, cell) = self.core(step, (state.hidden, state.cell))
            state = state._replace(hidden=hidden, cell=cell)
            answer, state = self._answer(remembered, rotations.at(k), state)
            answers.append(answer)
            state = state._replace(T_first_prev=product(pose, answer.T_prev_cur[:, 0]))
        variances = [each.log_variances for each in answers if each.log_variances is not None]
        lasting = [each.lasting for each in answers if each.lasting is not None]
        whole = CoreAnswer(
            torch.cat([each.T_prev_cur for each in answers], dim=1),
            torch.cat([each.vector for each in answers], dim=1),
            torch.cat(variances, dim=1) if variances else None,
            Lasting(*(torch.cat(parts, dim=1) for parts in zip(*lasting, strict=True))) if lasting else None,
            sight,
        )
        return whole, state

    def _answer(self, remembered: Tensor, rotations: _Rotations, state: CoreState) -> tuple[CoreAnswer, CoreState]:
        features = self.joined(remembered)
        # Single precision even where the layers before ran in half: a rotation of 0.01° would not survive that.
        numbers = self.answer(features).float()
        known = features.detach()
        lasting = None if self.scale is None else self.scale(rotations.visible)
        unit = math.log(self._units[0])
        if self.gyro is None or rotations.sight is None or state.bias is None:
            R = exp_so3(self._units[0] * numbers[..., :3])
        else:
            sight = rotations.sight
            checked = rotations.heard & rotations.visible
            found, bias = self.gyro(rotations.turns, sight, checked, rotations.duration_s, state.bias)
            heard = rotations.heard[..., None]
            seen = torch.where(rotations.visible[..., None], sight.vector, torch.zeros_like(sight.vector))
            R = product(rotations.turns, exp_so3(torch.where(heard, found.correction, seen)))
            # Whose rotation it is, and where it is the images', how good: of the order of 1.
            told = torch.where(heard, torch.ones_like(seen), 0.2 * (sight.log_variances.detach() - 2.0 * unit))
            known = torch.cat([known, told.to(known.dtype)], dim=-1)
            state = state._replace(bias=bias)
            if lasting is not None:
                of_sight = (self.gyro.lasting_variance / USUAL_S**2).expand_as(found.variance)
                lasting = lasting.joined(
                    torch.where(heard, found.variance, of_sight),
                    torch.where(heard, found.kept, torch.zeros_like(found.kept)),
                )
        p = self._units[1] * numbers[..., -3:]
        # What is learned of errors must not bend what is learned of motions: the larger gradient is that of variances.
        variances = None
        if self.spread is not None:
            limited = _SPREAD_GAIN * self.spread(known).float()
            limited = limited.clamp(-_LARGEST_LOG_VARIANCE, _LARGEST_LOG_VARIANCE)
            variances = limited + 2.0 * limited.new_tensor([self._units[0]] * 3 + [self._units[1]] * 3).log()
        vector = torch.cat([log_so3(R), p], dim=-1)
        return CoreAnswer(from_parts(R, p), vector, variances, lasting, rotations.sight), state
