"""Scenes: the truth is what was done, levels are what was asked for, and seeds keep purposes apart."""

import dataclasses
import math

import pytest
import torch
from quick_scenes import OPEN, SIZE, quick, two_talkers

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation import Faults, demo_scene, preset, shipped_scenes
from probtrack.simulation.noise import DiffuseNoise, Interferer, WhiteNoise
from probtrack.simulation.rooms import ShoeboxRoom
from probtrack.simulation.voices import GivenTurns, TurnTaking
from probtrack.trackers import lehmann2007

SAID = GivenTurns(((0, 0.3, 0.9), (1, 1.1, 1.7)))
NOISES = (Interferer((3.0, 2.5, 0.5)), WhiteNoise(-10.0), DiffuseNoise(level_db=-3.0))


@pytest.mark.parametrize(("fs", "centre", "hop"), [(16000, 256, 256), (44100, 705, 706), (8000, 128, 128)])
def test_truth_is_the_motion_at_the_centre_of_each_frame(fs, centre, hop):
    scene = two_talkers(fs=fs)
    truth, motion = scene.simulate().truth, scene.motion()
    at = torch.arange(len(truth.time)) * hop + centre
    assert at[-1] + centre + (fs == 44100) <= 2 * fs < at[-1] + centre + hop + (fs == 44100)
    torch.testing.assert_close(truth.time, at / fs, rtol=0, atol=1e-12)
    for found, made in zip(truth.motion, motion, strict=True):
        assert torch.equal(found, made[at])
    x, y, _ = (truth.motion.position - scene.load_array().positions.mean(0)).unbind(-1)
    torch.testing.assert_close(truth.azimuth, torch.atan2(y, x))


def test_frames_are_those_of_the_tracker():
    scene = quick(duration=2.05)
    recording = scene.simulate()
    track = lehmann2007(recording.array, scene.room.region.plane() if recording.array.axes == 2 else scene.room.region,
                        num_particles=20)(recording.audio, torch.arange(1))  # fmt: skip
    torch.testing.assert_close(track.time.double(), recording.truth.time)


def test_speech_is_true_when_the_voice_sounds():
    recording = two_talkers(turns=SAID).simulate()
    time, speech = recording.truth.time, recording.truth.speech
    assert torch.equal(speech[:, 0], (time >= 0.3) & (time < 0.9))
    assert torch.equal(speech[:, 1], (time >= 1.1) & (time < 1.7))
    for k, said in enumerate(recording.speech):
        energy = said.samples.unfold(0, 512, 256).square().mean(-1)
        assert energy[speech[:, k]].median() > 1e-3 * energy.max()
        assert energy[(time < SAID.utterances[k][1] - 0.017) | (time > SAID.utterances[k][2] + 0.017)].max() == 0


@pytest.mark.parametrize("snr", [-5.0, 20.0])
@pytest.mark.parametrize("noises", [(WhiteNoise(),), NOISES], ids=["white", "three"])
def test_snr_is_the_one_asked_for_where_someone_speaks(snr, noises):
    scene = two_talkers(turns=SAID, noises=noises, snr_db=snr)
    heard = scene.listen()
    audio = scene.record(heard).audio
    time = torch.arange(audio.shape[-1]) / scene.fs
    speaking = ((time >= 0.3) & (time < 0.9)) | ((time >= 1.1) & (time < 1.7))
    gain = (audio * heard.clean).sum() / heard.clean.square().sum()
    rest = audio - gain * heard.clean
    ratio = (gain * heard.clean[:, speaking]).square().mean() / rest.square().mean()
    assert 10 * float(ratio.log10()) == pytest.approx(snr, abs=0.2)


def test_clean_sound_is_the_sum_of_the_talkers():
    both = two_talkers(turns=SAID, noises=()).listen().clean
    said = [GivenTurns(tuple(one for one in SAID.utterances if one[0] == k)) for k in range(2)]
    alone = [two_talkers(turns=turns, noises=()).listen().clean for turns in said]
    assert alone[0].any()
    assert alone[1].any()
    torch.testing.assert_close(both, alone[0] + alone[1])
    scene = two_talkers(turns=SAID, directivity="omnidirectional", noises=())
    heard = scene.listen()
    where, said = scene.motion(), heard.recording.speech
    parts = [OPEN.render(said[k].samples, where.talker(k), scene.load_array(), scene.fs) for k in range(2)]
    torch.testing.assert_close(heard.clean, parts[0] + parts[1])


def test_level_and_shape():
    scene = two_talkers(noises=())
    recording = scene.simulate()
    assert recording.audio.shape == (scene.load_array().num_microphones, 32000)
    assert float(recording.audio.abs().max()) == pytest.approx(0.9)
    heard = scene.listen()
    torch.testing.assert_close(recording.audio, heard.clean * 0.9 / heard.clean.abs().max())


def test_same_seed_same_bits_whatever_the_threads():
    scene = quick(room=ShoeboxRoom(SIZE, 0.08, spacing=0.5))
    first = scene.simulate()
    torch.set_num_threads(2)
    again = scene.simulate()
    assert torch.get_num_threads() == 2
    assert torch.equal(first.audio, again.audio)
    assert not torch.equal(first.audio, dataclasses.replace(scene, seed=4).simulate().audio)


def test_noise_and_faults_change_neither_the_walk_nor_the_words():
    scene = quick()
    plain = scene.listen()
    other = dataclasses.replace(scene, noises=NOISES, snr_db=3.0, faults=Faults(dead_channels=(2,))).listen()
    assert torch.equal(plain.clean, other.clean)
    assert torch.equal(plain.recording.truth.speech, other.recording.truth.speech)
    assert not torch.equal(plain.noise, other.noise)


def test_turns_change_neither_the_walk_nor_the_noise():
    plain, other = two_talkers().listen(), two_talkers(turns=TurnTaking(active_share=0.3)).listen()
    assert torch.equal(plain.noise, other.noise)
    assert torch.equal(plain.recording.truth.motion.position, other.recording.truth.motion.position)
    assert not torch.equal(plain.recording.truth.speech, other.recording.truth.speech)


def test_ratios_of_one_rendering_equal_scenes_of_their_own():
    scene = two_talkers(noises=NOISES, faults=Faults(gain_std_db=1.0, dead_channels=(2,), clipping_db=3.0))
    heard = scene.listen()
    for snr in (0.0, 12.0):
        own = dataclasses.replace(scene, snr_db=snr)
        assert torch.equal(own.record(heard).audio, own.simulate().audio)


def test_gains_and_dead_channels_are_heard():
    scene = quick(noises=(), array="lehmann2007")
    plain = scene.simulate().audio
    faulty = dataclasses.replace(scene, faults=Faults(gain_std_db=3.0, dead_channels=(2,))).simulate().audio
    ratio = (faulty * plain).sum(-1) / plain.square().sum(-1)
    alive = [k for k in range(len(plain)) if k != 1]
    torch.testing.assert_close(faulty[alive], ratio[alive, None] * plain[alive])
    assert 0.5 < float(20 * ratio[alive].log10().std()) < 8
    assert faulty[1].square().mean() < 1e-5 * faulty[alive].square().mean()


def test_microphones_that_are_elsewhere_are_heard_there_and_said_where_they_should_be():
    scene = quick(noises=(), faults=Faults(position_std=0.03))
    recording = scene.simulate()
    stated = scene.load_array().positions
    assert torch.equal(recording.array.positions, stated)
    moved = recording.true_array.positions - stated
    assert 0.01 < float(moved.std()) < 0.06
    true = recording.true_array
    motion, said = scene.motion().talker(0), recording.speech[0].samples
    heard = OPEN.render(said, motion, true, scene.fs)
    assert not torch.equal(heard, OPEN.render(said, motion, recording.array, scene.fs))
    clean = dataclasses.replace(scene, directivity="omnidirectional").simulate().audio
    torch.testing.assert_close(clean, heard * 0.9 / heard.abs().max())
    assert quick(noises=()).simulate().true_array.positions.equal(stated)


def test_talkers_are_directed_unless_said_otherwise():
    ways = {
        d: quick(noises=(), directivity=d, array="lehmann2007").listen().clean for d in ("speech", "omnidirectional")
    }
    power = {d: clean.square().mean(-1) for d, clean in ways.items()}
    spread = (power["speech"] / power["omnidirectional"]).log10() * 10
    assert float(spread.max() - spread.min()) > 2


def test_demo_is_the_same_in_single_precision():
    torch.set_default_dtype(torch.float32)
    scene = dataclasses.replace(demo_scene(1), room=OPEN, faults=Faults(gain_std_db=1.0), array="klaassen2005")
    single = scene.simulate()
    assert single.audio.dtype == torch.float32
    torch.set_default_dtype(torch.float64)
    double = scene.simulate()
    assert (single.audio - double.audio).abs().max() < 1e-3
    assert (single.truth.motion.position - double.truth.motion.position).abs().max() < 1e-5
    assert torch.equal(single.truth.speech, double.truth.speech)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("name", [name for name in shipped_scenes() if not name.startswith("walks")])
def test_presets_stay_in_their_rooms_among_their_microphones(name, dtype):
    torch.set_default_dtype(dtype)
    scene = preset(name)
    motion, array = dataclasses.replace(scene, fs=8000).motion(), scene.load_array()
    assert motion.position.dtype == dtype
    assert scene.room.region.contains(motion.position).all()
    assert scene.room.region.contains(array.positions).all()
    assert motion.position.shape == (round(scene.duration * 8000), scene.num_talkers, 3)
    nearest = torch.cdist(motion.position[::800].flatten(0, 1), array.positions).min()
    assert nearest > 0.25


def test_demo_walks_among_the_microphones_and_pauses_twice():
    scene = demo_scene(0)
    assert Region((0.49, 0.29, 1.5), (3.01, 2.81, 1.52)).contains(scene.motion().position).all()
    for seed in range(2):
        quiet = dataclasses.replace(demo_scene(seed), room=OPEN, array="klaassen2005")
        speech = quiet.listen().recording.truth.speech[:, 0]
        assert ((speech.int().diff() == -1).sum()) >= 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"snr_db": math.inf}, "snr_db must be from -200 to 200, got inf"),
        ({"duration": 0.01}, "duration must be 0.032 to .* s, got 0.01"),
        ({"duration": math.nan}, "duration must be"),
        ({"duration": 1e5}, "duration must be"),
        ({"array": "nowhere.yaml"}, "nowhere.yaml: cannot read array file"),
        ({"num_talkers": 2}, "talker"),
        ({"num_talkers": 0}, "num_talkers must be an integer of at least 1"),
        ({"fs": 100}, "fs must be"),
        ({"seed": -1}, "seed must be"),
        ({"directivity": "loud"}, "directivity must be speech or omnidirectional, got 'loud'"),
        ({"room": ShoeboxRoom((2.7, 2.41, 1.58), 0.0)}, "must stay inside the room, got .*1.58"),
        ({"array": "lehmann2007", "room": ShoeboxRoom((2.9, 2.4, 2.2), 0.0)}, "microphone at .* outside the room"),
        ({"faults": Faults(dead_channels=(9,))}, "dead_channels must be from 1 to 2"),
        ({"noises": (WhiteNoise(math.inf),)}, "level_db must be from -200 to 200, got inf"),
        ({"noises": None}, "noises must be a list"),
        ({"snr_db": -1e5}, "snr_db must be from -200 to 200"),
        ({"duration": 600.0, "array": "fallon2006", "fs": 96000}, "duration must be at most 35 s with 12 microphones"),
        ({"turns": GivenTurns(())}, "turns must have an utterance within the duration"),
    ],
)
def test_rejects(changes, message):
    with pytest.raises(InputError, match=message):
        quick(**changes).simulate()


def test_rejects_an_array_in_a_plane(tmp_path):
    MicrophoneArray([[0.5, 0.5], [1.0, 0.7]], "flat").to_yaml(tmp_path / "flat.yaml")
    with pytest.raises(InputError, match="a room needs microphones in three dimensions, got 2"):
        quick(array=str(tmp_path / "flat.yaml")).simulate()


def test_a_stated_microphone_outside_is_refused_whatever_its_error():
    small = quick(room=ShoeboxRoom((2.5, 3.1, 2.2), 0.0), faults=Faults(position_std=0.01))
    with pytest.raises(InputError, match=r"klaassen2005: microphone at \(2.6, 2.1, 1.5\) m is outside"):
        small.simulate()
