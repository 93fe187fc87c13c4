"""Embeddings of pairs that a frozen encoder has seen before."""

import hashlib
import itertools
from collections.abc import Callable

import torch
from torch import Tensor, nn

# At 256 numbers each: 100 MB.
_MOST = 100_000


class Memo:
    """Remembers by content: while the fuser learns by itself, the same pairs come again and again."""

    def __init__(self) -> None:
        self._known: dict[bytes, Tensor] = {}
        self._version: tuple[int, ...] = ()

    def embeddings(self, net: nn.Module, images: Tensor, encode: Callable[[Tensor], Tensor]) -> Tensor:
        """(B, S, D) of the neighbours among images (B, S + 1, C, H, W), on the CPU.

        Args:
            net: the encoder; when its weights change, all is forgotten.
            images: in [0, 1].
            encode: makes (N, D) of numbers (N, 2) of window and pair.
        """
        version = tuple(parameter._version for parameter in net.parameters())
        if version != self._version or len(self._known) > _MOST:
            self._known.clear()
            self._version = version
        digests = [
            [hashlib.blake2b(image.contiguous().numpy(), digest_size=16).digest() for image in row] for row in images
        ]
        keys = [[one + two for one, two in itertools.pairwise(row)] for row in digests]
        missing = {key: (b, s) for b, row in enumerate(keys) for s, key in enumerate(row) if key not in self._known}
        if missing:
            made = encode(torch.tensor(list(missing.values())))
            self._known.update(zip(missing, made, strict=True))
        return torch.stack([torch.stack([self._known[key] for key in row]) for row in keys])
