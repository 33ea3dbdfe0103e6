"""What microphones hear of a source that passes from one place, whose response is known, to the next."""

import itertools
import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from probtrack._checks import as_non_negative, as_positive, check_int
from probtrack.errors import NotFiniteError, ShapeError

_TOGETHER = 8  # blocks that are transformed at once: memory does not grow with the length of a stay


def render_places(
    signal: Tensor,
    place: Tensor,
    response_of: Callable[[int], Tensor],
    channels: Tensor | None = None,
    *,
    fade: float = 0.05,
    fs: float,
    lead: int,
) -> Tensor:
    r"""Return (M, S), what is heard of `signal` emitted at sample s through the response of `place[s]`.

    .. math:: y_m(n) = \sum_p \sum_s h_{p,m}(n - s + lead)\, w_p(s)\, x(s), \qquad w_p = 1[place = p] * hann

    The weights are what the indicators of the places become when smoothed by a Hann kernel: they are smooth
    and add up to one at every sample, however fast the place changes. Each place costs a convolution over the
    spans where its weight is not zero and the signal sounds; `response_of` is called once for each such place.

    Args:
        signal: (S,); results have its dtype.
        place: (S,) long, number of the place of emission at each sample.
        response_of: Gives the response (M, L) of a place or, with `channels`, (C, M, L). L may vary, M may not.
        channels: (S, C): `signal * channels[:, c]` goes through response c, and the results add up. Smooth.
        fade: Length of the Hann kernel [s], centred on the change; 0 switches at once.
        fs: Sampling rate [Hz].
        lead: Samples of each response that lie before time zero.

    Raises:
        InputError: for shapes that do not fit, or numbers that are not finite.
    """
    _check(signal, place, channels)
    check_int(lead, "lead", low=0)
    reach = round(float(as_non_negative(fade, "fade") * as_positive(fs, "fs")) / 2)
    audio: Tensor | None = None
    sounding = signal.detach().nonzero()[:, 0]
    for number, spans in _stays(place, reach):
        heard = [span for start, end in spans for span in _sounding(sounding, start, end)]
        if not heard:
            continue
        response = _checked_response(response_of(number), number, channels).to(signal)
        if audio is None:
            audio = signal.new_zeros(response.shape[1], len(signal))
        if response.shape[1] != len(audio):
            raise ShapeError(f"response of place {number} must have {len(audio)} microphones, got {response.shape[1]}")
        block = max(round(fs), response.shape[-1])
        blocks = [(a, min(a + block, end)) for start, end in heard for a in range(start, end, block)]
        blocks = [cut for start, end in blocks for cut in _sounding(sounding, start, end)]

        def drive(start: int, end: int, number: int = number) -> Tensor:
            weighted = signal[start:end] * _weight(place, number, start, end, reach).to(signal)
            return weighted[None] if channels is None else weighted * channels[start:end].T.to(signal)

        _add_convolved(audio, blocks, drive, response, lead)
    if audio is None:  # silence: only the number of microphones is wanted
        return signal.new_zeros(response_of(int(place[0])).shape[-2], len(signal))
    return audio


def fast_size(size: int) -> int:
    """Return the smallest 2^a 3^b 5^c of at least `size`: a length whose Fourier transform is fast.

    >>> fast_size(4801)
    4860
    """
    best = 1 << max(size - 1, 0).bit_length()
    for five, three in itertools.product(range(8), range(12)):
        odd = 5**five * 3**three
        if odd < best:
            best = min(best, odd << max(math.ceil(size / odd) - 1, 0).bit_length())
    return best


def _check(signal: Tensor, place: Tensor, channels: Tensor | None) -> None:
    if signal.ndim != 1 or len(signal) == 0:
        raise ShapeError(f"signal must have shape (S,) with S > 0, got {tuple(signal.shape)}")
    if place.shape != signal.shape or place.dtype != torch.int64:
        raise ShapeError(f"place must be long and have shape ({len(signal)},), got {place.dtype} {tuple(place.shape)}")
    if channels is not None and (channels.ndim != 2 or len(channels) != len(signal)):
        raise ShapeError(f"channels must have shape ({len(signal)}, C), got {tuple(channels.shape)}")
    for name, values in (("signal", signal), ("channels", channels)):
        if values is not None and not values.isfinite().all():
            raise NotFiniteError(f"{name} must be finite, got NaN or infinite samples")


def _checked_response(response: Tensor, number: int, channels: Tensor | None) -> Tensor:
    """Return the response as (C, M, L)."""
    if channels is None and response.ndim == 2:
        response = response[None]
    if response.ndim != 3 or len(response) != (1 if channels is None else channels.shape[1]):
        wanted = "(M, L)" if channels is None else f"({channels.shape[1]}, M, L)"
        raise ShapeError(f"response of place {number} must have shape {wanted}, got {tuple(response.shape)}")
    if not response.isfinite().all():
        raise NotFiniteError(f"response of place {number} must be finite")
    return response


def _stays(place: Tensor, reach: int) -> Iterator[tuple[int, list[tuple[int, int]]]]:
    """Yield each place with the spans [start, end) over which its weight is not zero, disjoint and in order."""
    change = (place[1:] != place[:-1]).nonzero()[:, 0] + 1
    first = torch.cat([change.new_zeros(1), change])
    last = torch.cat([change, change.new_full((1,), len(place))])
    order = torch.argsort(place[first], stable=True)
    number = place[first][order]
    start, end = (first[order] - reach).clamp(min=0), (last[order] + reach).clamp(max=len(place))
    new = torch.ones_like(number, dtype=torch.bool)
    new[1:] = (number[1:] != number[:-1]) | (start[1:] > end[:-1])
    final = torch.cat([new[1:], new.new_ones(1)])
    stays = zip(number[new].tolist(), start[new].tolist(), end[final].tolist(), strict=True)
    for key, group in itertools.groupby(stays, key=lambda stay: stay[0]):
        yield key, [(a, b) for _, a, b in group]


def _sounding(sounding: Tensor, start: int, end: int) -> list[tuple[int, int]]:
    """Return [start, end) cut down to its first and last of the `sounding` samples, or nothing."""
    low, high = torch.searchsorted(sounding, torch.tensor([start, end], device=sounding.device)).tolist()
    return [(int(sounding[low]), int(sounding[high - 1]) + 1)] if high > low else []


def _weight(place: Tensor, number: int, start: int, end: int, reach: int) -> Tensor:
    """Return the smoothed indicator of a place over [start, end), float64; the ends of `place` stay as they are.

    The kernel (1 + cos(pi k / (reach + 1))) / (2 reach + 2), |k| <= reach, is a difference of running sums.
    """
    at = torch.arange(start - reach, end + reach, device=place.device)
    here = (place[at.clamp(0, len(place) - 1)] == number).double()
    turn = (at - start).double() * (math.pi / (reach + 1))
    wave = torch.stack([torch.ones_like(turn), turn.cos(), turn.sin()])
    total = torch.nn.functional.pad((here * wave).cumsum(-1), (1, 0))
    window = total[:, 2 * reach + 1 :] - total[:, : -2 * reach - 1]
    middle = wave[:, reach : reach + end - start]
    return (window * middle).sum(0) / (2 * reach + 2)


def _add_convolved(
    audio: Tensor,
    blocks: list[tuple[int, int]],
    drive: Callable[[int, int], Tensor],
    response: Tensor,
    lead: int,
) -> None:
    """Add to `audio` (M, S) the `drive` (C, n) of each block [start, end) convolved with `response` (C, M, L)."""
    size = fast_size(max(end - start for start, end in blocks) + response.shape[-1] - 1)
    spectrum = torch.fft.rfft(response, size)
    for k in range(0, len(blocks), _TOGETHER):
        some = blocks[k : k + _TOGETHER]
        drives = [torch.nn.functional.pad(drive(start, end), (0, size - end + start)) for start, end in some]
        sources = torch.fft.rfft(torch.stack(drives))[:, :, None]  # shape: (blocks, C, 1, F)
        product = sources[:, 0] * spectrum[0]
        for c in range(1, len(response)):
            product.addcmul_(sources[:, c], spectrum[c])
        for (start, end), heard in zip(some, torch.fft.irfft(product, size), strict=True):
            first, last = start - lead, end - lead + response.shape[-1] - 1
            low, high = max(first, 0), min(last, audio.shape[-1])
            if low < high:
                audio[:, low:high] += heard[:, low - first : high - first]
