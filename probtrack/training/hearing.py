"""What every fit to recordings does with a batch: hears it, looks up the truth, and lets some parameters be."""

import zlib
from collections.abc import Sequence

from torch import Tensor, nn

from probtrack.audio import Observations
from probtrack.errors import InputError
from probtrack.trackers import Tracker
from probtrack.training.batches import SceneBatch


def numbers_of(batch: SceneBatch) -> list[int]:
    """Return a number for each recording and crop, its own whatever batch it sits in."""
    pairs = zip(batch.names, batch.start.tolist(), strict=True)
    return [zlib.crc32(f"{name} {start}".encode()) for name, start in pairs]


def heard(tracker: Tracker, batch: SceneBatch, warm_up: int) -> Observations:
    """Return what is heard after the first `warm_up` frames (T, B, ...): sound by the tracker's own front end."""
    if batch.num_frames <= warm_up:
        raise InputError(f"warm_up must be shorter than recordings, got {warm_up} of {batch.num_frames} frames")
    if batch.observations is not None:
        return Observations(*(x[warm_up:] for x in batch.observations))
    assert batch.audio is not None
    frames = tracker.front_end.stft(batch.audio)
    speech, _ = tracker.front_end.vad(frames)
    # correlations are dear, and nobody asks for those of the warm-up
    return Observations(tracker.front_end.gcc(frames.spectrum[warm_up:]), speech[warm_up:])


def true_position(tracker: Tracker, batch: SceneBatch, warm_up: int) -> tuple[Tensor, Tensor]:
    """Return where the talker is after the warm-up (T, B, A) [m], and whether that is known (T, B).

    Raises:
        InputError: for a truth without positions, or with several talkers.
    """
    truth = batch.truth
    if truth is None or truth.position is None:
        raise InputError(f"{batch.names[0]}: has no positions in its truth, and training needs them")
    if truth.position.shape[-2] != 1:
        raise InputError(f"{batch.names[0]}: has {truth.position.shape[-2]} talkers, this tracker follows one")
    return truth.position[warm_up:, :, 0, : tracker.region.axes], truth.known[warm_up:, :, 0]


def keep_fixed(model: nn.Module, fixed: Sequence[str]) -> None:
    """Train no parameter of `model` whose name begins with one of `fixed`; `InputError` where none does."""
    names = [name for name, _ in model.named_parameters()]
    for beginning in fixed:
        if not any(name.startswith(beginning) for name in names):
            raise InputError(f"fixed: no parameter begins with {beginning!r}: there are {', '.join(names)}")
    for name, parameter in model.named_parameters():
        if name.startswith(tuple(fixed)):
            parameter.requires_grad_(False)
