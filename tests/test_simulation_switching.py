"""Sound that passes from one place to the next, against sums written out."""

import pytest
import torch

from probtrack.errors import InputError
from probtrack.simulation.rooms.switching import fast_size, render_places

FS = 16000


def oracle(signal, place, responses, channels, kernel, lead):
    """Every sample through the mean of the responses around it, by loops: responses (P, C, M, L)."""
    reach, size = len(kernel) // 2, len(signal)
    audio = torch.zeros(responses.shape[2], size)
    for s in range(size):
        where = [int(place[min(max(s + k, 0), size - 1)]) for k in range(-reach, reach + 1)]
        mixed = sum(w * responses[p] for w, p in zip(kernel, where, strict=True))  # (C, M, L)
        for c in range(responses.shape[1]):
            for i in range(responses.shape[3]):
                if 0 <= s + i - lead < size:
                    audio[:, s + i - lead] += signal[s] * channels[s, c] * mixed[c, :, i]
    return audio


def hann(reach):
    k = torch.arange(-reach, reach + 1)
    return (1 + torch.cos(torch.pi * k / (reach + 1))) / (2 * reach + 2)


@pytest.mark.parametrize("lead", [0, 3, 90])
@pytest.mark.parametrize("fs", [16, 1000])  # blocks of 16 samples, and one block
def test_each_sample_goes_through_the_smoothed_response(lead, fs):
    signal, channels, responses = torch.randn(70), torch.randn(70, 2), torch.randn(4, 2, 3, 11)
    signal[20:30] = 0
    place = torch.tensor([1] + [2] * 24 + [0] * 3 + [2] * 9 + [3, 1, 3, 1, 0] + [1] * 27 + [2])
    audio = render_places(signal, place, lambda p: responses[p], channels, fade=8 / fs, fs=fs, lead=lead)
    torch.testing.assert_close(audio, oracle(signal, place, responses, channels, hann(4), lead))


def test_no_fade_switches_between_two_samples():
    signal, responses = torch.randn(40), torch.randn(2, 3, 7)
    place = (torch.arange(40) >= 17).long()
    audio = render_places(signal, place, lambda p: responses[p], fade=0.0, fs=10, lead=2)
    expected = oracle(signal, place, responses[:, None], torch.ones(40, 1), torch.ones(1), 2)
    torch.testing.assert_close(audio, expected)


def test_staying_is_plain_convolution_however_long():
    signal, response = torch.randn(5000), torch.randn(2, 300)
    audio = render_places(signal, torch.full((5000,), 7), lambda _: response, fs=400, lead=0)
    expected = torch.nn.functional.conv1d(signal[None, None], response.flip(-1)[:, None], padding=299)[0, :, :5000]
    torch.testing.assert_close(audio, expected)


def test_a_tone_through_equal_responses_is_not_modulated():
    tone = torch.sin(2 * torch.pi * 500 * torch.arange(FS) / FS)
    places = torch.randint(0, 5, (40,)).repeat_interleave(FS // 40)
    response = torch.randn(2, 200)
    moving = render_places(tone, places, lambda _: response, fs=FS, lead=0)
    still = render_places(tone, places * 0, lambda _: response, fs=FS, lead=0)
    torch.testing.assert_close(moving, still)


def test_passing_to_another_delay_does_not_click():
    tone = torch.sin(2 * torch.pi * 1000 * torch.arange(2 * FS) / FS)
    place = torch.arange(2 * FS) * 20 // (2 * FS)
    delays = torch.eye(64)[10:40:1]  # a response that is a pulse, one sample later at each place
    audio = render_places(tone, place, lambda p: delays[p][None], fs=FS, lead=0)
    power = torch.fft.rfft(audio[0] * torch.hann_window(2 * FS)).abs().square()
    frequency = torch.arange(len(power)) / 2
    assert power[(frequency - 1000).abs() > 200].sum() < 1e-6 * power.sum()


def test_the_future_changes_nothing_before_it():
    signal, responses = torch.randn(3000), torch.randn(6, 2, 50)
    place = torch.arange(3000) // 500
    whole = render_places(signal, place, lambda p: responses[p], fs=1000, lead=5)
    part = render_places(signal[:1700], place[:1700], lambda p: responses[p], fs=1000, lead=5)
    torch.testing.assert_close(whole[:, : 1700 - 5], part[:, :-5])


def test_places_of_silence_are_not_asked_for():
    signal, asked = torch.ones(900), []
    signal[250:700] = 0
    place = torch.arange(900) // 300

    def response_of(p):
        asked.append(p)
        return torch.ones(2, 4)

    render_places(signal, place, response_of, fade=0.04, fs=1000, lead=0)
    assert asked == [0, 2]
    assert not render_places(signal * 0, place, response_of, fs=1000, lead=0).any()


def test_keeps_the_type_of_the_signal():
    signal, responses = torch.randn(4000), torch.randn(4, 3, 100)
    place = torch.arange(4000) // 1000
    double = render_places(signal, place, lambda p: responses[p], fs=1000, lead=0)
    single = render_places(signal.float(), place, lambda p: responses[p], fs=1000, lead=0)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double, rtol=0, atol=1e-4)


def test_fast_sizes_are_the_next_smooth_numbers():
    smooth = sorted(2**a * 3**b * 5**c for a in range(15) for b in range(10) for c in range(7))
    for size in (1, 2, 7, 121, 4801, 10007, 16384):
        assert fast_size(size) == next(s for s in smooth if s >= size)


NAN = torch.full((9,), torch.nan)
ONES, ZEROS = torch.ones(9), torch.zeros(9, dtype=torch.int64)


@pytest.mark.parametrize(
    ("signal", "place", "channels", "response", "message"),
    [
        (NAN, ZEROS, None, torch.ones(2, 3), "signal must be finite"),
        (ONES, ZEROS[:4], None, torch.ones(2, 3), r"place must be long and have shape \(9,\)"),
        (ONES, ONES, None, torch.ones(2, 3), "place must be long"),
        (ONES, ZEROS, torch.ones(4, 2), torch.ones(2, 2, 3), r"channels must have shape \(9, C\)"),
        (ONES, ZEROS, torch.ones(9, 2), torch.ones(3, 2, 3), r"response of place 0 must have shape \(2, M, L\)"),
        (ONES, ZEROS, None, torch.ones(3), r"response of place 0 must have shape \(M, L\)"),
        (ONES, ZEROS, None, NAN.expand(2, 9), "response of place 0 must be finite"),
        (ONES[:0], ZEROS[:0], None, torch.ones(2, 3), "signal must have shape"),
    ],
)
def test_what_does_not_fit_is_said(signal, place, channels, response, message):
    with pytest.raises(InputError, match=message):
        render_places(signal, place, lambda _: response, channels, fs=FS, lead=0)
