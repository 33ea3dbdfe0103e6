"""When a clean recording speaks."""

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

_RANGE = 60.0  # dB below the speech: silence made by a computer lies no lower than that


def speech_activity(samples: Tensor, fs: int) -> Tensor:
    """Return when a clean recording (S,) of one voice speaks, (S,) bool, by its level in frames of 20 ms.

    The threshold stands a third of the way up from the noise floor (the level that 10 % of the frames stay
    below) to the level of speech (which 5 % exceed), in dB. Gaps shorter than 0.3 s belong to the speech.
    Where the two are less than 10 dB apart there are no pauses to be found, and all is speech.
    """
    frame = round(0.02 * fs)
    padded = pad(samples, (0, -len(samples) % frame))
    level = 10 * torch.log10(padded.reshape(-1, frame).square().mean(-1) + 1e-30)
    top = torch.quantile(level, 0.95)
    floor = torch.maximum(torch.quantile(level, 0.1), top - _RANGE)
    loud = (level > floor + (top - floor) / 3) | (top - floor < 10)
    gap = 15  # frames; a dilation followed by an erosion of the same width closes what is shorter
    wide = max_pool1d(loud.double()[None], 2 * (gap // 2) + 1, 1, gap // 2)
    closed = -max_pool1d(-wide, 2 * (gap // 2) + 1, 1, gap // 2)
    return closed[0].bool().repeat_interleave(frame)[: len(samples)]
