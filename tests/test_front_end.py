"""The front end: a stream in any cuts is the whole recording."""

import pytest
import torch

from probtrack.audio import EnergyVoiceActivity, FrontEnd, GeneralisedCrossCorrelation, ShortTimeSpectrum
from probtrack.errors import NotFiniteError, ShapeError
from probtrack.geometry import MicrophoneArray

L, H, M = 128, 48, 3


def front_end():
    array = MicrophoneArray([[0.3, 0.1], [0.5, 0.15], [0.2, 0.4]])
    gcc = GeneralisedCrossCorrelation(array, fs=8000, frame_length=L)
    return FrontEnd(ShortTimeSpectrum(L, H), gcc, EnergyVoiceActivity(fs=8000, frame_length=L, hop=H))


def noise(*batch, length=3000):
    return torch.randn(*batch, M, length) * (1 + 9 * (torch.arange(length) % 1500 > 900))


def streamed(ears, samples, cuts):
    state, pieces = None, []
    for piece in torch.tensor_split(samples, cuts, -1):
        state, observations = ears.step(state, piece)
        pieces.append(observations)
    return state, [torch.cat(x) for x in zip(*pieces, strict=True)]


CUTS = {
    "one sample at first": [1, 2, 3, 200, 900],
    "shorter than a hop": list(range(17, 3000, 17)),
    "a hop": list(range(H, 3000, H)),
    "on frame ends": [L, L + H, L + 5 * H],
    "empty": [500, 500, 500, 2999],
    "random": [37, 340, 341, 1203, 1999, 2500],
}


@pytest.mark.parametrize("cuts", CUTS.values(), ids=CUTS)
@pytest.mark.parametrize("batch", [(), (2,)])
def test_stream_in_any_cuts_is_the_whole(cuts, batch):
    ears, samples = front_end(), noise(*batch)
    whole = ears(samples)
    _, (gcc, speech) = streamed(ears, samples, cuts)
    assert torch.equal(speech, whole.speech)
    torch.testing.assert_close(gcc, whole.gcc)  # products of other sizes round differently


def test_memory_between_blocks_does_not_grow():
    state, _ = streamed(front_end(), noise(length=20000), list(range(500, 20000, 500)))
    assert state.samples.shape[-1] < L
    assert state.samples.untyped_storage().nbytes() <= 8 * M * L


def test_stepping_does_not_change_the_state_before():
    ears, samples = front_end(), noise()
    state, _ = ears.step(None, samples[:, :1000])
    first = ears.step(state, samples[:, 1000:])[1]
    again = ears.step(state, samples[:, 1000:])[1]
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_observations_are_those_of_the_parts():
    ears, samples = front_end(), noise(2)
    frames, observations = ears.stft(samples), ears(samples)
    assert observations.gcc.shape == (60, 2, 3, ears.gcc.num_lags)
    assert observations.speech.shape == (60, 2)
    torch.testing.assert_close(observations.gcc, ears.gcc(frames.spectrum))
    torch.testing.assert_close(observations.speech, ears.vad(frames)[0])


def test_nothing_is_observed_of_less_than_a_frame():
    ears = front_end()
    for length in (0, L - 1):
        observations = ears(noise(length=length))
        assert observations.gcc.shape == (0, 3, ears.gcc.num_lags)
        assert observations.speech.shape == (0,)


def test_every_parameter_learns():
    ears = front_end()
    gcc, speech = ears(noise())
    (gcc.square().sum() + speech.sum()).backward()
    assert len(list(ears.parameters())) == 4
    assert all(p.grad.isfinite().all() and (p.grad != 0).all() for p in ears.parameters())


def test_state_dict_round_trip():
    ears, again, samples = front_end(), front_end(), noise()
    with torch.no_grad():
        for p in ears.parameters():
            p.add_(0.1 * torch.randn_like(p))
    assert not torch.equal(again(samples).gcc, ears(samples).gcc)
    again.load_state_dict(ears.state_dict())
    for a, b in zip(again(samples), ears(samples), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("shape", [(4, 1000), (2, 1000), (1000,), (3, 4, 1000)])
def test_rejects_another_number_of_channels(shape):
    with pytest.raises(ShapeError, match=r"samples must have shape \(\.\.\., 3, n\), one row a microphone, got"):
        front_end()(torch.zeros(shape))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_rejects_samples_that_are_not_finite(value):
    samples = noise()
    samples[2, 2999] = value
    with pytest.raises(NotFiniteError, match="samples hold NaN or infinite values"):
        front_end()(samples)


def test_rejects_parts_of_different_frame_lengths():
    ears = front_end()
    ears.stft = ShortTimeSpectrum(2 * L, H)
    with pytest.raises(ShapeError, match=r"spectrum must have shape \(\.\.\., 3, 65\), got"):
        ears(noise())
