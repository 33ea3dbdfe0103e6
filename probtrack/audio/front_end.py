"""From samples to what a filter observes: pair correlations and voice activity, frame by frame."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from probtrack.audio.frames import ShortTimeSpectrum
from probtrack.audio.gcc import GeneralisedCrossCorrelation
from probtrack.audio.vad import VoiceActivity
from probtrack.errors import NotFiniteError, ShapeError


class Observations(NamedTuple):
    """What the microphones say of each frame, time first.

    Attributes:
        gcc: Pair correlations (T, *batch, P, K) on the lags of `GeneralisedCrossCorrelation`.
        speech: P(speech) (T, *batch).
    """

    gcc: Tensor
    speech: Tensor


class FrontEndState(NamedTuple):
    """What a front end remembers between blocks of samples.

    Attributes:
        samples: Samples (*batch, M, n) that the next frame starts with.
        speech: State of the voice activity detector.
    """

    samples: Tensor
    speech: Any


class FrontEnd(nn.Module):
    """Short-time spectra, pair correlations and voice activity of a multichannel signal.

    Args:
        stft: Makes the frames.
        gcc: Correlates the pairs.
        vad: Says how likely speech is.

    Shape:
        samples (*batch, M, n) with n of any length. Returns `Observations` with one entry for each whole
        frame; frame t covers samples tH to tH + L - 1.
    """

    def __init__(self, stft: ShortTimeSpectrum, gcc: GeneralisedCrossCorrelation, vad: VoiceActivity) -> None:
        super().__init__()
        self.stft, self.gcc, self.vad = stft, gcc, vad

    def forward(self, samples: Tensor) -> Observations:
        return self.step(None, samples)[1]

    def step(self, state: FrontEndState | None, samples: Tensor) -> tuple[FrontEndState, Observations]:
        """Hear the next `samples` (*batch, M, n) of a stream; `state` is None at its start.

        Raises:
            ShapeError: for another number of channels than the array has.
            NotFiniteError: for NaN or infinite samples.
        """
        if samples.ndim < 2 or samples.shape[-2] != self.gcc.num_microphones:
            wanted = f"(..., {self.gcc.num_microphones}, n)"
            raise ShapeError(f"samples must have shape {wanted}, one row a microphone, got {tuple(samples.shape)}")
        if not samples.abs().sum().isfinite():  # one number tells, in a tenth of the time of asking each
            raise NotFiniteError("samples hold NaN or infinite values")
        memory = None
        if state is not None:
            samples, memory = torch.cat([state.samples, samples], -1), state.speech
        frames = self.stft(samples)
        speech, memory = self.vad(frames, memory)
        observations = Observations(self.gcc(frames.spectrum), speech)
        return FrontEndState(samples[..., len(speech) * self.stft.hop :].clone(), memory), observations
