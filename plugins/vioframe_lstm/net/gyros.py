"""What gyros were found to be off by on training recordings."""

import torch
from torch import Tensor, nn

# Windows that are remembered, the last ones.
_KEPT = 1024
# Standard deviation of a Gaussian for a median deviation of one.
_FROM_MEDIAN = 1.4826
# rad/s: no gyro is known better.
_LEAST_SPREAD = 1e-5


class GyroRecord(nn.Module):
    """Mean errors of the gyro over training windows, kept with the weights; nothing here has a gradient.

    Everything is taken from medians: samples with holes that nobody noticed are no bias.

    Attributes:
        errors: (1024, 3) rad/s, over the last windows.
        seconds: (1024,) their lengths.
        recordings: (1024,) the number of the recording that each is of.
        count: how many windows there were.
    """

    errors: Tensor
    seconds: Tensor
    recordings: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        shapes = {"errors": (_KEPT, 3), "seconds": (_KEPT,), "recordings": (_KEPT,), "count": ()}
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    def learn(self, errors: Tensor, seconds: Tensor, recordings: Tensor) -> None:
        """Take more windows: (W, 3) rad/s, (W,) s, (W,) numbers of recordings."""
        place = (int(self.count) + torch.arange(len(errors), device=errors.device)) % _KEPT
        self.errors[place] = errors.to(self.errors)
        self.seconds[place] = seconds.to(self.seconds)
        self.recordings[place] = recordings.to(self.recordings)
        self.count += len(errors)

    def summary(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """Mean bias (3,) rad/s, how far that of another recording may be from it (3,), and white noise (3,) rad/√s.

        The first two are over recordings, the noise is what makes windows of one recording differ. None before any.
        """
        if not int(self.count):
            return None
        kept = slice(0, min(int(self.count), _KEPT))
        errors, seconds, recordings = self.errors[kept], self.seconds[kept], self.recordings[kept]
        biases = []
        apart = torch.zeros_like(errors)
        for number in sorted(set(recordings.tolist())):
            mine = recordings == number
            bias = errors[mine].median(0).values
            apart[mine] = errors[mine] - bias
            biases.append(bias)
        noise = _FROM_MEDIAN * (apart * seconds.sqrt()[:, None]).abs().median(0).values
        several = torch.stack(biases)
        mean = several.mean(0)
        # One recording does not tell how far others are; its windows tell at least how far it might be itself.
        within = noise.square() / seconds.median()
        between = several.var(0) if len(several) > 1 else within
        return mean, (between * (1.0 + 1.0 / len(several))).sqrt().clamp_min(_LEAST_SPREAD), noise
