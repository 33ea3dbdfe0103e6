"""Sound files: every format, any blocks, any rate, and what a bad file is told."""

import math

import numpy as np
import pytest
import soundfile
import torch
from torchaudio.transforms import Resample

from probtrack.audio import Recording
from probtrack.errors import InputError, NotFiniteError


def noise(length=4321, channels=3):
    """Samples (n, C), a different level in each channel."""
    return 0.04 * np.random.default_rng(0).standard_normal((length, channels)) * np.arange(1, channels + 1)


def written(path, samples, rate=16000, subtype="FLOAT"):
    soundfile.write(path, samples, rate, subtype=subtype)
    return path


def tone(frequency, rate, seconds=1.0):
    return 0.5 * np.sin(2 * np.pi * frequency * np.arange(round(seconds * rate)) / rate + 0.3)[:, None]


FORMATS = [  # error: half a step of the format, or what a lossy coder may do
    ("a.wav", "PCM_16", 2**-16),
    ("a.wav", "PCM_24", 2**-24),
    ("a.wav", "FLOAT", 1e-7),
    ("a.wav", "DOUBLE", 1e-7),
    ("a.flac", "PCM_16", 2**-16),
    ("a.aiff", "PCM_24", 2**-24),
    ("a.ogg", "VORBIS", 0.1),
]


@pytest.mark.parametrize(("name", "subtype", "error"), FORMATS)
def test_every_format_gives_back_its_samples(tmp_path, name, subtype, error):
    x = noise()
    read = Recording.open(written(tmp_path / name, x, subtype=subtype)).read()
    assert read.dtype == torch.float32
    step = error if subtype == "VORBIS" else 1.01 * error + 2**-24  # and float32
    np.testing.assert_allclose(read.numpy(), x.T, rtol=0, atol=2 * step)


def test_what_a_recording_says_of_itself(tmp_path):
    recording = Recording.open(written(tmp_path / "a.wav", noise(4410), 44100), 8000)
    assert (recording.file_rate, recording.num_samples, recording.fs) == (44100, 4410, 8000)
    assert (recording.channels, recording.duration, recording.num_output_samples) == ((0, 1, 2), 0.1, 800)


@pytest.mark.parametrize("rate", [16000, 44100, 48000, 8000, 22050])
@pytest.mark.parametrize("seconds", [1e-5, 0.0031, 0.05, 0.1234, 9.0])
def test_blocks_joined_are_the_whole_signal_resampled(tmp_path, rate, seconds):
    x = noise(7001 if seconds > 1e-3 else 301)
    recording = Recording.open(written(tmp_path / "a.wav", x, rate))
    blocks = list(recording.blocks(seconds))
    whole = Resample(rate, 16000)(torch.tensor(x.T, dtype=torch.float32))
    assert all(b.dtype == torch.float32 and b.shape[1] > 0 for b in blocks)
    # the same products, summed in another order: rounding only
    torch.testing.assert_close(torch.cat(blocks, 1), whole, rtol=0, atol=1e-6)
    assert recording.num_output_samples == whole.shape[1]


def test_blocks_are_as_long_as_asked_for_without_resampling(tmp_path):
    recording = Recording.open(written(tmp_path / "a.wav", noise(4321)))
    assert [b.shape for b in recording.blocks(0.1)] == [(3, 1600), (3, 1600), (3, 1121)]


def test_resampling_works_in_bounded_memory(tmp_path):
    recording = Recording.open(written(tmp_path / "a.wav", noise(44100 * 3, 1), 44100))
    assert max(b.shape[1] for b in recording.blocks(0.1)) <= 1600 + 320


def test_blocks_do_not_share_memory(tmp_path):
    recording = Recording.open(written(tmp_path / "a.wav", noise()))
    first, second, *_ = recording.blocks(0.05)
    before = second.clone()
    first.zero_()
    assert torch.equal(second, before)
    assert not torch.equal(first, second)


@pytest.mark.parametrize(("rate", "fs"), [(44100, 16000), (48000, 16000), (8000, 16000), (16000, 11025)])
def test_a_tone_keeps_frequency_level_and_time(tmp_path, rate, fs):
    read = Recording.open(written(tmp_path / "a.wav", tone(997.0, rate), rate), fs).read()
    expected = torch.tensor(tone(997.0, fs).T, dtype=torch.float32)
    middle = slice(200, -200)  # a filter needs its neighbours
    # ripple of torchaudio's default filter, 6 zero crossings: below half a per cent of the level
    torch.testing.assert_close(read[:, middle], expected[:, middle], rtol=0, atol=0.005 * 0.5)


@pytest.mark.parametrize("length", [1, 2, 3, 440, 441, 442, 30001])
@pytest.mark.parametrize("rate", [44100, 8000, 16000])
def test_number_of_output_samples(tmp_path, rate, length):
    recording = Recording.open(written(tmp_path / "a.wav", noise(length, 1), rate))
    assert recording.read().shape == (1, recording.num_output_samples)
    assert recording.num_output_samples == -(-length * 16000 // rate)


def test_channels_are_picked_and_ordered(tmp_path):
    path = written(tmp_path / "a.wav", noise(500))
    whole = Recording.open(path).read()
    assert torch.equal(Recording.open(path, channels=[2, 0]).read(), whole[[2, 0]])
    assert torch.equal(Recording.open(path, channels=(1,)).survey().high, whole[[1]].amax(1))


def test_survey_finds_range_dead_channels_and_clipping(tmp_path):
    x = noise(20000, 5)
    x[:, 1] = 0.0
    x[:, 3] = 0.25
    x[16500:16600, 4] = 1.0
    x[0:100, 4] = -1.0
    survey = Recording.open(written(tmp_path / "a.wav", np.clip(x, -1, 1))).survey()
    assert survey.flat.tolist() == [False, True, False, True, False]
    torch.testing.assert_close(survey.low[:3], torch.tensor(x.min(0)[:3]), check_dtype=False)
    torch.testing.assert_close(survey.high[:4], torch.tensor(x.max(0)[:4]), check_dtype=False)
    torch.testing.assert_close(survey.clipped, torch.tensor([0, 0, 0, 0, 0.01]), check_dtype=False, rtol=0, atol=1e-3)


@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24"])
def test_full_scale_of_integers_is_clipped_and_a_faint_channel_is_alive(tmp_path, subtype):
    x = np.zeros((1000, 2))
    x[:500, 0] = 1.0
    x[::2, 1] = 2.0 ** (1 - int(subtype[-2:]))  # one step
    survey = Recording.open(written(tmp_path / "a.wav", x, subtype=subtype)).survey()
    assert survey.clipped.tolist() == [0.5, 0.0]
    assert survey.flat.tolist() == [False, False]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_survey_names_the_first_sample_that_is_not_finite(tmp_path, value):
    x = noise(40000)
    x[[24001, 24800], [2, 0]] = value
    recording = Recording.open(written(tmp_path / "a.wav", x), channels=[0, 2])
    with pytest.raises(NotFiniteError, match=r"a.wav: channel 3 has a NaN or infinite sample at 1.500 s"):
        recording.survey()


BAD = {
    "text": ("a.wav", b"not audio at all", "not a sound file that can be read"),
    "no bytes": ("a.flac", b"", "not a sound file that can be read"),
    "headerless": ("a.raw", b"abcd" * 100, "raw samples without a header cannot be read"),
}


@pytest.mark.parametrize(("name", "content", "match"), BAD.values(), ids=BAD)
def test_rejects_what_is_not_audio(tmp_path, name, content, match):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=f"{name}: {match}") as caught:
        Recording.open(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "match"), [("none.wav", "No such file"), ("", "Is a directory")])
def test_rejects_what_cannot_be_read(tmp_path, name, match):
    with pytest.raises(InputError, match=f"cannot read the recording: {match}"):
        Recording.open(tmp_path / name)


def test_rejects_a_file_without_permission(tmp_path, monkeypatch):
    path = written(tmp_path / "a.wav", noise(10))

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "open", refuse)  # a mode of the file would not stop an administrator
    with pytest.raises(InputError, match=r"a.wav: cannot read the recording: Permission denied"):
        Recording.open(path)


def test_rejects_an_empty_recording(tmp_path):
    with pytest.raises(InputError, match=r"a.wav: the recording is empty \(0 samples\)"):
        Recording.open(written(tmp_path / "a.wav", np.zeros((0, 2))))


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"channels": [0, 3]}, r"a.wav: no channel 4: the file has 3"),
        ({"channels": [-1]}, r"a.wav: no channel 0: the file has 3"),
        ({"channels": []}, r"a.wav: no channel is picked"),
        ({"fs": 0}, "fs must be an integer of at least 1, got 0"),
    ],
)
def test_rejects_channels_and_rates_that_cannot_be(tmp_path, arguments, match):
    path = written(tmp_path / "a.wav", noise(10))
    with pytest.raises(InputError, match=match):
        Recording.open(path, **arguments)


def test_a_compressed_file_that_breaks_off_is_named_and_its_beginning_is_sound(tmp_path):
    x = noise(48000)
    whole = written(tmp_path / "whole.flac", x, subtype="PCM_24").read_bytes()
    (tmp_path / "cut.flac").write_bytes(whole[: len(whole) // 2])
    blocks = Recording.open(tmp_path / "cut.flac").blocks(0.1)
    np.testing.assert_allclose(next(blocks).numpy(), x[:1600].T, rtol=0, atol=1e-6)
    with pytest.raises(InputError, match=r"cut.flac: reading failed part-way"):
        list(blocks)


def test_a_file_shorter_than_its_header_says_does_not_repeat_samples(tmp_path):
    whole = written(tmp_path / "whole.mp3", noise(48000, 2), subtype="MPEG_LAYER_III").read_bytes()
    (tmp_path / "cut.mp3").write_bytes(whole[: len(whole) // 2])
    recording = Recording.open(tmp_path / "cut.mp3")
    assert recording.num_samples == 48000
    with pytest.raises(InputError, match=r"the recording ends after 1\.\d+ s of the 3.000 s that its header promises"):
        recording.read()


def test_a_wav_file_cut_short_gives_what_it_holds(tmp_path):
    x = noise(1000, 2)
    whole = written(tmp_path / "whole.wav", x).read_bytes()
    (tmp_path / "cut.wav").write_bytes(whole[: len(whole) - 8 * 300])
    recording = Recording.open(tmp_path / "cut.wav")
    assert recording.num_samples == 700
    np.testing.assert_allclose(recording.read().numpy(), x[:700].T, rtol=0, atol=1e-7)


def test_a_file_that_vanishes_is_named(tmp_path):
    recording = Recording.open(written(tmp_path / "a.wav", noise(10)))
    (tmp_path / "a.wav").unlink()
    with pytest.raises(InputError, match=r"a.wav: reading failed part-way"):
        recording.read()
