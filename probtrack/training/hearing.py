"""What every fit to recordings does with a batch: hears it, looks up the truth, and lets some parameters be."""

import zlib
from collections.abc import Sequence

from torch import Tensor, nn

from probtrack.audio import Observations
from probtrack.errors import InputError
from probtrack.likelihoods import SteeredPowerLikelihood
from probtrack.trackers import Tracker
from probtrack.training.batches import SceneBatch

_SAME_PLACE = 1e-4  # m by which microphones may be elsewhere: files and single precision round


def numbers_of(batch: SceneBatch) -> list[int]:
    """Return a number for each recording and crop, its own whatever batch it sits in."""
    pairs = zip(batch.names, batch.start.tolist(), strict=True)
    return [zlib.crc32(f"{name} {start}".encode()) for name, start in pairs]


def heard(tracker: Tracker, batch: SceneBatch, warm_up: int) -> Observations:
    """Return what is heard after the first `warm_up` frames (T, B, ...): sound by the tracker's own front end.

    Raises:
        InputError: for recordings that are not longer than the warm-up, or of other frames, rate, microphones or
            tables of correlations than the tracker's.
    """
    _check_fits(tracker, batch)
    if batch.num_frames <= warm_up:
        raise InputError(f"warm_up must be shorter than recordings, got {warm_up} of {batch.num_frames} frames")
    like = tracker.front_end.stft.window
    if batch.observations is not None:
        return Observations(*(x[warm_up:].to(like) for x in batch.observations))
    assert batch.audio is not None
    frames = tracker.front_end.stft(batch.audio.to(like))
    speech, _ = tracker.front_end.vad(frames)
    # correlations are dear, and nobody asks for those of the warm-up
    return Observations(tracker.front_end.gcc(frames.spectrum[warm_up:]), speech[warm_up:])


def true_position(tracker: Tracker, batch: SceneBatch, warm_up: int) -> tuple[Tensor, Tensor]:
    """Return where the talker is after the warm-up (T, B, A) [m], and whether that is known (T, B).

    Raises:
        InputError: for a truth without positions, with several talkers, with fewer axes than the tracker has, or with
            a position that is not finite.
    """
    truth = batch.truth
    if truth is None or truth.position is None:
        raise InputError(f"{batch.names[0]}: has no positions in its truth, and training needs them")
    talkers, axes = truth.position.shape[-2:]
    if talkers != 1:
        raise InputError(f"{batch.names[0]}: has {talkers} talkers, this tracker follows one")
    if axes < tracker.region.axes:
        raise InputError(f"{batch.names[0]}: has positions in {axes} axes, this tracker has {tracker.region.axes}")
    position = truth.position[warm_up:, :, 0, : tracker.region.axes].to(tracker.front_end.stft.window)
    bad = ~position.isfinite().all(-1)
    if bad.any():
        frame, number = bad.nonzero()[0].tolist()
        raise InputError(f"{batch.names[number]}: true positions must be finite, not so in frame {warm_up + frame}")
    return position, truth.known[warm_up:, :, 0]


def keep_fixed(model: nn.Module, fixed: Sequence[str]) -> None:
    """Train no parameter of `model` whose name begins with one of `fixed`.

    Raises:
        InputError: for a beginning that no name has, or if nothing is left to train.
    """
    names = [name for name, _ in model.named_parameters()]
    for beginning in fixed:
        if not any(name.startswith(beginning) for name in names):
            raise InputError(f"fixed: no parameter begins with {beginning!r}: there are {', '.join(names)}")
    for name, parameter in model.named_parameters():
        if name.startswith(tuple(fixed)):
            parameter.requires_grad_(False)
    if not any(parameter.requires_grad for parameter in model.parameters()):
        raise InputError(f"fixed must leave a parameter to train, got {', '.join(fixed)}")


def _check_fits(tracker: Tracker, batch: SceneBatch) -> None:
    """Raise `InputError` unless `batch` is one that the front end and the steered power of `tracker` are for."""
    front_end, grid, name = tracker.front_end, batch.grid, batch.names[0]
    frames = (grid.frame_length, grid.hop, grid.fs)
    wanted = (front_end.stft.frame_length, front_end.stft.hop, tracker.fs)
    if frames != wanted:
        raise InputError(
            "data and tracker must have the same frame_length, hop and fs: give the data the tracker's front_end and "
            f"fs, got {frames} and {wanted}"
        )
    microphones = front_end.gcc.num_microphones
    if batch.array.shape[-2] != microphones:
        raise InputError(f"{name}: has {batch.array.shape[-2]} microphones, the tracker's array has {microphones}")
    likelihood = tracker.filter.likelihood
    if isinstance(likelihood, SteeredPowerLikelihood):
        # from each microphone of the data to that of the same number
        off = likelihood.power.distances(batch.array.to(front_end.stft.window)).diagonal(dim1=-2, dim2=-1)
        if not off.max() <= _SAME_PLACE:
            number = off.amax(-1).argmax()
            raise InputError(
                f"{batch.names[number]}: has microphones {off.max():g} m from those of the tracker's array: give the "
                "tracker the array of the data"
            )
    if batch.observations is not None:
        tables, own = tuple(batch.observations.gcc.shape[-2:]), (len(front_end.gcc.first), front_end.gcc.num_lags)
        if tables != own:
            raise InputError(f"{name}: correlations must have {own} pairs and lags, those of the tracker, got {tables}")
