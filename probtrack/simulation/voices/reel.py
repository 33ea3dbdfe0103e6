"""The speech of one real talker as an endless reel, from which utterances are cut where it is quiet."""

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from probtrack.simulation.voices.material import stretches

_SLACK = 0.2  # s by which a cut may miss the length asked for
_SNIPPET = 0.1  # s; nothing shorter is begun or left over
_QUIET = 0.02  # s over which quiet is measured
_FADE = 0.01  # s


class Reel:
    """Endless speech of one talker: its files in an order drawn by `generator`, and over again.

    Args:
        files: Audio of the talker.
        fs: Sampling rate [Hz].
        generator: Draws the order, and the stretch of the first file to begin with.
    """

    def __init__(self, files: list[Path], fs: int, generator: torch.Generator) -> None:
        self.fs = fs
        self._stretches = _endless(files, fs, generator)
        self._rest = next(self._stretches)

    def cut(self, wanted: int, most: int) -> Tensor:
        """Return the next utterance of about `wanted` samples, at most `most`.

        It ends where a pause of the talker ends it, or else in the quietest 20 ms less than 0.2 s away from
        there; both ends of each piece fade within 10 ms.
        """
        slack, snippet = round(_SLACK * self.fs), round(_SNIPPET * self.fs)
        pieces, missing = [], wanted
        while True:
            latest = min(missing + slack, most - wanted + missing)
            if len(self._rest) > latest:
                place = self._quietest(max(missing - slack, snippet), latest)
                pieces.append(self._rest[:place])
                self._rest = self._rest[place:]
                missing = 0
            else:
                pieces.append(self._rest)
                missing -= len(self._rest)
                self._rest = self._rest[:0]
            if len(self._rest) < snippet:
                self._rest = next(self._stretches)
            if missing <= slack:
                return torch.cat([_faded(piece, round(_FADE * self.fs)) for piece in pieces])

    def _quietest(self, low: int, high: int) -> int:
        """Return the middle of the quietest 20 ms of the rest, at `low` or later and `high` at the latest."""
        half, step = round(_QUIET * self.fs / 2), round(_QUIET * self.fs / 8)
        around = self._rest[max(low - half, 0) : high + half]
        if low >= high or len(around) < 2 * half:
            return high
        energy = around.unfold(0, 2 * half, step).square().sum(-1)
        return min(max(low - half, 0) + half + int(energy.argmin()) * step, high)


def _endless(files: list[Path], fs: int, generator: torch.Generator) -> Iterator[Tensor]:
    order = [files[i] for i in torch.randperm(len(files), generator=generator).tolist()]
    first = stretches(order[0], fs)
    skipped = int(torch.randint(len(first), (), generator=generator))
    yield from first[skipped:]
    while True:
        for file in (*order[1:], order[0]):
            yield from stretches(file, fs)


def _faded(piece: Tensor, length: int) -> Tensor:
    """Return a copy whose ends rise from and fall to silence along raised cosines."""
    length = min(length, len(piece) // 2)
    rise = torch.sin(torch.linspace(0, torch.pi / 2, length + 2, dtype=piece.dtype)[1:-1]).square()
    gain = torch.ones_like(piece)
    gain[:length] = rise
    gain[len(piece) - length :] = rise.flip(0)
    return piece * gain
