"""Recorded voices: what is found, cut, levelled and placed, on files whose every sample is known."""

import numpy as np
import pytest
import soundfile
import torch

from probtrack.errors import InputError
from probtrack.simulation.voices import RecordedVoices, TurnTaking, speech_activity

FS = 16000
PHRASE, PAUSE = 0.8, 0.5  # s


def sound(phrases, tone, fs=FS, level=0.1, seed=0):
    """Phrases of a `tone` [Hz] between pauses with a little noise; each phrase is quiet after 0.5 s for 0.06 s."""
    t = np.arange(round(PHRASE * fs)) / fs
    phrase = level * np.sin(2 * np.pi * tone * t)
    phrase[(t > 0.5) & (t < 0.56)] *= 0.01
    silence = np.zeros(round(PAUSE * fs))
    x = np.concatenate([silence, *[np.concatenate([phrase, silence])] * phrases])
    return x + 1e-4 * level * np.random.default_rng(seed).standard_normal(len(x))


def write(path, samples, fs=FS):
    path.parent.mkdir(parents=True, exist_ok=True)
    soundfile.write(path, samples, fs, subtype="FLOAT")
    return path


@pytest.fixture
def folder(tmp_path):
    """Three talkers, each a folder with two files of one tone: 300, 500 and 700 Hz."""
    for name, tone in (("ann", 300), ("ben", 500), ("cat", 700)):
        write(tmp_path / name / "a.wav", sound(3, tone))
        write(tmp_path / name / "chapter" / "b.flac.wav", sound(2, tone, level=0.01))
    return tmp_path


def speak(place, turns, duration=6.0, seed=0, fs=FS, talkers=None):
    return RecordedVoices(str(place), talkers).speak(turns, duration=duration, fs=fs, seed=seed)


def tone_of(speech, fs=FS):
    x = speech.samples
    return float(torch.fft.rfft(x).abs().argmax() * fs / len(x))


def runs(active, fs=FS):
    """Start and end of each run of True [s]."""
    edges = torch.nn.functional.pad(active.int(), (1, 1)).diff()
    return torch.stack([(edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0]], -1) / fs


def test_talkers_are_different_and_drawn_from_the_seed(folder):
    turns = [[(0.2, 1.5)], [(2.0, 3.5)], [(4.0, 5.5)]]
    orders = {tuple(round(tone_of(speech), -2) for speech in speak(folder, turns, seed=seed)) for seed in range(12)}
    assert all(sorted(order) == [300, 500, 700] for order in orders)
    assert len(orders) > 2


def test_named_talkers_speak_in_the_order_named(folder):
    spoken = speak(folder, [[(0.0, 2.0)], [(2.0, 4.0)]], talkers=("cat", "ann"))
    assert [tone_of(speech) for speech in spoken] == pytest.approx([700, 300], abs=5)


def test_a_folder_of_files_has_a_talker_in_each_and_a_file_is_one(tmp_path):
    for name, tone in (("x", 300), ("y", 500)):
        write(tmp_path / f"{name}.wav", sound(3, tone))
    (tmp_path / "notes").mkdir()
    (tmp_path / "readme.txt").write_text("no talker")
    assert tone_of(speak(tmp_path, [[(0.0, 2.0)]], talkers=("y",))[0]) == pytest.approx(500, abs=5)
    assert tone_of(speak(tmp_path / "x.wav", [[(0.0, 2.0)]])[0]) == pytest.approx(300, abs=5)


def test_speaks_at_its_turns_and_is_silent_in_between(folder):
    turns = [[(0.3, 1.1), (2.0, 3.7), (4.5, 5.5)]]
    samples, active, score = speak(folder, turns)[0]
    assert score is None
    assert samples.shape == active.shape == (6 * FS,)
    assert samples[~active].abs().max() == 0
    spans = runs(active)
    torch.testing.assert_close(spans[:, 0], torch.tensor([0.3, 2.0, 4.5]), rtol=0, atol=1 / FS)
    assert (spans[:, 1] - torch.tensor([1.1, 3.7, 5.5])).abs().max() <= 0.2


def test_level_is_the_same_for_loud_and_soft_files(folder):
    samples, active, _ = speak(folder, [[(0.5, 19.5)]], duration=20.0, talkers=("ann",))[0]
    assert samples[active].square().mean().sqrt() == pytest.approx(0.07, rel=1e-6)
    pieces = samples[active].unfold(0, FS, FS).square().mean(-1).sqrt()  # of files 20 dB apart
    assert (pieces / 0.07).log10().abs().max() * 20 < 1.5


def test_long_pauses_are_cut_out_and_material_begins_again(folder):
    samples, active, _ = speak(folder, [[(0.0, 9.8)]], duration=10.0, talkers=("ben",))[0]  # of 4 s of phrases
    loud = samples.square().unfold(0, 320, 160).mean(-1).sqrt() > 0.02
    gaps = runs(~loud[: round(9.5 * 100)], 100)
    assert (gaps[:, 1] - gaps[:, 0]).max() < 0.25
    assert loud.double().mean() > 0.75
    assert active[: 9 * FS].all()


def test_cuts_snap_to_where_it_is_quiet(tmp_path):
    path = write(tmp_path / "one.wav", sound(1, 400))
    _, active, _ = speak(path, [[(0.0, 0.45), (2.0, 2.4)]])[0]
    # speech begins 40 ms before the phrase, whose quiet place is 0.5 to 0.56 s on
    first, second = runs(active)
    assert 0.54 <= first[1] <= 0.60
    assert second[1] - second[0] == pytest.approx(0.84 + 0.04 - float(first[1]), abs=0.021)


def test_ends_of_an_utterance_fade(tmp_path):
    t = np.arange(4 * FS) / FS
    path = write(tmp_path / "hum.wav", 0.1 * np.sin(2 * np.pi * 440 * t))
    samples, active, _ = speak(path, [[(0.5, 1.5)]], duration=2.0)[0]
    start, end = (runs(active)[0] * FS).round().long().tolist()
    peak = samples.abs().max()
    for inwards in (samples[start:end], samples[start:end].flip(0)):
        assert inwards[:16].abs().max() < 0.05 * peak
        assert inwards[160:320].abs().max() > 0.95 * peak


def test_utterances_end_before_any_talker_goes_on(folder):
    turns = [[(0.1, 1.0), (2.52, 4.0)], [(1.05, 2.5)]]
    for seed in range(6):
        first, second = speak(folder, turns, duration=4.0, seed=seed)
        assert not (first.active & second.active).any()
        assert first.active[round(2.52 * FS)]


def test_a_talker_says_the_same_beside_others(folder):
    turns = [[(0.2, 1.5)], [(2.0, 3.5)]]
    alone, together = speak(folder, turns[:1], seed=3), speak(folder, turns, seed=3)
    assert torch.equal(alone[0].samples, together[0].samples)


def test_what_is_said_changes_with_the_seed_and_only_with_it(folder):
    write(folder / "ann" / "a.wav", sound(6, 300) * np.linspace(0.5, 1.0, len(sound(6, 300))))
    once, again, other = (speak(folder, [[(0.2, 1.7)]], seed=seed, talkers=("ann",))[0] for seed in (1, 1, 2))
    assert torch.equal(once.samples, again.samples)
    assert not torch.equal(once.samples, other.samples)


def test_a_file_that_changes_is_read_again(tmp_path):
    path = write(tmp_path / "a.wav", sound(3, 300))
    assert tone_of(speak(path, [[(0.0, 2.0)]])[0]) == pytest.approx(300, abs=5)
    write(path, sound(4, 600))
    assert tone_of(speak(path, [[(0.0, 2.0)]])[0]) == pytest.approx(600, abs=5)


def test_resamples_averages_channels_and_removes_rumble(tmp_path):
    x = sound(3, 440, fs=8000)
    rumble = 0.1 * np.sin(2 * np.pi * 15 * np.arange(len(x)) / 8000)
    write(tmp_path / "a.wav", np.stack([x + rumble, 0.5 * x + rumble], -1), 8000)
    speech = speak(tmp_path / "a.wav", [[(0.0, 6.0)]], fs=22050)[0]
    assert len(speech.samples) == 6 * 22050
    power = torch.fft.rfft(speech.samples).abs().square()
    assert tone_of(speech, 22050) == pytest.approx(440, abs=5)
    assert power[: 6 * 30].sum() < 0.02 * power.sum()


def test_activity_finds_the_phrases():
    active = speech_activity(torch.from_numpy(sound(3, 500)), FS)
    expected = PAUSE + (PHRASE + PAUSE) * torch.arange(3)
    torch.testing.assert_close(runs(active)[:, 0], expected, rtol=0, atol=0.021)
    torch.testing.assert_close(runs(active)[:, 1], expected + PHRASE, rtol=0, atol=0.021)


def test_activity_does_not_take_noise_between_digital_silence_for_speech():
    x = torch.from_numpy(sound(3, 500))
    x[: FS // 4] = 0
    x[-FS // 4 :] = 0
    assert speech_activity(x, FS).double().mean() == pytest.approx(3 * PHRASE / (len(x) / FS), abs=0.02)


def test_activity_of_a_steady_sound_is_all_speech():
    assert speech_activity(torch.randn(FS), FS).all()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.wav", b"text", "a.wav: cannot read speech"),
        ("a.wav", np.zeros(FS), "a.wav: holds no sound"),
        ("a.wav", np.zeros(0), "a.wav: holds no sound"),
        ("a.wav", np.full(FS, np.nan), "a.wav: samples must be finite, got NaN or infinity"),
        ("a.wav", np.ones(100), "a.wav: must hold at least 0.1 s of speech, got 0.00625 s of sound"),
        ("a.txt", b"text", "holds no audio files and no folders of talkers"),
        ("ann/a.txt", b"text", "ann: holds no audio files"),
    ],
)
def test_rejects_what_holds_no_speech(tmp_path, name, content, message):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        write(path, content)
    with pytest.raises(InputError, match=message) as caught:
        speak(tmp_path, [[(0.0, 1.0)]])
    assert "\n" not in str(caught.value)


def test_rejects_talkers_that_are_not_there(folder):
    with pytest.raises(InputError, match="4 talkers are to speak, got 3"):
        speak(folder, [[(0.0, 1.0)]] * 4)
    with pytest.raises(InputError, match="2 talkers are to speak, got 1"):
        speak(folder, [[(0.0, 1.0)]] * 2, talkers=("ann",))
    with pytest.raises(InputError, match="has no talker 'dan'"):
        speak(folder, [[(0.0, 1.0)]], talkers=("dan",))
    with pytest.raises(InputError, match="talkers must be different names, got ann, ann"):
        RecordedVoices(str(folder), ("ann", "ann"))
    with pytest.raises(InputError, match="nowhere: no such file or folder of speech"):
        speak(folder / "nowhere", [[(0.0, 1.0)]])
    write(folder / "x.wav", sound(1, 300))
    write(folder / "x.aiff", sound(1, 300))
    with pytest.raises(InputError, match="audio files must differ in more than their suffix"):
        speak(folder, [[(0.0, 1.0)]])


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["librispeech_speakers", "librispeech_utterances"])
def test_real_talkers_keep_the_turns_of_people(data_dir, name):
    turns = TurnTaking().draw(2, 120.0, torch.Generator().manual_seed(1))
    for speech, given in zip(speak(data_dir / "speech" / name, turns, duration=120.0), turns, strict=True):
        spans, expected = runs(speech.active), torch.tensor(given)
        assert (spans[:, 0] - expected[:, 0]).abs().max() < 1e-3
        assert (spans[:, 1] - expected[:, 1]).abs().max() < 0.201
        assert speech.samples[speech.active].square().mean().sqrt() == pytest.approx(0.07, rel=1e-6)


@pytest.mark.realdata
def test_no_click_is_heard_where_real_speech_is_cut(data_dir):
    turns = TurnTaking().draw(1, 120.0, torch.Generator().manual_seed(2))
    x, active, _ = speak(data_dir / "speech" / "librispeech_speakers", turns, duration=120.0)[0]
    high = torch.stft(x, 256, 64, window=torch.hann_window(256), return_complex=True)[96:].abs().square().sum(0)
    flux = high.diff().clamp_min(0)  # above 6 kHz
    cuts = (runs(active).flatten() * FS / 64).round().long()[1:-1]
    at_cuts = torch.stack([flux[k - 3 : k + 3].max() for k in cuts])
    typical = flux[active[::64][: len(flux)]]
    assert at_cuts.quantile(0.9) < typical.quantile(0.95)
    assert at_cuts.max() < typical.max()
