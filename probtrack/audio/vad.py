"""Soft voice activity: the probability, frame by frame, that somebody speaks."""

import abc
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool1d

from probtrack._checks import as_positive, check_int
from probtrack.audio.frames import Frames, band_bins
from probtrack.errors import InputError

_EDGE = 16  # samples: so many zeros of every microphone at the end of a frame are silence, not faint noise


class VoiceActivity(nn.Module, abc.ABC):
    """P(speech) of each frame, alpha in S1 eq. (5), from the frames so far and none to come."""

    @abc.abstractmethod
    def forward(self, frames: Frames, state: Any = None) -> tuple[Tensor, Any]:
        """Return P(speech) (T, *batch) in [0, 1] of `frames`, and the state to go on with.

        `state` is None at the start and what the last call returned afterwards: the same numbers come out
        however a signal is cut into calls.
        """


class EnergyState(NamedTuple):
    """What `EnergyVoiceActivity` remembers between calls, oldest first.

    Attributes:
        level: Band levels (smoothing - 1, *batch) [dB].
        smooth: Smoothed levels of the floor's window (window - 1, *batch) [dB], +inf before the start.
    """

    level: Tensor
    smooth: Tensor


class EnergyVoiceActivity(VoiceActivity):
    r"""P(speech) from the level of the speech band over a tracked noise floor.

    .. math::
        e_t = 10 \log_{10} \overline{|S_m(t, f)|^2}, \quad
        \bar e_t = \frac1J \sum_{j<J} e_{t-j}, \quad
        \alpha_t = \operatorname{sigmoid}\bigl(a (\bar e_t - \min_{i<W} \bar e_{t-i} - b)\bigr)

    The average of e runs over microphones and the bins of the band. The floor is the smallest smoothed level
    of the last W frames: it follows falling noise at once and rising noise after the window. Averaging
    decibels rather than powers weakens clicks: J b dB, 24 by default, in one frame or half of it in each of two
    only reach the threshold. Frames that are digital
    silence, or begin or end in it, have alpha = 0 and do not enter the floor, nor do the J - 1 after them.

    S1 uses a detector but gives no formula (section 2.1); this one is our choice. Nothing depends on the
    absolute level. A recording that starts in the middle of a word hears it only after the first gap.

    Args:
        fs: Sampling rate [Hz].
        frame_length: Samples in a frame.
        hop: Samples between the starts of frames.
        band: Lowest and highest frequency used [Hz].
        threshold: Level over the floor at which P(speech) is one half, b [dB].
        slope: Steepness a [1/dB].
        smoothing: Number of frames averaged, J.
        memory: Length of the floor's window [s].

    Attributes:
        threshold: b [dB], learnable.
        log_slope: log a, learnable.

    References:
        R. Martin, "Noise power spectral density estimation based on optimal smoothing and minimum
        statistics", IEEE Trans. SAP 9(5), 2001: the tracked minimum, here of one band.
    """

    def __init__(
        self,
        *,
        fs: int = 16_000,
        frame_length: int = 512,
        hop: int = 256,
        band: tuple[float, float] = (300.0, 3000.0),
        threshold: float = 8.0,
        slope: float = 1.0,
        smoothing: int = 3,
        memory: float = 3.0,
    ) -> None:
        super().__init__()
        as_positive(memory, "memory")
        self.smoothing = check_int(smoothing, "smoothing", low=1)
        self.window = max(2, round(memory * fs / hop))
        self.low_bin, self.high_bin = (max(1, edge) for edge in band_bins(band, fs, frame_length))  # without DC
        if not math.isfinite(threshold):
            raise InputError(f"threshold must be finite, got {threshold}")
        self.threshold = nn.Parameter(torch.tensor(float(threshold)))
        self.log_slope = nn.Parameter(as_positive(slope, "slope").log())

    def forward(self, frames: Frames, state: EnergyState | None = None) -> tuple[Tensor, EnergyState | None]:
        band = frames.spectrum[..., self.low_bin : self.high_bin + 1]
        # one axis at a time and contiguous: else the order of adding, and so the rounding, depends on the cut
        power = (band.real.square() + band.imag.square()).mean(-1).contiguous().mean(-1)  # (T, *batch)
        if len(power) == 0:
            return power, state
        nothing = (power == 0) | begins_or_ends_silent(frames.samples)
        level = 10 * power.masked_fill(nothing, 1.0).log10().masked_fill(nothing, -torch.inf)
        if state is None:
            before = level[:1].expand(self.smoothing - 1, *level.shape[1:])
            state = EnergyState(before, level.new_full((self.window - 1, *level.shape[1:]), torch.inf))
        levels = torch.cat([state.level, level])
        smooth = sum_of_shifts(levels, self.smoothing) / self.smoothing
        # digital silence (-inf dB) is not noise: it must not become the floor
        candidates = torch.cat([state.smooth, torch.where(smooth.isneginf(), torch.inf, smooth)])
        # a level may be -inf, and the floor with it +inf: then the frame is silent, 0 and without gradient
        over_floor = smooth - running_minimum(candidates, self.window)
        silent = over_floor.isneginf() | over_floor.isnan()
        evidence = self.log_slope.exp() * (over_floor.masked_fill(silent, 0.0) - self.threshold)
        # not sigmoid(): it rounds the last numbers of a tensor otherwise, so that the cut would show
        speech = (1 + (-evidence).clamp_max(80.0).exp()).reciprocal().masked_fill(silent, 0.0)
        kept = EnergyState(levels[len(level) :], candidates[len(level) :])
        return speech, kept


class SileroState(NamedTuple):
    """What `SileroVoiceActivity` remembers between calls.

    Attributes:
        pending: Samples that do not fill a chunk yet (B, < 512).
        context: Last samples of the chunk before (B, 64).
        memory: State of the recurrent network (2, B, 128).
        speech: P(speech) of the last chunk (B,).
    """

    pending: Tensor
    context: Tensor
    memory: Tensor
    speech: Tensor


class SileroVoiceActivity(VoiceActivity):
    """P(speech) by the neural detector of the package silero-vad (extra `vad`), first microphone, 16 kHz.

    The network hears chunks of 32 ms; a frame gets the probability of the last chunk that ended by the
    frame's end. Its weights ship in its wheel; they are not trained here.

    Args:
        fs: Sampling rate, 16 000 Hz: what the network was trained for.
        hop: Samples between the starts of frames.

    Raises:
        ImportError: without silero-vad, with the line that installs it.
        InputError: for another sampling rate.
    """

    CHUNK, CONTEXT = 512, 64

    def __init__(self, *, fs: int = 16_000, hop: int = 256) -> None:
        super().__init__()
        if fs != 16_000:
            raise InputError(f"silero-vad works at fs = 16000 Hz, got {fs}")
        self.hop = hop
        self.network = _silero_network()

    def forward(self, frames: Frames, state: SileroState | None = None) -> tuple[Tensor, SileroState | None]:
        samples = frames.samples[..., 0, :]  # first microphone, (T, *batch, L)
        num_frames, batch, frame_length = samples.shape[0], samples.shape[1:-1], samples.shape[-1]
        if num_frames == 0:
            return samples.new_zeros(num_frames, *batch), state
        samples = samples.reshape(num_frames, -1, frame_length)
        fresh = samples[..., -self.hop :].transpose(0, 1).flatten(1)  # (B, T * hop)
        if state is None:
            fresh = torch.cat([samples[0, :, : -self.hop], fresh], 1)
            state = _silent(fresh)
        # how many samples have been heard at the end of each frame, from the first pending one
        heard = state.pending.shape[1] + fresh.shape[1] - self.hop * torch.arange(num_frames).flip(0)
        stream = torch.cat([state.pending, fresh], 1)
        chunks = stream.split(self.CHUNK, 1)
        whole = stream.shape[1] // self.CHUNK
        results, context, memory = [state.speech], state.context, state.memory
        for chunk in chunks[:whole]:
            speech, memory = self._hear(torch.cat([context, chunk], 1), memory)
            context = chunk[:, -self.CONTEXT :]
            results.append(speech)
        speech = torch.stack(results)[heard // self.CHUNK]
        pending = stream[:, whole * self.CHUNK :]
        return speech.reshape(num_frames, *batch), SileroState(pending, context, memory, results[-1])

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "SileroVoiceActivity":
        super()._apply(fn, recurse)
        self.network.float()  # it moves with the module to a device, but works in float32 alone
        return self

    def _hear(self, chunk: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            speech, memory = self.network(chunk.float(), memory)
        return speech[:, 0].to(chunk), memory


def sum_of_shifts(x: Tensor, count: int) -> Tensor:
    """Return the sums of `count` neighbours along the first axis, each added in the same order.

    (A cumulative sum would make the result depend on where a signal was cut.)
    """
    length = x.shape[0] - count + 1
    total = x[:length]
    for shift in range(1, count):
        total = total + x[shift : shift + length]
    return total


def running_minimum(x: Tensor, count: int) -> Tensor:
    """Return the minimum of `count` neighbours along the first axis, (T - count + 1, ...)."""
    columns = x.reshape(len(x), -1).t()
    return -max_pool1d(-columns[:, None], count, stride=1)[:, 0].t().reshape(-1, *x.shape[1:])


def begins_or_ends_silent(samples: Tensor) -> Tensor:
    """Return whether all microphones are at 0 where a frame begins or ends, of samples (T, *batch, M, L): (T, *batch).

    Such a frame is cut by digital silence. Its level may be any, so that it says nothing of the noise floor.
    """
    edges = samples[..., :_EDGE], samples[..., -_EDGE:]
    first, last = (edge.abs().amax((-1, -2)) for edge in edges)
    return torch.minimum(first, last) == 0


def _silent(fresh: Tensor) -> SileroState:
    size = len(fresh)
    return SileroState(
        pending=fresh[:, :0],
        context=fresh.new_zeros(size, SileroVoiceActivity.CONTEXT),
        memory=torch.zeros(2, size, 128, dtype=torch.float32, device=fresh.device),
        speech=fresh.new_zeros(size),
    )


def _silero_network() -> nn.Module:
    import warnings

    threads = torch.get_num_threads()
    try:
        from silero_vad import load_silero_vad
    except ImportError:
        raise ImportError("silero-vad is missing: pip install 'probtrack[vad]'") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # its file is TorchScript, which torch deprecates
        network = load_silero_vad()._model
    torch.set_num_threads(threads)
    for parameter in network.parameters():
        parameter.requires_grad_(False)
    return network  # type: ignore[no-any-return]
